// Rows of a batch over threads. Every row is done by itself, so that results do not depend on how many there are.
#pragma once
#include <atomic>
#include <chrono>
#include <exception>
#include <memory>
#include <system_error>
#include <thread>
#include <vector>

#include "scratch.hpp"

namespace graspd {

// Asks the caller now and then whether to stop, from the caller's own thread: it may hold an interpreter's lock.
class Stop {
   public:
    typedef int32_t (*Poll)(int64_t done);
    explicit Stop(Poll poll) : poll_(poll), next_(Clock::now()) {}

    // Counts a step; false where it is not to be done.
    bool go(bool caller) {
        done_.fetch_add(1, std::memory_order_relaxed);
        if (caller && poll_ && Clock::now() >= next_) {
            if (poll_(done_.load())) stopped_.store(true);
            next_ = Clock::now() + std::chrono::milliseconds(2);
        }
        return !stopped_.load(std::memory_order_relaxed);
    }
    bool stopped() const { return stopped_.load(); }

   private:
    typedef std::chrono::steady_clock Clock;
    Poll poll_;
    Clock::time_point next_;
    std::atomic<int64_t> done_{0};
    std::atomic<bool> stopped_{false};
};

// work(row, scratch, whether this is the caller's thread) for every row; the caller's thread takes part.
template <class Work>
static void for_rows(const Problem& p, int rows, int threads, Work work) {
    std::atomic<int> next{0};
    auto run = [&](bool caller) {
        Scratch scratch(p);
        for (int row; (row = next++) < rows;) work(row, scratch, caller);
    };
    std::vector<std::thread> others;
    for (int k = 1; k < std::min(threads, rows); k++) {
        try {
            others.emplace_back([&] {
                try {
                    run(false);
                } catch (const std::bad_alloc&) {  // the others do its rows
                }
            });
        } catch (const std::system_error&) {  // no thread to be had
            break;
        }
    }
    std::exception_ptr failed;
    try {
        run(true);
    } catch (...) {
        failed = std::current_exception();
    }
    for (auto& other : others) other.join();
    if (failed && next < rows) std::rethrow_exception(failed);
}

}  // namespace graspd

// Rows of a batch over threads. Every row is done by itself, so that results do not depend on how many there are.
#pragma once
#include <atomic>
#include <chrono>
#include <exception>
#include <mutex>
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

// work(row, scratch, whether this is the caller's thread) for every row; the caller's thread takes part. What a thread
// throws, for want of memory, ends the others and is thrown to the caller.
template <class Work>
static void for_rows(const Problem& p, int rows, int threads, Work work) {
    std::atomic<int> next{0};
    std::exception_ptr failure;
    std::mutex failing;
    auto run = [&](bool caller) {
        try {
            Scratch scratch(p);
            for (int row; (row = next++) < rows;) work(row, scratch, caller);
        } catch (...) {
            std::lock_guard<std::mutex> lock(failing);
            failure = std::current_exception();
            next = rows;
        }
    };
    std::vector<std::thread> others;
    try {
        for (int k = 1; k < std::min(threads, rows); k++) others.emplace_back(run, false);
    } catch (const std::system_error&) {  // no thread to be had: fewer do the same
    }
    run(true);
    for (auto& other : others) other.join();
    if (failure) std::rethrow_exception(failure);
}

}  // namespace graspd

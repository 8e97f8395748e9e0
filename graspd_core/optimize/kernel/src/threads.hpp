// Distributes independent rows of a batch over threads. Results do not depend on the number of threads.
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

// Asks the caller every 2 ms whether to stop. Asks only in the caller's thread, which may hold an interpreter's lock.
class Stop {
   public:
    typedef int32_t (*Poll)(int64_t done);
    explicit Stop(Poll poll) : poll_(poll), next_(Clock::now()) {}

    // Counts a step. Returns false if the step must not run.
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

// Calls work(row, scratch, true in the caller's thread) for every row. The caller's thread takes part. If a thread
// throws, because memory is short, the other threads end and the caller gets the exception.
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
    } catch (const std::system_error&) {  // If no more threads can start, fewer do the work.
    }
    run(true);
    for (auto& other : others) other.join();
    if (failure) std::rethrow_exception(failure);
}

}  // namespace graspd

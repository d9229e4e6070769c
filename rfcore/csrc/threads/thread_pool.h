// A few threads that run numbered tasks. Which thread runs a task never changes its result.
#pragma once

#include <atomic>
#include <condition_variable>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace rfcore {

class ThreadPool {
  public:
    explicit ThreadPool(int threads);
    ~ThreadPool();
    ThreadPool(const ThreadPool&) = delete;
    ThreadPool& operator=(const ThreadPool&) = delete;

    int threads() const { return static_cast<int>(workers_.size()) + 1; }

    // Call task(i) for i in 0..tasks, `batch` neighbours at a time, and wait for all of them.
    // The first exception is rethrown here.
    void run(int tasks, const std::function<void(int)>& task, int batch = 1);

  private:
    void work();
    void drain();

    std::vector<std::thread> workers_;
    std::mutex mutex_;
    std::condition_variable wake_, finished_;
    const std::function<void(int)>* task_ = nullptr;
    int tasks_ = 0, batch_ = 1, busy_ = 0;
    unsigned long generation_ = 0;
    bool stopping_ = false;
    std::atomic<int> next_{0};
    std::exception_ptr failure_;
};

// The share of part `i` of `parts` in 0..n: neighbours meet, together they are everything.
inline int share_begin(int n, int i, int parts) {
    return static_cast<int>(static_cast<long long>(n) * i / parts);
}

}  // namespace rfcore

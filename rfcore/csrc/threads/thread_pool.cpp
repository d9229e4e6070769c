#include "threads/thread_pool.h"

#include <cfenv>

namespace rfcore {
namespace {

// A host that flushes subnormals or rounds otherwise would change the picture.
class DefaultFloatEnvironment {
  public:
    DefaultFloatEnvironment() {
        std::fegetenv(&saved_);
        std::fesetenv(FE_DFL_ENV);
    }
    ~DefaultFloatEnvironment() { std::fesetenv(&saved_); }

  private:
    std::fenv_t saved_;
};

}  // namespace

ThreadPool::ThreadPool(int threads) {
    for (int i = 1; i < threads; ++i) workers_.emplace_back([this] { work(); });
}

ThreadPool::~ThreadPool() {
    {
        const std::lock_guard lock(mutex_);
        stopping_ = true;
    }
    wake_.notify_all();
    for (std::thread& worker : workers_) worker.join();
}

void ThreadPool::run(int tasks, const std::function<void(int)>& task, int batch) {
    if (workers_.empty() || tasks <= batch) {
        const DefaultFloatEnvironment environment;
        for (int i = 0; i < tasks; ++i) task(i);
        return;
    }
    {
        const std::lock_guard lock(mutex_);
        task_ = &task;
        tasks_ = tasks;
        batch_ = batch;
        next_ = 0;
        failure_ = nullptr;
        busy_ = static_cast<int>(workers_.size());
        ++generation_;
    }
    wake_.notify_all();
    drain();
    std::unique_lock lock(mutex_);
    finished_.wait(lock, [this] { return busy_ == 0; });
    if (failure_) std::rethrow_exception(failure_);
}

void ThreadPool::work() {
    unsigned long seen = 0;
    std::unique_lock lock(mutex_);
    for (;;) {
        wake_.wait(lock, [&] { return stopping_ || generation_ != seen; });
        if (stopping_) return;
        seen = generation_;
        lock.unlock();
        drain();
        lock.lock();
        if (--busy_ == 0) finished_.notify_one();
    }
}

void ThreadPool::drain() {
    const DefaultFloatEnvironment environment;
    try {
        for (int first = next_.fetch_add(batch_); first < tasks_;
             first = next_.fetch_add(batch_)) {
            const int last = first + batch_ < tasks_ ? first + batch_ : tasks_;
            for (int i = first; i < last; ++i) (*task_)(i);
        }
    } catch (...) {
        next_ = tasks_;
        const std::lock_guard lock(mutex_);
        if (!failure_) failure_ = std::current_exception();
    }
}

}  // namespace rfcore

#include "threads/wavefront.h"

#include <thread>

namespace rfcore {

void Wavefront::begin(int rows) {
    if (rows > rows_) {
        done_ = std::make_unique<std::atomic<int>[]>(static_cast<size_t>(rows));
        rows_ = rows;
    }
    for (int i = 0; i < rows_; ++i) done_[static_cast<size_t>(i)] = 0;
}

void Wavefront::reached(int row, int columns) {
    done_[static_cast<size_t>(row)].store(columns, std::memory_order_release);
}

void Wavefront::await(int row, int columns) const {
    const std::atomic<int>& done = done_[static_cast<size_t>(row)];
    while (done.load(std::memory_order_acquire) < columns) std::this_thread::yield();
}

}  // namespace rfcore

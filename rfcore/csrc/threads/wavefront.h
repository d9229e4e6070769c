// Rows of a picture worked on at the same time, each some columns behind the row above it.
#pragma once

#include <atomic>
#include <memory>

namespace rfcore {

// How many columns of each row are done. Rows must be begun in order, or `await` may never return.
class Wavefront {
  public:
    // Starts anew with no column of any row done.
    void begin(int rows);
    // The first `columns` of the row are done, and seen by every thread that awaits them.
    void reached(int row, int columns);
    // Waits until the first `columns` of the row are done.
    void await(int row, int columns) const;

  private:
    std::unique_ptr<std::atomic<int>[]> done_;
    int rows_ = 0;
};

}  // namespace rfcore

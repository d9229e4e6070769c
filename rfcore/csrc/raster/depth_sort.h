// Stable radix sort of splats by depth; equal depths keep the order of their ids.
#pragma once

#include <vector>

#include "threads/aligned_buffer.h"
#include "threads/thread_pool.h"
#include "raster/types.h"

namespace rfcore::raster {

class DepthSort {
  public:
    // Sort the items `all` describes; positive floats order as their bits do.
    void sort(ThreadPool& pool, AlignedBuffer<SortItem>& items, const Projected& all);

  private:
    AlignedBuffer<SortItem> other_;
    std::vector<uint32_t> starts_;
};

}  // namespace rfcore::raster

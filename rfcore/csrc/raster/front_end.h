// From Gaussians to depth-ordered lists of splats per tile.
#pragma once

#include <functional>
#include <vector>

#include "raster/aligned_buffer.h"
#include "raster/depth_sort.h"
#include "raster/kernels.h"
#include "raster/thread_pool.h"

namespace rfcore::raster {

class FrontEnd {
  public:
    // Project, sort and bin everything `job` holds; job.splats is filled in here. With
    // `keep_positions`, also record where each splat's entries are, for gathering gradients.
    // Throws std::length_error past 2^30 entries.
    void run(const Kernels& kernels, ThreadPool& pool, ProjectJob job, int blocks,
             bool keep_positions);

    int visible() const { return visible_; }
    uint32_t entry_count() const { return entry_count_; }
    const SortItem* items() const { return items_.data(); }
    const Splat* splats() const { return splats_.data(); }
    const uint32_t* entries() const { return entries_.data(); }
    const uint32_t* tile_offsets() const { return tile_offsets_.data(); }
    // With `keep_positions`: Gaussian `id` has the entries positions()[begin .. end) of its range.
    const EntryRange* ranges() const { return ranges_.data(); }
    const uint32_t* positions() const { return positions_.data(); }

  private:
    void project(const Kernels&, ThreadPool&, const ProjectJob&, int blocks);
    void find_spans(const Kernels&, const Camera&, int part, int parts);
    void count_to_offsets(const Camera&, int parts);
    void scatter(const Camera&, int part, int parts, bool keep_positions);

    AlignedBuffer<Splat> splats_;
    AlignedBuffer<SortItem> items_, projected_;
    DepthSort sort_;
    int visible_ = 0;
    std::vector<std::vector<uint32_t>> spans_;  // per part: the stream of find_spans
    std::vector<uint32_t> part_entries_;        // per part
    AlignedBuffer<uint32_t> tile_next_;         // [parts][tile rows][tile columns + 1]
    AlignedBuffer<uint32_t> tile_offsets_, entries_, positions_;
    AlignedBuffer<EntryRange> ranges_;
    uint32_t entry_count_ = 0;
};

}  // namespace rfcore::raster

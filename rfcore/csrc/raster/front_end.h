// From Gaussians to depth-ordered lists of splats per group of tiles.
#pragma once

#include <vector>

#include "threads/aligned_buffer.h"
#include "raster/depth_sort.h"
#include "raster/kernels.h"
#include "threads/thread_pool.h"

namespace rfcore::raster {

class FrontEnd {
  public:
    // Project, sort and bin everything `job` holds; its results are filled in here. With
    // `keep_positions`, also record where each splat's entries are, for gathering gradients.
    // Throws std::length_error past 2^28 entries.
    void run(const Kernels& kernels, ThreadPool& pool, ProjectJob job, int blocks,
             bool keep_positions);

    int visible() const { return all_.count; }
    // Overlaps of splats and groups of tiles, and of splats and tiles.
    uint32_t entry_count() const { return entry_count_; }
    uint32_t tile_entry_count() const;
    const Splat* splats() const { return splats_.data(); }
    GroupLists lists() const { return {entry_splats_.data(), entry_tiles_.data(), offsets_.data()}; }
    // With `keep_positions`: splat `id` has the entries positions()[begin .. end) of its range.
    const BlockSplats* block_splats() const { return block_splats_.data(); }
    const EntryRange* ranges() const { return ranges_.data(); }
    const uint32_t* positions() const { return positions_.data(); }

  private:
    void project(const Kernels&, ThreadPool&, const ProjectJob&, int blocks);
    void place(const Kernels&, const Camera&, int part, int parts);
    void count_to_offsets(const Camera&, int parts);
    void scatter(const Camera&, int part);
    void scatter_with_positions(const Camera&, int part);

    AlignedBuffer<Splat> splats_;
    AlignedBuffer<Footprint> footprints_;
    AlignedBuffer<BlockSplats> block_splats_;
    AlignedBuffer<SortItem> items_, projected_;
    Projected all_{};
    DepthSort sort_;
    std::vector<std::vector<GroupEntry>> placed_;  // per part, front to back
    std::vector<uint32_t> part_entries_;           // per part
    AlignedBuffer<uint32_t> next_;                 // [parts][slots of a picture]
    AlignedBuffer<uint32_t> offsets_, entry_splats_, entry_tiles_, positions_;
    AlignedBuffer<EntryRange> ranges_;
    uint32_t entry_count_ = 0;
};

}  // namespace rfcore::raster

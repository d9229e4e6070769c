// A hash grid field in memory, and how it is rendered.
#pragma once

#include <cstdint>
#include <vector>

#include "ngp/kernels.h"
#include "threads/aligned_buffer.h"
#include "threads/kept.h"
#include "threads/thread_pool.h"

namespace rfcore::ngp {

// What a field is made of, as files hold it.
struct FieldArrays {
    int levels, hidden;
    uint32_t hashed_entries;       // T, a power of two
    const int32_t* level_cells;    // [levels, 3]
    float centre[3], half[3];      // m
    bool unbounded;
    int occupancy_cells[3];
    const uint32_t* occupancy;     // bits, x fastest
    const float* edges;            // [steps + 1] m
    int steps;
    const float* table;            // [entries, 2]
    const float* matrices;         // the five, one after the other
};

inline int encoded_inputs(int levels) {
    return (kFeatures * levels + kLanes - 1) / kLanes * kLanes;
}
size_t weight_count(int levels, int hidden);
// Entries of the table: a level whose vertices fit has one for each, the others T; whole lanes.
size_t table_entries(int levels, const int32_t* level_cells, uint32_t hashed_entries);

class GridField {
  public:
    explicit GridField(const FieldArrays& arrays);
    GridField(const GridField&) = delete;
    GridField& operator=(const GridField&) = delete;

    const Field& view() const { return field_; }
    float* table() { return table_.data(); }
    float* matrices() { return matrices_.data(); }
    uint32_t* occupancy() { return occupancy_.data(); }
    size_t entries() const { return entries_; }
    size_t weights() const { return weights_; }
    size_t cells() const { return cells_; }
    size_t words() const { return (cells_ + 31) / 32; }

  private:
    Field field_{};
    size_t entries_ = 0, weights_ = 0, cells_ = 0;
    AlignedBuffer<float> table_, matrices_, edges_;
    AlignedBuffer<uint32_t> occupancy_;
};

// Pictures may be drawn at the same time, each with `threads` threads of its own.
class Renderer {
  public:
    Renderer(const FieldArrays& arrays, const Kernels& kernels, int threads);

    // Colour [H, W, 3]; depth and opacity [H, W] both or neither; returns how many samples.
    // `samples_per_ray` 0 takes every occupied step.
    uint64_t render(const Camera& camera, int samples_per_ray, float* colour, float* depth,
                    float* opacity);
    const Kernels& kernels() const { return kernels_; }

  private:
    const Kernels& kernels_;
    int threads_;
    GridField field_;
    Kept<ThreadPool> pools_;
};

}  // namespace rfcore::ngp

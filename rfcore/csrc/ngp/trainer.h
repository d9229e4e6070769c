// A hash grid field being optimised: parameters, Adam's moments and the occupancy grid stay here.
//
// Nothing depends on the number of threads: blocks of rays have a fixed size, the gradients of the
// matrices are summed in the order of the blocks, and every level of the table is one task that
// goes through all samples in order.
#pragma once

#include "ngp/grid_field.h"

namespace rfcore::ngp {

struct Batch {
    const float* origins;     // [rays, 3] m
    const float* directions;  // [rays, 3], unit
    const float* jitter;      // [rays], 0..1
    const float* targets;     // [rays, 3]
    int rays, rays_per_block, samples_per_ray;
};

struct Rates {
    float table, matrices;
    float beta1, beta2, epsilon;
    float decay;  // of the matrices
};

class Trainer {
  public:
    Trainer(const FieldArrays& arrays, const float* peaks, const Kernels& kernels, int threads);

    // Forward and backward of a batch; return the sum of squared errors. The gradients stay until
    // update() or gradients().
    double accumulate(const Batch& batch);
    // Takes one step of Adam and notes what the samples say about the occupancy.
    void update(const Rates& rates, float peak_decay);
    // The gradients of the last accumulate(), which are forgotten.
    void gradients(float* table, float* matrices);
    // Cells whose peak is above the threshold become the occupied ones; return how many.
    uint64_t rebuild_occupancy(float threshold);

    uint64_t samples() const { return samples_; }
    GridField& field() { return field_; }
    const Kernels& kernels() const { return kernels_; }
    // Moments of the table and of the matrices, peaks of the cells.
    float* moments(int which) { return moments_[which].data(); }
    float* peaks() { return peaks_.data(); }
    uint64_t steps() const { return steps_; }
    void set_steps(uint64_t steps) { steps_ = steps; }

  private:
    void reserve(const Batch& batch);
    void sum_matrix_gradients();
    void run_levels(const AdamStep* adam, float peak_decay);
    void visit_cells(float peak_decay);
    AdamStep adam_step(float rate, const Rates& rates) const;

    const Kernels& kernels_;
    ThreadPool pool_;
    GridField field_;
    AlignedBuffer<float> moments_[4];  // table first, second; matrices first, second
    AlignedBuffer<float> table_gradients_, block_gradients_, peaks_;
    AlignedBuffer<Chunk> chunks_;
    std::vector<int> chunk_counts_;
    std::vector<double> losses_;
    int blocks_ = 0, chunks_per_block_ = 0;
    size_t padded_weights_;
    uint64_t samples_ = 0, steps_ = 0;
};

}  // namespace rfcore::ngp

#include "ngp/trainer.h"

#include <cmath>
#include <cstring>

namespace rfcore::ngp {
namespace {

void clear(AlignedBuffer<float>& buffer, size_t count) {
    buffer.reserve(count);
    std::memset(buffer.data(), 0, count * sizeof(float));
}

// beta^n by squaring: the C library's pow may differ between machines.
double power(double beta, uint64_t n) {
    double result = 1.0;
    for (; n != 0; n >>= 1, beta *= beta) {
        if (n & 1) result *= beta;
    }
    return result;
}

}  // namespace

Trainer::Trainer(const FieldArrays& arrays, const float* peaks, const Kernels& kernels,
                 int threads)
    : kernels_(kernels),
      pool_(threads),
      field_(arrays),
      padded_weights_((field_.weights() + kLanes - 1) / kLanes * kLanes) {
    for (int i = 0; i < 2; ++i) clear(moments_[i], kFeatures * field_.entries());
    for (int i = 2; i < 4; ++i) clear(moments_[i], padded_weights_);
    clear(table_gradients_, kFeatures * field_.entries());
    peaks_.reserve(field_.cells());
    std::memcpy(peaks_.data(), peaks, field_.cells() * sizeof(float));
}

void Trainer::reserve(const Batch& batch) {
    blocks_ = (batch.rays + batch.rays_per_block - 1) / batch.rays_per_block;
    // Every round of a block ends with a chunk that may be partly filled.
    chunks_per_block_ = batch.rays_per_block * batch.samples_per_ray / kChunk +
                        batch.samples_per_ray / kRoundSamples + 3;
    chunks_.reserve(static_cast<size_t>(blocks_) * chunks_per_block_);
    block_gradients_.reserve(static_cast<size_t>(blocks_) * padded_weights_);
    chunk_counts_.assign(static_cast<size_t>(blocks_), 0);
    losses_.assign(static_cast<size_t>(blocks_), 0.0);
}

double Trainer::accumulate(const Batch& batch) {
    reserve(batch);
    const TrainJob job{&field_.view(),       batch.origins,
                       batch.directions,     batch.jitter,
                       batch.targets,        batch.rays,
                       batch.rays_per_block, batch.samples_per_ray,
                       chunks_.data(),       chunks_per_block_,
                       chunk_counts_.data(), block_gradients_.data(),
                       padded_weights_,      losses_.data()};
    auto* kernel = kernels_.train_block[field_.view().space.unbounded];
    pool_.run(blocks_, [&](int block) { kernel(job, block); });
    sum_matrix_gradients();
    double loss = 0.0;
    for (const double part : losses_) loss += part;
    samples_ = 0;
    for (int b = 0; b < blocks_; ++b) {
        const Chunk* chunks = chunks_.data() + static_cast<size_t>(b) * chunks_per_block_;
        for (int c = 0; c < chunk_counts_[static_cast<size_t>(b)]; ++c) {
            samples_ += static_cast<uint64_t>(chunks[c].count);
        }
    }
    return loss;
}

// Sums them into the first block's.
void Trainer::sum_matrix_gradients() {
    float* sum = block_gradients_.data();
    for (int b = 1; b < blocks_; ++b) {
        const float* part = sum + static_cast<size_t>(b) * padded_weights_;
        for (size_t i = 0; i < padded_weights_; ++i) sum[i] += part[i];
    }
}

AdamStep Trainer::adam_step(float rate, const Rates& rates) const {
    const double first = 1.0 - power(static_cast<double>(rates.beta1), steps_);
    const double second = 1.0 - power(static_cast<double>(rates.beta2), steps_);
    return {static_cast<float>(static_cast<double>(rate) / first), rates.beta1, rates.beta2,
            rates.epsilon, static_cast<float>(1.0 / second), 0.0f};
}

void Trainer::update(const Rates& rates, float peak_decay) {
    ++steps_;
    AdamStep table = adam_step(rates.table, rates);
    AdamStep matrices = adam_step(rates.matrices, rates);
    matrices.decay = rates.decay;
    run_levels(&table, peak_decay);
    kernels_.adam(matrices, padded_weights_, block_gradients_.data(), field_.matrices(),
                  moments_[2].data(), moments_[3].data());
    blocks_ = 0;
}

void Trainer::run_levels(const AdamStep* adam, float peak_decay) {
    const TableJob job{&field_.view(),     chunks_.data(),          chunk_counts_.data(),
                       chunks_per_block_,  blocks_,                 table_gradients_.data(),
                       field_.table(),     moments_[0].data(),      moments_[1].data(), adam};
    const int levels = field_.view().network.levels;
    // The finest levels take longest; begin with them.
    pool_.run(levels + (adam != nullptr), [&](int task) {
        if (task < levels) {
            kernels_.update_level(job, levels - 1 - task);
        } else {
            visit_cells(peak_decay);
        }
    });
}

void Trainer::gradients(float* table, float* matrices) {
    run_levels(nullptr, 1.0f);
    const size_t count = kFeatures * field_.entries();
    std::memcpy(table, table_gradients_.data(), count * sizeof(float));
    std::memset(table_gradients_.data(), 0, count * sizeof(float));
    std::memcpy(matrices, block_gradients_.data(), field_.weights() * sizeof(float));
    blocks_ = 0;
}

void Trainer::visit_cells(float peak_decay) {
    for (int b = 0; b < blocks_; ++b) {
        const Chunk* chunks = chunks_.data() + static_cast<size_t>(b) * chunks_per_block_;
        for (int c = 0; c < chunk_counts_[static_cast<size_t>(b)]; ++c) {
            const Chunk& chunk = chunks[c];
            for (int s = 0; s < chunk.count; ++s) {
                if (chunk.step[s] < 0.0f) continue;
                float& peak = peaks_[chunk.cell[s]];
                const float faded = peak * peak_decay;
                const float thickness = chunk.density[s] * chunk.step[s];
                peak = thickness > faded ? thickness : faded;
            }
        }
    }
}

uint64_t Trainer::rebuild_occupancy(float threshold) {
    uint64_t occupied = 0;
    uint32_t* words = field_.occupancy();
    for (size_t w = 0; w < field_.words(); ++w) {
        uint32_t word = 0;
        const size_t first = 32 * w;
        const size_t count = field_.cells() - first < 32 ? field_.cells() - first : 32;
        for (size_t i = 0; i < count; ++i) {
            word |= static_cast<uint32_t>(peaks_[first + i] > threshold) << i;
        }
        words[w] = word;
        occupied += static_cast<uint64_t>(__builtin_popcount(word));
    }
    return occupied;
}

}  // namespace rfcore::ngp

// One block of rays of a training step: march, squared error, and the way back to the gradients of
// the matrices and of the encoding. The table is updated afterwards, level by level (adam.h).
#pragma once

#include "ngp/render.h"

namespace {

RF_INLINE void start_block(const TrainJob& job, int first, Rays* rays) {
    for (int r = 0; r < rays->count; ++r) {
        const size_t from = static_cast<size_t>(first + r);
        for (int i = 0; i < 3; ++i) {
            rays->origin[i][r] = job.origins[3 * from + i];
            rays->direction[i][r] = job.directions[3 * from + i];
        }
        rays->jitter[r] = job.jitter[from];
        start_ray(rays, r, job.samples_per_ray);
    }
}

// Gradient of the loss, the mean over rays and channels of the squared error, by the colour.
RF_INLINE double colour_gradient(const TrainJob& job, int first, const Rays& rays,
                                 float (*d_colour)[kBlockRays]) {
    const float scale = 2.0f / (3.0f * static_cast<float>(job.rays));
    double loss = 0.0;
    for (int r = 0; r < rays.count; ++r) {
        for (int c = 0; c < 3; ++c) {
            const float error =
                rays.colour[c][r] - job.targets[3 * static_cast<size_t>(first + r) + c];
            d_colour[c][r] = scale * error;
            loss += static_cast<double>(error) * static_cast<double>(error);
        }
    }
    return loss;
}

// Replay the compositing; leave dL/dcolour in chunk->colour and dL/d(log density) in
// chunk->raw_density. What lies behind a sample is the total minus what came before it.
RF_INLINE void composite_backward(Chunk* chunk, const Rays& total,
                                  const float (*d_colour)[kBlockRays], Rays* replay) {
    for (int s = 0; s < chunk->count; ++s) {
        const int r = chunk->ray[s];
        const float before = replay->transmittance[r];
        const bool far = chunk->step[s] < 0.0f, counts = before >= kMinTransmittance;
        const float alpha = far ? 1.0f : chunk->alpha[s], weight = before * alpha;
        const float after = __builtin_fmaf(-before, alpha, before);
        float d_thickness = 0.0f;
        for (int c = 0; c < 3; ++c) {
            const float colour = chunk->colour[c][s], d = d_colour[c][r];
            chunk->colour[c][s] = counts ? weight * d : 0.0f;
            if (!counts) continue;
            replay->colour[c][r] += weight * colour;
            d_thickness += d * (after * colour - (total.colour[c][r] - replay->colour[c][r]));
        }
        const bool free = counts && !far && chunk->raw_density[s] < kMaxLogDensity;
        chunk->raw_density[s] = free ? d_thickness * chunk->density[s] * chunk->step[s] : 0.0f;
        if (counts && !far) replay->transmittance[r] = after;
    }
    for (int s = chunk->count; s < kChunk; ++s) {
        for (int c = 0; c < 3; ++c) chunk->colour[c][s] = 0.0f;
        chunk->raw_density[s] = 0.0f;
    }
}

static void train_back(const TrainJob& job, int block, const Rays& rays,
                       const float (*d_colour)[kBlockRays], int count) {
    const Network& n = job.field->network;
    float* gradients[kMatrices];
    float* next = job.gradients + static_cast<size_t>(block) * job.weights;
    for (int m = 0; m < kMatrices; ++m) {
        gradients[m] = next;
        next += static_cast<size_t>(outputs_of(m, n.hidden)) * inputs_of(m, n.hidden, n.encoded);
    }
    Rays replay;
    for (int r = 0; r < rays.count; ++r) start_ray(&replay, r, 0);
    Activations activations;
    Cotangents cotangents;
    Chunk* chunks = job.chunks + static_cast<size_t>(block) * job.chunks_per_block;
    for (int c = 0; c < count; ++c) {
        composite_backward(chunks + c, rays, d_colour, &replay);
        network_backward(n, chunks + c, &activations, &cotangents, gradients);
    }
}

template <bool kUnbounded>
static void train_block(const TrainJob& job, int block) {
    Rays rays;
    Activations scratch;
    Chunk* chunks = job.chunks + static_cast<size_t>(block) * job.chunks_per_block;
    const int first = block * job.rays_per_block;
    const int left = job.rays - first;
    rays.count = left < job.rays_per_block ? left : job.rays_per_block;
    rays.windows = nullptr;
    start_block(job, first, &rays);
    int count = 0;
    while (!all_done(rays)) {
        count += march_round<kUnbounded>(*job.field, &rays, chunks + count, &scratch);
    }
    float d_colour[3][kBlockRays];
    job.losses[block] = colour_gradient(job, first, rays, d_colour);
    memset(job.gradients + static_cast<size_t>(block) * job.weights, 0,
           job.weights * sizeof(float));
    train_back(job, block, rays, d_colour, count);
    job.chunk_counts[block] = count;
}

}  // namespace

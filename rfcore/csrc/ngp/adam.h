// Adam on the parameters a step has touched: a gradient of exactly 0 changes nothing.
#pragma once

#include "ngp/encode.h"

namespace {

constexpr float kMaxGradient = 1e15f;

RF_INLINE Mask not_zero(Lanes a) { return gt(absolute(a), zero()); }

// `count` is a multiple of 16. Clears the gradients; one not finite or beyond 1e15 counts as 0.
static void adam(const AdamStep& step, size_t count, float* gradients, float* parameters,
                 float* first_moments, float* second_moments) {
    const Lanes beta1 = splat(step.beta1), beta2 = splat(step.beta2);
    for (size_t i = 0; i < count; i += kLanes) {
        Lanes g = load(gradients + i);
        g = keep(ge(splat(kMaxGradient), absolute(g)), g);
        const Mask touched = not_zero(g);
        store(gradients + i, zero());
        if (!any(touched)) continue;
        const Lanes p = load(parameters + i);
        g = fma(splat(step.decay), p, g);
        const Lanes m = fma(beta1, load(first_moments + i), (splat(1.0f) - beta1) * g);
        const Lanes v = fma(beta2, load(second_moments + i), (splat(1.0f) - beta2) * g * g);
        const Lanes size = sqrt(v * splat(step.second_correction)) + splat(step.epsilon);
        store_where(first_moments + i, touched, m);
        store_where(second_moments + i, touched, v);
        store_where(parameters + i, touched, fnma(splat(step.rate), m / size, p));
    }
}

// One level of the table: gradients of every block in order, then Adam.
static void update_level(const TableJob& job, int l) {
    const Level& level = job.field->level[l];
    const size_t first = kFeatures * level.first, count = kFeatures * level.entries;
    for (int b = 0; b < job.blocks; ++b) {
        const Chunk* chunks = job.chunks + static_cast<size_t>(b) * job.chunks_per_block;
        for (int c = 0; c < job.chunk_counts[b]; ++c) {
            scatter_chunk(level, l, chunks[c], job.gradients + first);
        }
    }
    if (job.adam == nullptr) return;
    adam(*job.adam, count, job.gradients + first, job.table + first, job.first_moments + first,
         job.second_moments + first);
}

}  // namespace

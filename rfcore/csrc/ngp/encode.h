// The multiresolution hash encoding (Mueller et al. 2022, section 3) and its gradient.
#pragma once

#include "ngp/index_lanes.h"
#include "ngp/types.h"

namespace {

using namespace rfcore::ngp;

// The eight vertices around 16 positions on one level, and the weights of the two ends per axis.
struct Vertices {
    Ints part[3][2];
    Lanes weight[3][2];
};

RF_INLINE Vertices vertices_at(const Level& level, const float* const* position, int s) {
    Vertices v;
    for (int axis = 0; axis < 3; ++axis) {
        const Lanes scaled = load(position[axis] + s) * splat(level.cells[axis]);
        const Ints last = splat_int(static_cast<uint32_t>(level.cells[axis]) - 1);
        const Ints low = min(truncate(scaled), last);
        const Lanes above = scaled - to_float(low);
        const Ints factor = splat_int(level.factor[axis]);
        v.part[axis][0] = low * factor;
        v.part[axis][1] = v.part[axis][0] + factor;
        v.weight[axis][0] = splat(1.0f) - above;
        v.weight[axis][1] = above;
    }
    return v;
}

// Corner c has bit 0 along x, bit 1 along y, bit 2 along z.
RF_INLINE Ints index_of(const Level& level, const Vertices& v, int c) {
    const Ints x = v.part[0][c & 1], y = v.part[1][c >> 1 & 1], z = v.part[2][c >> 2];
    return level.dense ? x + (y + z) : (x ^ (y ^ z)) & splat_int(level.mask);
}
RF_INLINE Lanes weight_of(const Vertices& v, int c) {
    return v.weight[0][c & 1] * (v.weight[1][c >> 1 & 1] * v.weight[2][c >> 2]);
}

RF_INLINE void encode_level(const Field& field, int l, Chunk* chunk) {
    const Level& level = field.level[l];
    const float* table = field.table + kFeatures * level.first;
    const float* position[3] = {chunk->position[0], chunk->position[1], chunk->position[2]};
    for (int s = 0; s < kChunk; s += kLanes) {
        const Vertices v = vertices_at(level, position, s);
        Lanes sum[2] = {zero(), zero()};
        for (int c = 0; c < 8; ++c) {
            Lanes first, second;
            gather_pairs(table, index_of(level, v, c), &first, &second);
            const Lanes weight = weight_of(v, c);
            sum[0] = fma(weight, first, sum[0]);
            sum[1] = fma(weight, second, sum[1]);
        }
        store(chunk->encoded[2 * l] + s, sum[0]);
        store(chunk->encoded[2 * l + 1] + s, sum[1]);
    }
}

// Level by level over all chunks, so that one level's table at a time is in the cache.
static void encode(const Field& field, Chunk* chunks, int count) {
    for (int l = 0; l < field.network.levels; ++l) {
        for (int c = 0; c < count; ++c) encode_level(field, l, chunks + c);
    }
    for (int row = kFeatures * field.network.levels; row < field.network.encoded; ++row) {
        for (int c = 0; c < count; ++c) {
            for (int s = 0; s < kChunk; s += kLanes) store(chunks[c].encoded[row] + s, zero());
        }
    }
}

// The two features of an entry, added as one.
typedef float Pair __attribute__((vector_size(8)));

// Add what the samples of a chunk carry back to one level; in the order of the samples.
static void scatter_chunk(const Level& level, int l, const Chunk& chunk, float* gradients) {
    const float* position[3] = {chunk.position[0], chunk.position[1], chunk.position[2]};
    alignas(64) uint32_t index[8][kLanes];
    alignas(64) float weight[8][kLanes];
    for (int s = 0; s < chunk.count; s += kLanes) {
        const Vertices v = vertices_at(level, position, s);
        for (int c = 0; c < 8; ++c) {
            store(index[c], index_of(level, v, c));
            store(weight[c], weight_of(v, c));
        }
        const int count = chunk.count - s < kLanes ? chunk.count - s : kLanes;
        for (int i = 0; i < count; ++i) {
            const Pair d = {chunk.encoded[2 * l][s + i], chunk.encoded[2 * l + 1][s + i]};
            if (d[0] == 0.0f && d[1] == 0.0f) continue;
            for (int c = 0; c < 8; ++c) {
                float* to = gradients + kFeatures * static_cast<size_t>(index[c][i]);
                const Pair w = {weight[c][i], weight[c][i]};
                Pair sum;
                memcpy(&sum, to, sizeof sum);
                sum += w * d;
                memcpy(to, &sum, sizeof sum);
            }
        }
    }
}

}  // namespace

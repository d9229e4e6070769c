// Along the rays: which steps are occupied, where their samples lie, what they add to a pixel.
//
// Step k of a ray reaches from edges[k] to edges[k + 1] metres, and is taken if its middle (or, in
// training, the place the ray's jitter names) lies in an occupied cell. A sample behind a
// transmittance of 1e-4 adds nothing. A ray that leaves an unbounded field with more than that
// left takes one opaque sample at infinity.
#pragma once

#include "ngp/network.h"

namespace {

struct Points {
    Lanes axis[3];
};

RF_INLINE Lanes largest(const Points& x) {
    return max(absolute(x.axis[0]), max(absolute(x.axis[1]), absolute(x.axis[2])));
}
RF_INLINE Lanes unit(Lanes u) { return clamp(u, zero(), splat(1.0f)); }

// Where the points p (metres) lie in the field, 0..1; the mask says which are inside.
template <bool kUnbounded>
RF_INLINE Mask locate(const Space& space, const Points& p, Points* u) {
    Points x;
    for (int i = 0; i < 3; ++i) {
        x.axis[i] = (p.axis[i] - splat(space.centre[i])) * splat(space.inverse_half[i]);
    }
    const Lanes one = splat(1.0f), norm = largest(x);
    if (!kUnbounded) {
        for (int i = 0; i < 3; ++i) u->axis[i] = unit(fma(x.axis[i], splat(0.5f), splat(0.5f)));
        return ge(one, norm);
    }
    Lanes quarter = splat(0.25f);
    if (any(gt(norm, one))) {  // else the same value, without the division
        const Lanes inverse = one / max(norm, one);
        quarter = (splat(2.0f) - inverse) * inverse * splat(0.25f);
    }
    for (int i = 0; i < 3; ++i) u->axis[i] = unit(fma(x.axis[i], quarter, splat(0.5f)));
    return ge(norm, zero());
}

// Where the directions d end, infinitely far away.
RF_INLINE Points locate_at_infinity(const Space& space, const Points& d) {
    Points x, u;
    for (int i = 0; i < 3; ++i) x.axis[i] = d.axis[i] * splat(space.inverse_half[i]);
    const Lanes half = splat(0.5f) / max(largest(x), splat(1e-30f));
    for (int i = 0; i < 3; ++i) u.axis[i] = unit(fma(x.axis[i], half, splat(0.5f)));
    return u;
}

RF_INLINE Ints cell_of(const Occupancy& grid, const Points& u) {
    Ints cell = splat_int(0);
    for (int i = 0; i < 3; ++i) {
        const Ints last = splat_int(static_cast<uint32_t>(grid.cells[i]) - 1);
        const Ints number = min(truncate(u.axis[i] * splat(grid.cells[i])), last);
        cell = cell + number * splat_int(grid.factor[i]);
    }
    return cell;
}

RF_INLINE Points along(const Points& origin, const Points& direction, Lanes distance) {
    Points p;
    for (int i = 0; i < 3; ++i) {
        p.axis[i] = fma(direction.axis[i], distance, origin.axis[i]);
    }
    return p;
}

// Bits of the steps k..k + 15 of ray r that are occupied.
template <bool kUnbounded>
RF_INLINE uint32_t occupied_steps(const Field& field, const Rays& rays, int r, int k) {
    const Lanes low = load(field.edges + k), high = load_unaligned(field.edges + k + 1);
    const Lanes distance = fma(splat(rays.jitter[r]), high - low, low);
    Points origin, direction, u;
    for (int i = 0; i < 3; ++i) {
        origin.axis[i] = splat(rays.origin[i][r]);
        direction.axis[i] = splat(rays.direction[i][r]);
    }
    const Mask inside = locate<kUnbounded>(field.space, along(origin, direction, distance), &u);
    const Mask set = both(inside, test_bits(field.occupancy.bits, cell_of(field.occupancy, u)));
    const int left = field.steps - k;
    return bits(set) & (left >= kLanes ? 0xffffu : (1u << left) - 1);
}

// Chunks being filled with samples, one after the other.
struct Filling {
    Chunk* chunks;
    int count;  // samples so far

    void append(int ray, float distance, float step) {
        Chunk& chunk = chunks[count / kChunk];
        const int s = count % kChunk;
        chunk.ray[s] = ray;
        chunk.distance[s] = distance;
        chunk.step[s] = step;
        chunk.count = s + 1;
        ++count;
    }
    // Fill up the last chunk with samples of nothing; return the number of chunks.
    int close() const {
        const int chunk_count = (count + kChunk - 1) / kChunk;
        for (int i = count; i < chunk_count * kChunk; ++i) {
            Chunk& chunk = chunks[i / kChunk];
            chunk.ray[i % kChunk] = -1;
            chunk.distance[i % kChunk] = 0.0f;
            chunk.step[i % kChunk] = 0.0f;
        }
        return chunk_count;
    }
};

constexpr float kAtInfinity = -1.0f;  // as a step

// How many occupied steps make one sample of ray r, so that `budget` samples reach to its end.
// The occupied steps found on the way are kept in rays->windows.
template <bool kUnbounded>
RF_INLINE int steps_per_sample(const Field& field, Rays* rays, int r, int budget) {
    uint16_t* window = rays->windows + static_cast<size_t>(r) * kMaxWindows;
    int occupied = 0;
    for (int k = 0; k < field.steps; k += kLanes) {
        const uint32_t set = occupied_steps<kUnbounded>(field, *rays, r, k);
        *window++ = static_cast<uint16_t>(set);
        occupied += __builtin_popcount(set);
    }
    return occupied <= budget ? 1 : (occupied + budget - 1) / budget;
}

// The occupied steps of the window of 16 that begins with step `base`.
template <bool kUnbounded>
RF_INLINE uint32_t window_at(const Field& field, const Rays& rays, int r, int base) {
    if (rays.windows == nullptr) return occupied_steps<kUnbounded>(field, rays, r, base);
    return rays.windows[static_cast<size_t>(r) * kMaxWindows + static_cast<size_t>(base / kLanes)];
}

// Append the next samples of ray r, at most a round of them. Up to `skip` occupied steps in a row
// become one sample, but none reaches across a multiple of 16.
template <bool kUnbounded>
static void fill_ray(const Field& field, Rays* rays, int r, Filling* filling) {
    int room = rays->left[r] < kRoundSamples ? rays->left[r] : kRoundSamples;
    int k = rays->cursor[r];
    const int before = filling->count, skip = rays->skip[r];
    while (room > 0 && k < field.steps) {
        const int base = k / kLanes * kLanes;
        uint32_t set = window_at<kUnbounded>(field, *rays, r, base) & (0xffffu << (k - base));
        k = base + kLanes;
        while (set != 0 && room > 0) {
            const int first = __builtin_ctz(set);
            int length = __builtin_ctz(~(set >> first));
            if (length > skip) length = skip;
            const float low = field.edges[base + first], high = field.edges[base + first + length];
            filling->append(r, __builtin_fmaf(rays->jitter[r], high - low, low), high - low);
            set &= ~(((1u << length) - 1) << first);
            --room;
            if (room == 0) k = base + first + length;
        }
    }
    rays->cursor[r] = k;
    rays->left[r] -= filling->count - before;
    if (k >= field.steps && room > 0 && rays->left[r] > 0) {
        if (kUnbounded) filling->append(r, 0.0f, kAtInfinity);
        rays->done[r] = true;
    }
    if (rays->left[r] <= 0) rays->done[r] = true;
}

// Position, direction and cell of every sample of a chunk.
template <bool kUnbounded>
RF_INLINE void place(const Field& field, const Rays& rays, Chunk* chunk) {
    alignas(64) float origin[3][kChunk];
    for (int s = 0; s < kChunk; ++s) {
        const int r = chunk->ray[s] < 0 ? 0 : chunk->ray[s];
        for (int i = 0; i < 3; ++i) {
            origin[i][s] = rays.origin[i][r];
            chunk->direction[i][s] = rays.direction[i][r];
        }
    }
    for (int s = 0; s < kChunk; s += kLanes) {
        Points o, d, u;
        for (int i = 0; i < 3; ++i) {
            o.axis[i] = load(origin[i] + s);
            d.axis[i] = load(chunk->direction[i] + s);
        }
        locate<kUnbounded>(field.space, along(o, d, load(chunk->distance + s)), &u);
        store(chunk->cell + s, cell_of(field.occupancy, u));
        if (kUnbounded) {
            const Mask far = gt(zero(), load(chunk->step + s));
            const Points end = locate_at_infinity(field.space, d);
            for (int i = 0; i < 3; ++i) u.axis[i] = select(far, end.axis[i], u.axis[i]);
        }
        for (int i = 0; i < 3; ++i) store(chunk->position[i] + s, u.axis[i]);
    }
}

// Add the samples of a chunk to their rays, in order.
RF_INLINE void composite(const Chunk& chunk, Rays* rays) {
    for (int s = 0; s < chunk.count; ++s) {
        const int r = chunk.ray[s];
        const float before = rays->transmittance[r];
        if (before < kMinTransmittance) continue;
        const bool far = chunk.step[s] < 0.0f;
        const float weight = far ? before : before * chunk.alpha[s];
        for (int c = 0; c < 3; ++c) rays->colour[c][r] += weight * chunk.colour[c][s];
        if (far) continue;
        rays->depth[r] += weight * chunk.distance[s];
        rays->weight[r] += weight;
        rays->transmittance[r] = __builtin_fmaf(-before, chunk.alpha[s], before);
        if (rays->transmittance[r] < kMinTransmittance) rays->done[r] = true;
    }
}

RF_INLINE void start_ray(Rays* rays, int r, int samples) {
    rays->transmittance[r] = 1.0f;
    for (int c = 0; c < 3; ++c) rays->colour[c][r] = 0.0f;
    rays->depth[r] = rays->weight[r] = 0.0f;
    rays->cursor[r] = 0;
    rays->left[r] = samples;
    rays->skip[r] = 1;
    rays->done[r] = false;
}

// Fill, evaluate and composite one round of every ray that is not done; return its chunks.
template <bool kUnbounded>
static int march_round(const Field& field, Rays* rays, Chunk* chunks, Activations* scratch) {
    Filling filling{chunks, 0};
    for (int r = 0; r < rays->count; ++r) {
        if (!rays->done[r]) fill_ray<kUnbounded>(field, rays, r, &filling);
    }
    const int count = filling.close();
    for (int c = 0; c < count; ++c) place<kUnbounded>(field, *rays, chunks + c);
    evaluate(field, chunks, count, scratch);
    for (int c = 0; c < count; ++c) composite(chunks[c], rays);
    return count;
}

}  // namespace

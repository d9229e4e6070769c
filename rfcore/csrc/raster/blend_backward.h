// Gradients of one tile by replaying its blending front to back.
//
// What lies behind a splat is the final colour minus what has been drawn so far, so no list per
// pixel is kept and nothing is divided by a vanishing transmittance. Gradients are summed over
// the pixels of a tile here and over tiles later, both in a fixed order: no atomics.
#pragma once

#include "raster/tile.h"

namespace {

// The pixels of a tile going back.
struct TileGradient {
    alignas(64) float transmittance[kBlocksPerTile][16];
    alignas(64) float behind[kBlocksPerTile][16];  // dL/dcolour . (colour not yet drawn)
    alignas(64) float red[kBlocksPerTile][16];     // dL/dcolour
    alignas(64) float green[kBlocksPerTile][16];
    alignas(64) float blue[kBlocksPerTile][16];
};

// Per splat of a chunk and lane of the block in hand.
struct Replay {
    alignas(64) float s[(kChunk + kLanes) * 16];       // dL/d(ln alpha)
    alignas(64) float weight[(kChunk + kLanes) * 16];  // alpha T
};

// Up to 16 pixels of a row of the picture and of its gradient; zeros where it has ended.
RF_INLINE void load_pixels(const BlendBackwardJob& job, size_t first, int columns, Lanes* colour,
                           Lanes* d_colour) {
    const size_t pixels = static_cast<size_t>(job.camera->width) * job.camera->height;
    if (columns == kTileSide) {
        load_interleaved(job.colour + 3 * first, colour);
        for (int c = 0; c < 3; ++c) d_colour[c] = load_unaligned(job.d_colour + c * pixels + first);
        return;
    }
    float row[3 * kTileSide] = {}, d_row[3][kTileSide] = {};
    const size_t bytes = static_cast<size_t>(columns) * sizeof(float);
    memcpy(row, job.colour + 3 * first, 3 * bytes);
    load_interleaved(row, colour);
    for (int c = 0; c < 3; ++c) {
        memcpy(d_row[c], job.d_colour + c * pixels + first, bytes);
        d_colour[c] = load_unaligned(d_row[c]);
    }
}

RF_INLINE void store_blocks(const Lanes* rows, float (*plane)[16]) {
    Lanes turned[4], blocks[4];
    rows_from_blocks(rows, turned);
    rows_from_blocks(turned, blocks);  // the inverse is the map applied twice
    for (int j = 0; j < 4; ++j) store(plane[j], blocks[j]);
}

// Read the tile; return the blocks wholly outside the picture as a bit set.
RF_INLINE uint32_t start_gradient(const BlendBackwardJob& job, int tile_x, int tile_y,
                                  TileGradient* g) {
    const int width = job.camera->width, height = job.camera->height;
    const int left = tile_x * kTileSide;
    const int columns = width - left < kTileSide ? width - left : kTileSide;
    for (int block_row = 0; block_row < 4; ++block_row) {
        Lanes red[4], green[4], blue[4], behind[4];
        for (int s = 0; s < kBlockSide; ++s) {
            const int y = tile_y * kTileSide + block_row * kBlockSide + s;
            Lanes colour[3] = {zero(), zero(), zero()}, d[3] = {zero(), zero(), zero()};
            if (y < height) {
                load_pixels(job, static_cast<size_t>(y) * width + left, columns, colour, d);
            }
            red[s] = d[0];
            green[s] = d[1];
            blue[s] = d[2];
            behind[s] = fma(d[0], colour[0], fma(d[1], colour[1], d[2] * colour[2]));
        }
        store_blocks(red, g->red + 4 * block_row);
        store_blocks(green, g->green + 4 * block_row);
        store_blocks(blue, g->blue + 4 * block_row);
        store_blocks(behind, g->behind + 4 * block_row);
    }
    return start_transmittance(*job.camera, tile_x, tile_y, g->transmittance);
}

#if defined(RF_ISA_AVX512)
constexpr int kReplayUnroll = 8;  // 4 take 2 % longer, 2 take 7 %
#else
constexpr int kReplayUnroll = 4;
#endif

// Replay `listed` splats, a multiple of kReplayUnroll, over block `b`; return how many were
// replayed before the block was opaque.
RF_INLINE int replay_block(const TileChunk& chunk, int b, int listed, TileGradient* g,
                           Replay* replay, bool* opaque) {
    const Lanes x = load(kLaneX) + splat(static_cast<float>((b & 3) * kBlockSide));
    const Lanes one = splat(1.0f), max_alpha = splat(kMaxAlpha), min_power = splat(kMinPower);
    const Lanes min_t = splat(kMinTransmittance);
    const Lanes red = load(g->red[b]), green = load(g->green[b]), blue = load(g->blue[b]);
    Lanes t = load(g->transmittance[b]), behind = load(g->behind[b]);
    int k = 0;
    while (k < listed) {
        Lanes alpha[kReplayUnroll];
        Mask free[kReplayUnroll];  // alpha was not clamped
        for (int i = 0; i < kReplayUnroll; ++i) {
            const Lanes p = power_at(chunk.at(k + i), x, b >> 2);
            const Lanes unclamped = alpha_from_log2(p);
            alpha[i] = keep_min(ge(p, min_power), unclamped, max_alpha);
            free[i] = ge(max_alpha, unclamped);
        }
        Mask lit;
        for (int i = 0; i < kReplayUnroll; ++i) {
            const Splat& s = chunk.at(k + i).splat;
            const Lanes after = fnma(t, alpha[i], t);
            lit = gt(after, min_t);
            const Lanes weight = keep_mul(lit, alpha[i], t);
            const Lanes own =
                fma(red, splat(s.red), fma(green, splat(s.green), blue * splat(s.blue)));
            behind = fnma(weight, own, behind);
            const Lanes d_alpha = fnma(behind, reciprocal(one - alpha[i]), t * own);
            store(replay->s + 16 * (k + i), keep_mul(both(lit, free[i]), alpha[i], d_alpha));
            store(replay->weight + 16 * (k + i), weight);
            t = after;
        }
        k += kReplayUnroll;
        t = keep(lit, t);
        if (!any(lit)) break;
    }
    store(g->transmittance[b], t);
    store(g->behind[b], behind);
    *opaque = !any(gt(t, min_t));
    return k;
}

// Moments of s over the pixels of a block, for 16 splats; coordinates relative to the tile.
struct Moments {
    Lanes one, x, y, xx, xy, yy;
};

// `s[lane]` holds pixel `lane` of 16 splats; lane 4 x + y is pixel (x, y) of the block.
RF_INLINE Moments block_moments(const Lanes* s, float left, float top) {
    Lanes column[4], column_y[4], column_yy[4];  // sums of s, s y, s y^2 down each column
    const Lanes two = splat(2.0f), three = splat(3.0f), four = splat(4.0f), nine = splat(9.0f);
    for (int j = 0; j < 4; ++j) {
        const Lanes* c = s + 4 * j;
        column[j] = (c[0] + c[1]) + (c[2] + c[3]);
        column_y[j] = fma(c[3], three, fma(c[2], two, c[1]));
        column_yy[j] = fma(c[3], nine, fma(c[2], four, c[1]));
    }
    const Lanes one = (column[0] + column[1]) + (column[2] + column[3]);
    const Lanes x = fma(column[3], three, fma(column[2], two, column[1]));
    const Lanes xx = fma(column[3], nine, fma(column[2], four, column[1]));
    const Lanes y = (column_y[0] + column_y[1]) + (column_y[2] + column_y[3]);
    const Lanes xy = fma(column_y[3], three, fma(column_y[2], two, column_y[1]));
    const Lanes yy = (column_yy[0] + column_yy[1]) + (column_yy[2] + column_yy[3]);
    const Lanes x0 = splat(left + 0.5f), y0 = splat(top + 0.5f);
    Moments m;
    m.one = one;
    m.x = fma(x0, one, x);
    m.y = fma(y0, one, y);
    m.xx = fma(x0, x + m.x, xx);
    m.yy = fma(y0, y + m.y, yy);
    m.xy = fma(x0, m.y, fma(y0, x, xy));
    return m;
}

// Store nine planes of 16 values and read them back as the first nine floats of 16 rows.
RF_INLINE void planes_to_rows(const Moments& m, Lanes red, Lanes green, Lanes blue, Lanes* rows) {
    alignas(64) float planes[256];
    const Lanes all[9] = {m.one, m.x, m.y, m.xx, m.xy, m.yy, red, green, blue};
    for (int j = 0; j < 9; ++j) store(planes + 16 * j, all[j]);
    for (int j = 9; j < 16; ++j) store(planes + 16 * j, zero());
    transpose(planes, rows);
}

// Add the gradients of the replayed splats of block `b` to their sums over the tile.
RF_INLINE void reduce_block(const TileChunk& chunk, int b, int replayed, const TileGradient& g,
                            Replay* replay, float* sums) {
    constexpr int kStep = static_cast<int>(sizeof(TileEntry));
    const int padded = (replayed + kLanes - 1) / kLanes * kLanes;
    for (int k = replayed; k < padded; ++k) {
        store(replay->s + 16 * k, zero());
        store(replay->weight + 16 * k, zero());
    }
    for (int first = 0; first < replayed; first += kLanes) {
        Lanes lanes[16], rows[16];
        transpose(replay->s + 16 * first, lanes);
        const Moments m = block_moments(lanes, static_cast<float>((b & 3) * kBlockSide),
                                        static_cast<float>((b >> 2) * kBlockSide));
        transpose(replay->weight + 16 * first, lanes);
        Lanes red = zero(), green = zero(), blue = zero();
        for (int lane = 0; lane < kLanes; ++lane) {
            red = fma(lanes[lane], splat(g.red[b][lane]), red);
            green = fma(lanes[lane], splat(g.green[b][lane]), green);
            blue = fma(lanes[lane], splat(g.blue[b][lane]), blue);
        }
        planes_to_rows(m, red, green, blue, rows);
        const int count = replayed - first < kLanes ? replayed - first : kLanes;
        for (int i = 0; i < count; ++i) {
            float* sum = sums + 16 * (chunk.offsets[first + i] / kStep);
            store(sum, load(sum) + rows[i]);
        }
    }
}

// Turn the moments of a chunk, of pixels about the tile's origin, into those of each splat's own
// coordinates (u, v) and add them to those of the group.
RF_INLINE void flush_sums(const TileChunk& chunk, const float* sums, int count, float left,
                          float top, const uint32_t* positions, EntryGradient* gradients) {
    for (int first = 0; first < count; first += kLanes) {
        alignas(64) float centre_x[16], centre_y[16], factor_a[16], factor_b[16], factor_c[16];
        for (int i = 0; i < kLanes; ++i) {
            centre_x[i] = chunk.entries[first + i].splat.centre_x - left;
            centre_y[i] = chunk.entries[first + i].splat.centre_y - top;
            factor_a[i] = chunk.entries[first + i].splat.a;
            factor_b[i] = chunk.entries[first + i].splat.b;
            factor_c[i] = chunk.entries[first + i].splat.c;
        }
        const Lanes a = load(factor_a), b = load(factor_b), c = load(factor_c);
        const Lanes y = load(centre_y);
        const Lanes u = negate(fma(a, load(centre_x), b * y)), v = negate(c * y);  // of the origin
        Lanes sum[16], rows[16];
        transpose(sums + 16 * first, sum);
        const Lanes along_u = fma(a, sum[1], b * sum[2]), along_v = c * sum[2];
        const Lanes mixed = fma(a, sum[4], b * sum[5]);
        Moments m;
        m.one = sum[0];
        m.x = fma(u, m.one, along_u);
        m.y = fma(v, m.one, along_v);
        m.xx = fma(a, fma(a, sum[3], b * sum[4]), fma(b, mixed, u * (along_u + m.x)));
        m.yy = fma(c * c, sum[5], v * (along_v + m.y));
        m.xy = fma(c, mixed, fma(u, along_v, v * m.x));
        planes_to_rows(m, sum[6], sum[7], sum[8], rows);
        const int last = count - first < kLanes ? count - first : kLanes;
        for (int i = 0; i < last; ++i) {
            float* sum = reinterpret_cast<float*>(gradients + positions[first + i]);
            store(sum, load(sum) + rows[i]);
        }
    }
}

static void tile_backward(const BlendBackwardJob& job, const TilePlace& place) {
    const float left = place.left(), top = place.top();
    constexpr uint32_t kAllDone = (1u << kBlocksPerTile) - 1;
    alignas(64) TileChunk chunk;
    TileGradient gradient;
    Replay replay;
    alignas(64) float sums[(kChunk + 1) * 16];  // the last row takes what pads the lists
    TileList list(job.lists, place);
    uint32_t done = start_gradient(job, place.column, place.row, &gradient);
    while (done != kAllDone) {
        const int count = list.find_chunk();
        if (count == 0) break;
        gather(job.splats, list, count, left, top, &chunk);
        find_touching(count, left, top, &chunk);
        memset(sums, 0, sizeof sums);
        for (int b = 0; b < kBlocksPerTile; ++b) {
            if (done >> b & 1) continue;
            const int listed = list_block(&chunk, b, count, kReplayUnroll);
            bool opaque;
            const int replayed = replay_block(chunk, b, listed, &gradient, &replay, &opaque);
            reduce_block(chunk, b, replayed, gradient, &replay, sums);
            if (opaque) done |= 1u << b;
        }
        flush_sums(chunk, sums, count, left, top, list.positions, job.entry_gradients);
    }
}

static void blend_backward(const BlendBackwardJob& job, int group) {
    const uint32_t begin = job.lists.offsets[group], end = job.lists.offsets[group + 1];
    memset(job.entry_gradients + begin, 0, (end - begin) * sizeof(EntryGradient));
    for (int i = 0; i < kTilesPerGroup; ++i) {
        const TilePlace place(*job.camera, group * kTilesPerGroup + i);
        if (place.is_inside(*job.camera)) tile_backward(job, place);
    }
}

}  // namespace

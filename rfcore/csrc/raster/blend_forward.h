// Front-to-back blending of one tile (3DGS eq. 3), one 4x4 block of pixels per vector.
//
// The transmittance T is multiplied on even where it has fallen to 1e-4 and below: it never rises,
// so masking the weights by T > 1e-4 draws exactly what stopping would, and the chain from one
// splat to the next is a single fused multiply-add.
#pragma once

#include "raster/tile.h"

namespace {

#if defined(RF_ISA_AVX512)
constexpr int kUnroll = 4;  // independent alphas in flight: 32 registers hold four
#else
constexpr int kUnroll = 2;
#endif

struct TilePixels {
    alignas(64) float transmittance[kBlocksPerTile][16];
    alignas(64) float red[kBlocksPerTile][16];
    alignas(64) float green[kBlocksPerTile][16];
    alignas(64) float blue[kBlocksPerTile][16];
    alignas(64) float depth[kBlocksPerTile][16];    // sum of w z
    alignas(64) float opacity[kBlocksPerTile][16];  // sum of w
};

// T = 1 inside the picture and 0 outside; return the blocks wholly outside as a bit set.
RF_INLINE uint32_t start_tile(const Camera& camera, int tile_x, int tile_y, TilePixels* pixels) {
    uint32_t done = 0;
    for (int b = 0; b < kBlocksPerTile; ++b) {
        const int left = tile_x * kTileSide + (b & 3) * kBlockSide;
        const int top = tile_y * kTileSide + (b >> 2) * kBlockSide;
        store(pixels->red[b], zero());
        store(pixels->green[b], zero());
        store(pixels->blue[b], zero());
        store(pixels->depth[b], zero());
        store(pixels->opacity[b], zero());
        if (left + kBlockSide <= camera.width && top + kBlockSide <= camera.height) {
            store(pixels->transmittance[b], splat(1.0f));
            continue;
        }
        for (int lane = 0; lane < kLanes; ++lane) {
            const bool inside =
                left + (lane >> 2) < camera.width && top + (lane & 3) < camera.height;
            pixels->transmittance[b][lane] = inside ? 1.0f : 0.0f;
        }
        if (left >= camera.width || top >= camera.height) done |= 1u << b;
    }
    return done;
}

// Blend the listed splats of `chunk` into block `b`; return true once no pixel lets light through.
template <bool kView, bool kCount>
RF_INLINE bool blend_block(const TileChunk& chunk, int b, int listed, TilePixels* pixels,
                           BlendCounts* counts) {
    const Lanes x = load(kLaneX) + splat(static_cast<float>((b & 3) * kBlockSide));
    const Lanes min_power = splat(kMinPower), max_alpha = splat(kMaxAlpha);
    const Lanes min_t = splat(kMinTransmittance);
    Lanes t = load(pixels->transmittance[b]);
    Lanes red = load(pixels->red[b]), green = load(pixels->green[b]), blue = load(pixels->blue[b]);
    Lanes depth = load(pixels->depth[b]), opacity = load(pixels->opacity[b]);
    for (int k = 0; k < listed; k += kUnroll) {
        Lanes alpha[kUnroll];
        for (int i = 0; i < kUnroll; ++i) {
            const Lanes p = power_at(chunk.at(k + i), x, b >> 2);
            alpha[i] = keep_min(ge(p, min_power), alpha_from_log2(p), max_alpha);
        }
        Mask lit;
        for (int i = 0; i < kUnroll; ++i) {
            const Splat& s = chunk.at(k + i).splat;
            const Lanes after = fnma(t, alpha[i], t);
            lit = gt(after, min_t);
            const Lanes weight = keep_mul(lit, alpha[i], t);
            red = fma(weight, splat(s.red), red);
            green = fma(weight, splat(s.green), green);
            blue = fma(weight, splat(s.blue), blue);
            if (kView) {
                depth = fma(weight, splat(s.depth), depth);
                opacity = opacity + weight;
            }
            if (kCount) {
                counts->evaluated += kLanes;
                counts->useful += __builtin_popcount(bits(gt(weight, zero())));
            }
            t = after;
        }
        t = keep(lit, t);  // before it becomes subnormal, which is slow
        if (!any(lit)) break;
    }
    store(pixels->transmittance[b], t);
    store(pixels->red[b], red);
    store(pixels->green[b], green);
    store(pixels->blue[b], blue);
    if (kView) {
        store(pixels->depth[b], depth);
        store(pixels->opacity[b], opacity);
    }
    return !any(gt(t, min_t));
}

// Write the pixels of the tile that are inside the picture.
template <bool kView>
RF_INLINE void write_tile(const BlendJob& job, int tile_x, int tile_y, const TilePixels& pixels) {
    const int width = job.camera->width, height = job.camera->height;
    for (int row = 0; row < kTileSide; ++row) {
        const int y = tile_y * kTileSide + row;
        if (y >= height) break;
        const int columns =
            width - tile_x * kTileSide < kTileSide ? width - tile_x * kTileSide : kTileSide;
        const size_t first = static_cast<size_t>(y) * width + tile_x * kTileSide;
        for (int column = 0; column < columns; ++column) {
            const int b = (row / kBlockSide) * 4 + column / kBlockSide;
            const int lane = 4 * (column % kBlockSide) + row % kBlockSide;
            float* colour = job.colour + 3 * (first + column);
            colour[0] = pixels.red[b][lane];
            colour[1] = pixels.green[b][lane];
            colour[2] = pixels.blue[b][lane];
            if (kView) {
                const float opacity = pixels.opacity[b][lane];
                job.opacity[first + column] = opacity;
                job.depth[first + column] =
                    opacity > 0.0f ? pixels.depth[b][lane] / opacity : 0.0f;
            }
        }
    }
}

template <bool kView, bool kCount>
static void blend(const BlendJob& job, int tile) {
    const int tile_x = tile % job.camera->tiles_x(), tile_y = tile / job.camera->tiles_x();
    const float left = static_cast<float>(tile_x * kTileSide);
    const float top = static_cast<float>(tile_y * kTileSide);
    constexpr uint32_t kAllDone = (1u << kBlocksPerTile) - 1;
    alignas(64) TileChunk chunk;
    TilePixels pixels;
    uint32_t done = start_tile(*job.camera, tile_x, tile_y, &pixels);
    const uint32_t end = job.tile_offsets[tile + 1];
    for (uint32_t e = job.tile_offsets[tile]; e < end && done != kAllDone; e += kChunk) {
        const int count = end - e < kChunk ? static_cast<int>(end - e) : kChunk;
        gather(job.splats, job.entries + e, count, left, top, &chunk);
        find_touching(count, left, top, &chunk);
        if (kCount) job.counts->tile_entries += count;
        for (int b = 0; b < kBlocksPerTile; ++b) {
            if (done >> b & 1) continue;
            const int listed = list_block(&chunk, b, count, kUnroll);
            if (blend_block<kView, kCount>(chunk, b, listed, &pixels, job.counts)) done |= 1u << b;
        }
    }
    write_tile<kView>(job, tile_x, tile_y, pixels);
}

}  // namespace

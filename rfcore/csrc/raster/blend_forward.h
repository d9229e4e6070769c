// Front-to-back blending of one tile (3DGS eq. 3), one 4x4 block of pixels per vector.
//
// The transmittance T is multiplied on even where it has fallen to 1e-4 and below: it never rises,
// so masking the weights by T > 1e-4 draws exactly what stopping would, and the chain from one
// splat to the next is a single fused multiply-add.
#pragma once

#include "raster/tile.h"

namespace {

#if defined(RF_ISA_AVX512)
constexpr int kUnroll = 8;  // independent alphas in flight; 4 take 3 % longer, 2 take 8 %
constexpr int kTailUnroll = 4;
#else
constexpr int kUnroll = 2;
constexpr int kTailUnroll = 2;
#endif

struct TilePixels {
    alignas(64) float transmittance[kBlocksPerTile][16];
    alignas(64) float red[kBlocksPerTile][16];
    alignas(64) float green[kBlocksPerTile][16];
    alignas(64) float blue[kBlocksPerTile][16];
    alignas(64) float depth[kBlocksPerTile][16];    // sum of w z, the sky left out
    alignas(64) float opacity[kBlocksPerTile][16];  // sum of w, the sky left out
};

template <bool kView>
RF_INLINE uint32_t start_tile(const Camera& camera, int tile_x, int tile_y, TilePixels* pixels) {
    for (int b = 0; b < kBlocksPerTile; ++b) {
        store(pixels->red[b], zero());
        store(pixels->green[b], zero());
        store(pixels->blue[b], zero());
        if (kView) {
            store(pixels->depth[b], zero());
            store(pixels->opacity[b], zero());
        }
    }
    return start_transmittance(camera, tile_x, tile_y, pixels->transmittance);
}

// The pixels of a block while splats are blended into it.
struct BlockPixels {
    Lanes t, red, green, blue, depth, opacity;
};

template <bool kView>
RF_INLINE void add_splat(const Splat& s, Lanes weight, BlockPixels* p) {
    p->red = fma(weight, splat(s.red), p->red);
    p->green = fma(weight, splat(s.green), p->green);
    p->blue = fma(weight, splat(s.blue), p->blue);
    if (kView) {
        p->depth = fma(weight, splat(s.depth), p->depth);
        p->opacity = fma(weight, splat(s.surface), p->opacity);
    }
}

// Blend kSplats of `chunk` from `k` on; return whether a pixel still lets light through.
template <bool kView, bool kCount, int kSplats>
RF_INLINE bool blend_splats(const TileChunk& chunk, int k, Lanes x, int block_row, BlockPixels* p,
                            BlendCounts* counts) {
    const Lanes min_power = splat(kMinPower), max_alpha = splat(kMaxAlpha);
    const Lanes min_t = splat(kMinTransmittance);
    Lanes alpha[kSplats];
    for (int i = 0; i < kSplats; ++i) {
        const Lanes power = power_at(chunk.at(k + i), x, block_row);
        alpha[i] = keep_min(ge(power, min_power), alpha_from_log2(power), max_alpha);
    }
    Mask lit;
    for (int i = 0; i < kSplats; ++i) {
        const Lanes after = fnma(p->t, alpha[i], p->t);
        lit = gt(after, min_t);
        const Lanes weight = keep_mul(lit, alpha[i], p->t);
        add_splat<kView>(chunk.at(k + i).splat, weight, p);
        if (kCount) {
            counts->evaluated += kLanes;
            counts->useful += __builtin_popcount(bits(gt(weight, zero())));
        }
        p->t = after;
    }
    p->t = keep(lit, p->t);  // before it becomes subnormal, which is slow
    return any(lit);
}

// Blend the listed splats of `chunk` into block `b`; return true once no pixel lets light through.
template <bool kView, bool kCount>
RF_INLINE bool blend_block(const TileChunk& chunk, int b, int listed, TilePixels* pixels,
                           BlendCounts* counts) {
    const Lanes x = load(kLaneX) + splat(static_cast<float>((b & 3) * kBlockSide));
    BlockPixels p;
    p.t = load(pixels->transmittance[b]);
    p.red = load(pixels->red[b]);
    p.green = load(pixels->green[b]);
    p.blue = load(pixels->blue[b]);
    if (kView) {
        p.depth = load(pixels->depth[b]);
        p.opacity = load(pixels->opacity[b]);
    }
    int k = 0;
    bool lit = true;
    for (; lit && k + kUnroll <= listed; k += kUnroll) {
        lit = blend_splats<kView, kCount, kUnroll>(chunk, k, x, b >> 2, &p, counts);
    }
    for (; lit && k < listed; k += kTailUnroll) {
        lit = blend_splats<kView, kCount, kTailUnroll>(chunk, k, x, b >> 2, &p, counts);
    }
    store(pixels->transmittance[b], p.t);
    store(pixels->red[b], p.red);
    store(pixels->green[b], p.green);
    store(pixels->blue[b], p.blue);
    if (kView) {
        store(pixels->depth[b], p.depth);
        store(pixels->opacity[b], p.opacity);
    }
    return !lit;
}

// Four rows of the tile as rows of 16 pixels.
struct RowsOfBlocks {
    Lanes red[4], green[4], blue[4], depth[4], opacity[4], transmittance[4];
};

RF_INLINE void load_rows(const float (*plane)[16], int block_row, Lanes* rows) {
    Lanes blocks[4];
    for (int j = 0; j < 4; ++j) blocks[j] = load(plane[4 * block_row + j]);
    rows_from_blocks(blocks, rows);
}

// Copy the first `columns` of 16 pixels.
RF_INLINE void store_columns(float* out, Lanes row, int columns) {
    if (columns == kTileSide) {
        store_unaligned(out, row);
        return;
    }
    alignas(64) float all[16];
    store(all, row);
    memcpy(out, all, static_cast<size_t>(columns) * sizeof(float));
}

// Depth and opacity of the surfaces of 16 pixels, given the sums over them; of the sky where that is
// more of what is shown.
struct DepthAndOpacity {
    Lanes depth, opacity;
};

RF_INLINE DepthAndOpacity depth_and_opacity(Lanes weighted, Lanes surfaces, Lanes transmittance) {
    const Lanes mean = keep(gt(surfaces, zero()), weighted / surfaces);
    const Lanes sky = splat(1.0f) - transmittance - surfaces;
    const Mask is_sky = gt(sky, surfaces);
    return {select(is_sky, splat(kSkyM), mean), select(is_sky, sky, surfaces)};
}

// Write the pixels of the tile that are inside the picture.
template <bool kView>
RF_INLINE void write_tile(const BlendJob& job, int tile_x, int tile_y, const TilePixels& pixels) {
    const int width = job.camera->width, height = job.camera->height;
    const int left = tile_x * kTileSide;
    const int columns = width - left < kTileSide ? width - left : kTileSide;
    for (int block_row = 0; block_row < 4; ++block_row) {
        RowsOfBlocks r;
        load_rows(pixels.red, block_row, r.red);
        load_rows(pixels.green, block_row, r.green);
        load_rows(pixels.blue, block_row, r.blue);
        if (kView) {
            load_rows(pixels.depth, block_row, r.depth);
            load_rows(pixels.opacity, block_row, r.opacity);
            load_rows(pixels.transmittance, block_row, r.transmittance);
        }
        for (int s = 0; s < kBlockSide; ++s) {
            const int y = tile_y * kTileSide + block_row * kBlockSide + s;
            if (y >= height) return;
            const size_t first = static_cast<size_t>(y) * width + left;
            if (columns == kTileSide) {
                store_interleaved(job.colour + 3 * first, r.red[s], r.green[s], r.blue[s]);
            } else {
                alignas(64) float row[48];
                store_interleaved(row, r.red[s], r.green[s], r.blue[s]);
                memcpy(job.colour + 3 * first, row, 3 * sizeof(float) * static_cast<size_t>(columns));
            }
            if (kView) {
                const DepthAndOpacity of_row = depth_and_opacity(r.depth[s], r.opacity[s], r.transmittance[s]);
                store_columns(job.opacity + first, of_row.opacity, columns);
                store_columns(job.depth + first, of_row.depth, columns);
            }
        }
    }
}

// Fetch the lines write_tile will touch; by then they are there.
template <bool kView>
RF_INLINE void prefetch_output(const BlendJob& job, int tile_x, int tile_y) {
    const int width = job.camera->width, height = job.camera->height;
    for (int row = 0; row < kTileSide; ++row) {
        const int y = tile_y * kTileSide + row;
        if (y >= height) return;
        const size_t first = static_cast<size_t>(y) * width + tile_x * kTileSide;
        for (int part = 0; part < 3; ++part) {
            __builtin_prefetch(job.colour + 3 * first + 16 * part, 1);
        }
        if (kView) {
            __builtin_prefetch(job.depth + first, 1);
            __builtin_prefetch(job.opacity + first, 1);
        }
    }
}

template <bool kView, bool kCount>
static void blend(const BlendJob& job, int tile) {
    const TilePlace place(*job.camera, tile);
    if (!place.is_inside(*job.camera)) return;
    const float left = place.left(), top = place.top();
    constexpr uint32_t kAllDone = (1u << kBlocksPerTile) - 1;
    alignas(64) TileChunk chunk;
    TilePixels pixels;
    TileList list(job.lists, place);
    uint32_t done = start_tile<kView>(*job.camera, place.column, place.row, &pixels);
    prefetch_output<kView>(job, place.column, place.row);
    while (done != kAllDone) {
        const int count = list.find_chunk();
        if (count == 0) break;
        gather(job.splats, list, count, left, top, &chunk);
        find_touching(count, left, top, &chunk);
        if (kCount) job.counts->tile_entries += count;
        for (int b = 0; b < kBlocksPerTile; ++b) {
            if (done >> b & 1) continue;
            const int listed = list_block(&chunk, b, count, kTailUnroll);
            if (blend_block<kView, kCount>(chunk, b, listed, &pixels, job.counts)) done |= 1u << b;
        }
    }
    write_tile<kView>(job, place.column, place.row, pixels);
}

}  // namespace

// One tile of a picture: a ray through the centre of each of its pixels.
#pragma once

#include "ngp/march.h"

namespace {

constexpr int kUnlimited = 1 << 30;

// Sixteen pixels of one row of the tile.
RF_INLINE void aim_row(const Camera& camera, int x0, int y, Rays* rays, int r, float* z_share) {
    alignas(64) float column[kLanes];
    for (int i = 0; i < kLanes; ++i) column[i] = static_cast<float>(x0 + i) + 0.5f;
    const Lanes one = splat(1.0f);
    const Lanes x = (load(column) - splat(camera.cx)) / splat(camera.fx);
    const Lanes row = splat((static_cast<float>(y) + 0.5f - camera.cy) / camera.fy);
    const Lanes inverse = one / sqrt(fma(x, x, fma(row, row, one)));
    const float* m = camera.rotation;
    for (int i = 0; i < 3; ++i) {
        const Lanes d = fma(splat(m[3 * i]), x,
                            fma(splat(m[3 * i + 1]), row, splat(m[3 * i + 2])));
        store(rays->direction[i] + r, d * inverse);
        store(rays->origin[i] + r, splat(camera.position[i]));
    }
    store(z_share + r, inverse);
}

template <bool kUnbounded>
RF_INLINE void start_tile(const RenderJob& job, int x0, int y0, Rays* rays, float* z_share) {
    rays->count = kBlockRays;
    for (int row = 0; row < kTileSide; ++row) {
        aim_row(*job.camera, x0, y0 + row, rays, row * kTileSide, z_share);
    }
    for (int r = 0; r < kBlockRays; ++r) {
        rays->jitter[r] = 0.5f;
        start_ray(rays, r, kUnlimited);
        const bool outside =
            x0 + r % kTileSide >= job.camera->width || y0 + r / kTileSide >= job.camera->height;
        rays->done[r] = outside;
        if (!outside && job.samples_per_ray > 0) {
            rays->skip[r] =
                steps_per_sample<kUnbounded>(*job.field, rays, r, job.samples_per_ray);
        }
    }
}

RF_INLINE void write_tile(const RenderJob& job, int x0, int y0, const Rays& rays,
                          const float* z_share) {
    const int width = job.camera->width, height = job.camera->height;
    for (int r = 0; r < kBlockRays; ++r) {
        const int x = x0 + r % kTileSide, y = y0 + r / kTileSide;
        if (x >= width || y >= height) continue;
        const size_t pixel = static_cast<size_t>(y) * width + x;
        for (int c = 0; c < 3; ++c) job.colour[3 * pixel + c] = rays.colour[c][r];
        if (job.depth == nullptr) continue;
        const float weight = rays.weight[r];
        job.depth[pixel] = weight > 0.0f ? rays.depth[r] / weight * z_share[r] : 0.0f;
        job.opacity[pixel] = 1.0f - rays.transmittance[r];
    }
}

RF_INLINE bool all_done(const Rays& rays) {
    for (int r = 0; r < rays.count; ++r) {
        if (!rays.done[r]) return false;
    }
    return true;
}

// `chunks`: kRenderChunks of them.
template <bool kUnbounded>
static void render_tile(const RenderJob& job, int tile, Chunk* chunks) {
    const int tiles_x = (job.camera->width + kTileSide - 1) / kTileSide;
    const int x0 = tile % tiles_x * kTileSide, y0 = tile / tiles_x * kTileSide;
    Rays rays;
    Activations scratch;
    alignas(64) float z_share[kBlockRays];
    uint16_t windows[kBlockRays * kMaxWindows];
    rays.windows = job.samples_per_ray > 0 ? windows : nullptr;
    start_tile<kUnbounded>(job, x0, y0, &rays, z_share);
    uint64_t samples = 0;
    while (!all_done(rays)) {
        const int count = march_round<kUnbounded>(*job.field, &rays, chunks, &scratch);
        for (int c = 0; c < count; ++c) samples += static_cast<uint64_t>(chunks[c].count);
    }
    write_tile(job, x0, y0, rays, z_share);
    if (job.samples != nullptr) job.samples[tile] = samples;
}

}  // namespace

// A set of Gaussians ready to be rendered from any camera.
#pragma once

#include <memory>

#include "raster/front_end.h"
#include "threads/kept.h"

namespace rfcore::raster {

// Parameters as they are stored in files: one row per Gaussian.
struct GaussianArrays {
    const float* means;           // [N, 3]
    const float* quaternions;     // [N, 4]
    const float* log_scales;      // [N, 3]
    const float* opacity_logits;  // [N]
    const float* sh;              // [N, K, 3]
    int count;
    int degree;
};

struct Statistics {
    int visible;
    uint32_t tile_entries;          // overlaps of splats and tiles
    uint64_t tile_entries_visited;  // before the tile was opaque
    uint64_t useful_blends;
    uint64_t evaluated_blends;
};

constexpr float kTransparentLogit = -100.0f;  // of lanes without a Gaussian

// Copy `from` into blocks of 16, [blocks][parameter_planes(degree)][16]; the lanes behind the last
// Gaussian are transparent.
void pack_parameters(const GaussianArrays& from, float* blocks);

// Pictures may be drawn at the same time, each with `threads` threads and memory of its own. All
// rasterizers of as many threads share that memory: there is as much of it as pictures were drawn at
// the same time, whatever they showed, and it lives as long as one of them.
class Rasterizer {
  public:
    Rasterizer(const GaussianArrays& gaussians, const Kernels& kernels, int threads,
               bool antialiased);
    // The Gaussians of `other`, drawn with `threads` threads and memory that nobody shares.
    Rasterizer(const Rasterizer& other, int threads);

    // Render colour [H, W, 3] with the first `degree` bands; with depth and opacity [H, W] both
    // or neither.
    void render(const Camera& camera, int degree, float* colour, float* depth, float* opacity);
    // Render with all bands.
    Statistics statistics(const Camera& camera);

    const Kernels& kernels() const { return kernels_; }

  private:
    // The memory that one picture at a time is drawn with.
    struct Workplace {
        explicit Workplace(int threads) : pool(threads) {}
        ThreadPool pool;
        FrontEnd front_end;
    };
    // What drawing reads of each Gaussian.
    struct Prepared {
        AlignedBuffer<float> geometry, harmonics;
    };
    using Workplaces = Kept<Workplace>;
    static std::shared_ptr<Workplaces> shared_workplaces(int threads);
    Workplaces::Loan workplace();
    void run_front_end(Workplace& at, const Camera& camera, int degree) const;

    const Kernels& kernels_;
    int threads_, blocks_, degree_;
    bool antialiased_;
    std::shared_ptr<const Prepared> prepared_;
    std::shared_ptr<Workplaces> workplaces_;
};

// Run `kernel` over every tile of the picture.
void blend_tiles(ThreadPool& pool, void (*kernel)(const BlendJob&, int), const BlendJob& job);

}  // namespace rfcore::raster

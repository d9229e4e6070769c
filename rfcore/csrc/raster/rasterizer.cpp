#include "raster/rasterizer.h"

#include <algorithm>
#include <cstring>
#include <map>
#include <mutex>

namespace rfcore::raster {
namespace {

constexpr int kTilesPerBatch = 4;

void pack_gaussian(const GaussianArrays& from, size_t n, float* lane) {
    const int sh_count = 3 * coefficients_of(from.degree);
    for (size_t k = 0; k < 3; ++k) {
        lane[(kMeanPlane + k) * kLanes] = from.means[3 * n + k];
        lane[(kScalePlane + k) * kLanes] = from.log_scales[3 * n + k];
    }
    for (size_t k = 0; k < 4; ++k) {
        lane[(kQuaternionPlane + k) * kLanes] = from.quaternions[4 * n + k];
    }
    lane[kLogitPlane * kLanes] = from.opacity_logits[n];
    const float* sh = from.sh + n * static_cast<size_t>(sh_count);
    for (int k = 0; k < sh_count; ++k) lane[(kShPlane + k) * kLanes] = sh[k];
}

}  // namespace

void pack_parameters(const GaussianArrays& from, float* blocks) {
    const size_t stride = static_cast<size_t>(parameter_planes(from.degree)) * kLanes;
    const size_t count = static_cast<size_t>(from.count);
    const size_t padded = (count + kLanes - 1) / kLanes * kLanes;
    if (count == 0) return;  // blocks may be null then, which memset may not be given
    std::memset(blocks, 0, padded / kLanes * stride * sizeof(float));
    for (size_t n = 0; n < padded; ++n) {
        float* lane = blocks + n / kLanes * stride + n % kLanes;
        if (n < count) {
            pack_gaussian(from, n, lane);
        } else {
            lane[kLogitPlane * kLanes] = kTransparentLogit;
        }
    }
}

Rasterizer::Rasterizer(const GaussianArrays& gaussians, const Kernels& kernels, int threads,
                       bool antialiased)
    : kernels_(kernels),
      threads_(threads),
      blocks_((gaussians.count + kLanes - 1) / kLanes),
      degree_(gaussians.degree),
      antialiased_(antialiased),
      workplaces_(shared_workplaces(threads)) {
    const int planes = parameter_planes(degree_);
    const size_t stride = static_cast<size_t>(planes) * kLanes;
    const size_t sh_size = static_cast<size_t>(planes - kShPlane) * kLanes;
    AlignedBuffer<float> parameters;
    parameters.reserve(static_cast<size_t>(blocks_) * stride);
    pack_parameters(gaussians, parameters.data());
    const auto prepared = std::make_shared<Prepared>();
    prepared->geometry.reserve(static_cast<size_t>(blocks_) * kGeometryPlanes * kLanes);
    prepared->harmonics.reserve(static_cast<size_t>(blocks_) * sh_size);
    workplace()->pool.run(threads, [&](int part) {
        const int begin = share_begin(blocks_, part, threads);
        const int end = share_begin(blocks_, part + 1, threads);
        kernels_.prepare(parameters.data(), planes, prepared->geometry.data(), begin, end);
    });
    for (size_t b = 0; b < static_cast<size_t>(blocks_); ++b) {
        std::memcpy(prepared->harmonics.data() + b * sh_size,
                    parameters.data() + b * stride + kShPlane * kLanes, sh_size * sizeof(float));
    }
    prepared_ = prepared;
}

Rasterizer::Rasterizer(const Rasterizer& other, int threads)
    : kernels_(other.kernels_),
      threads_(threads),
      blocks_(other.blocks_),
      degree_(other.degree_),
      antialiased_(other.antialiased_),
      prepared_(other.prepared_),
      workplaces_(std::make_shared<Workplaces>()) {}

std::shared_ptr<Rasterizer::Workplaces> Rasterizer::shared_workplaces(int threads) {
    static std::mutex mutex;
    static std::map<int, std::weak_ptr<Workplaces>> by_threads;
    const std::lock_guard lock(mutex);
    std::weak_ptr<Workplaces>& kept = by_threads[threads];
    std::shared_ptr<Workplaces> shared = kept.lock();
    if (shared == nullptr) kept = shared = std::make_shared<Workplaces>();
    return shared;
}

Rasterizer::Workplaces::Loan Rasterizer::workplace() {
    return workplaces_->take([this] { return std::make_unique<Workplace>(threads_); });
}

void Rasterizer::run_front_end(Workplace& at, const Camera& camera, int degree) const {
    ProjectJob job{};
    job.camera = &camera;
    job.geometry = prepared_->geometry.data();
    job.harmonics = prepared_->harmonics.data();
    job.stored_degree = degree_;
    job.degree = degree;
    job.antialiased = antialiased_;
    at.front_end.run(kernels_, at.pool, job, blocks_, false);
}

void Rasterizer::render(const Camera& camera, int degree, float* colour, float* depth,
                        float* opacity) {
    const auto at = workplace();
    run_front_end(*at, camera, degree);
    const BlendJob job{&camera, at->front_end.splats(), at->front_end.lists(), colour,
                       depth,   opacity,                nullptr};
    blend_tiles(at->pool, depth == nullptr ? kernels_.blend_colour : kernels_.blend_view, job);
}

Statistics Rasterizer::statistics(const Camera& camera) {
    const auto at = workplace();
    run_front_end(*at, camera, degree_);
    const FrontEnd& front_end = at->front_end;
    const size_t pixels = static_cast<size_t>(camera.width) * camera.height;
    AlignedBuffer<float> picture;
    picture.reserve(5 * pixels);
    BlendCounts counts{};
    const BlendJob job{&camera,
                       front_end.splats(),
                       front_end.lists(),
                       picture.data(),
                       picture.data() + 3 * pixels,
                       picture.data() + 4 * pixels,
                       &counts};
    const int tiles = camera.groups() * kTilesPerGroup;
    for (int tile = 0; tile < tiles; ++tile) kernels_.blend_counting(job, tile);
    return {front_end.visible(), front_end.tile_entry_count(), counts.tile_entries, counts.useful,
            counts.evaluated};
}

void blend_tiles(ThreadPool& pool, void (*kernel)(const BlendJob&, int), const BlendJob& job) {
    const int tiles = job.camera->groups() * kTilesPerGroup;
    pool.run(tiles, [&](int tile) { kernel(job, tile); }, kTilesPerBatch);
}

}  // namespace rfcore::raster

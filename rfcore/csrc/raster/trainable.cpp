#include "raster/trainable.h"

#include <algorithm>
#include <cstring>

#include "raster/exposure.h"

namespace rfcore::raster {
namespace {

constexpr int kBlocksPerTask = 64;
constexpr int kMinRowsPerStrip = 64;  // a strip computes 20 rows twice

// `from` is the layout of `blocks`, one row per Gaussian; the inverse of pack_parameters.
void unpack_parameters(const float* blocks, const GaussianArrays& to) {
    const size_t stride = static_cast<size_t>(parameter_planes(to.degree)) * kLanes;
    const size_t sh_count = 3 * static_cast<size_t>(coefficients_of(to.degree));
    const auto writable = [](const float* p) { return const_cast<float*>(p); };
    for (size_t n = 0; n < static_cast<size_t>(to.count); ++n) {
        const float* lane = blocks + n / kLanes * stride + n % kLanes;
        for (size_t k = 0; k < 3; ++k) {
            writable(to.means)[3 * n + k] = lane[(kMeanPlane + k) * kLanes];
            writable(to.log_scales)[3 * n + k] = lane[(kScalePlane + k) * kLanes];
        }
        for (size_t k = 0; k < 4; ++k) {
            writable(to.quaternions)[4 * n + k] = lane[(kQuaternionPlane + k) * kLanes];
        }
        writable(to.opacity_logits)[n] = lane[kLogitPlane * kLanes];
        for (size_t k = 0; k < sh_count; ++k) {
            writable(to.sh)[sh_count * n + k] = lane[(kShPlane + k) * kLanes];
        }
    }
}

}  // namespace

TrainableRasterizer::TrainableRasterizer(const GaussianArrays& gaussians, const Kernels& kernels,
                                         int threads, bool antialiased)
    : kernels_(kernels),
      pool_(threads),
      count_(gaussians.count),
      blocks_((gaussians.count + kLanes - 1) / kLanes),
      degree_(gaussians.degree),
      antialiased_(antialiased) {
    make_room(count_);
    pack_parameters(gaussians, parameters_.data());
}

void TrainableRasterizer::forward(const Camera& camera, int degree, float* colour, float* depth,
                                  float* opacity) {
    camera_ = camera;
    active_degree_ = degree;
    ProjectJob job{};
    job.camera = &camera_;
    job.parameters = parameters_.data();
    job.stored_degree = degree_;
    job.degree = degree;
    job.antialiased = antialiased_;
    front_end_.run(kernels_, pool_, job, blocks_, true);
    const BlendJob blend{&camera_, front_end_.splats(), front_end_.lists(), colour,
                         depth,    opacity,             nullptr};
    blend_tiles(pool_, depth == nullptr ? kernels_.blend_colour : kernels_.blend_view, blend);
}

double TrainableRasterizer::loss(const float* colour, const float* target, float dssim_weight) {
    const int width = camera_.width, height = camera_.height;
    const size_t pixels = static_cast<size_t>(width) * height;
    const size_t strip_floats = static_cast<size_t>(kLossRows) * loss_stride(width);
    const int strips = std::clamp(height / kMinRowsPerStrip, 1, pool_.threads());
    const int tasks = 3 * strips;
    d_colour_.reserve(3 * pixels);
    const size_t scratch = strip_floats * static_cast<size_t>(tasks) + kLanes;
    if (loss_scratch_width_ != width || loss_scratch_.size() < scratch) {
        loss_scratch_.assign(scratch, 0.0f);
        loss_scratch_width_ = width;
    }
    row_sums_.assign(6 * static_cast<size_t>(height), 0.0);
    double* const l1 = row_sums_.data();
    double* const dssim = l1 + 3 * static_cast<size_t>(height);
    const LossJob job{width, height, colour, target, dssim_weight, d_colour_.data(), l1, dssim};
    const auto address = reinterpret_cast<uintptr_t>(loss_scratch_.data());
    float* const aligned = reinterpret_cast<float*>((address + 63) / 64 * 64);
    pool_.run(tasks, [&](int task) {
        const int channel = task % 3, strip = task / 3;
        kernels_.loss_strip(job, channel, share_begin(height, strip, strips),
                            share_begin(height, strip + 1, strips),
                            aligned + static_cast<size_t>(task) * strip_floats);
    });
    double l1_sum = 0.0, dssim_sum = 0.0;
    for (int i = 0; i < 3 * height; ++i) {
        l1_sum += l1[i];
        dssim_sum += dssim[i];
    }
    const double weight = static_cast<double>(dssim_weight);
    return ((1.0 - weight) * l1_sum + weight * dssim_sum) / (3.0 * static_cast<double>(pixels));
}

double TrainableRasterizer::exposed_loss(const float* colour, const float* target,
                                         float dssim_weight, const float* affine,
                                         double* d_affine) {
    const size_t pixels = static_cast<size_t>(camera_.width) * camera_.height;
    exposed_.reserve(3 * pixels);
    apply_affine(affine, colour, pixels, exposed_.data());
    const double value = loss(exposed_.data(), target, dssim_weight);
    apply_affine_backward(affine, colour, pixels, d_colour_.data(), d_affine);
    return value;
}

void TrainableRasterizer::set_colour_gradient(const float* d_colour) {
    const size_t pixels = static_cast<size_t>(camera_.width) * camera_.height;
    d_colour_.reserve(3 * pixels);
    for (size_t i = 0; i < pixels; ++i) {
        for (size_t c = 0; c < 3; ++c) d_colour_[c * pixels + i] = d_colour[3 * i + c];
    }
}

void TrainableRasterizer::backward(const float* colour) {
    entry_gradients_.reserve(front_end_.entry_count() + 1);
    const BlendBackwardJob job{&camera_,
                               front_end_.splats(),
                               front_end_.lists(),
                               colour,
                               d_colour_.data(),
                               entry_gradients_.data()};
    pool_.run(camera_.groups(), [&](int group) { kernels_.blend_backward(job, group); });
}

void TrainableRasterizer::project_backward(float* gradients, const AdamStep* adam, float* scores) {
    const ProjectBackwardJob job{&camera_,
                                 parameters_.data(),
                                 degree_,
                                 front_end_.block_splats(),
                                 front_end_.ranges(),
                                 front_end_.positions(),
                                 entry_gradients_.data(),
                                 gradients,
                                 adam,
                                 scores};
    const int tasks = (blocks_ + kBlocksPerTask - 1) / kBlocksPerTask;
    pool_.run(tasks, [&](int task) {
        const int begin = task * kBlocksPerTask;
        kernels_.project_backward[antialiased_][active_degree_](
            job, begin, std::min(blocks_, begin + kBlocksPerTask));
    });
}

void TrainableRasterizer::gradients(const GaussianArrays& out_as_floats) {
    const size_t size =
        static_cast<size_t>(blocks_) * static_cast<size_t>(parameter_planes(degree_)) * kLanes;
    AlignedBuffer<float> blocks;
    blocks.reserve(size);
    std::memset(blocks.data(), 0, size * sizeof(float));
    project_backward(blocks.data(), nullptr, nullptr);
    unpack_parameters(blocks.data(), out_as_floats);
}

// Powers of beta by multiplication: pow() of two C libraries need not agree.
AdamStep TrainableRasterizer::next_step(const LearningRates& rates) {
    beta1_power_ *= static_cast<double>(rates.beta1);
    beta2_power_ *= static_cast<double>(rates.beta2);
    const double first_correction = 1.0 / (1.0 - beta1_power_);
    AdamStep step{};
    step.beta1 = rates.beta1;
    step.beta2 = rates.beta2;
    step.epsilon = rates.epsilon;
    step.opacity_pull = rates.opacity_pull;
    step.scale_pull = rates.scale_pull;
    step.second_correction = static_cast<float>(1.0 / (1.0 - beta2_power_));
    step.first_moments = first_moments_.data();
    step.second_moments = second_moments_.data();
    for (int plane = 0; plane < parameter_planes(degree_); ++plane) {
        const float rate = plane < kScalePlane        ? rates.mean
                           : plane < kQuaternionPlane ? rates.log_scale
                           : plane < kLogitPlane      ? rates.quaternion
                           : plane < kShPlane         ? rates.opacity
                           : plane < kShPlane + 3     ? rates.sh_dc
                                                      : rates.sh_rest;
        step.rate[plane] = static_cast<float>(static_cast<double>(rate) * first_correction);
    }
    return step;
}

void TrainableRasterizer::adam_step(const LearningRates& rates) {
    const AdamStep step = next_step(rates);
    project_backward(nullptr, &step, keep_scores_ ? scores_.data() : nullptr);
}

void TrainableRasterizer::parameters(const GaussianArrays& out_as_floats) const {
    unpack_parameters(parameters_.data(), out_as_floats);
}

void TrainableRasterizer::moments(const GaussianArrays& first_as_floats,
                                  const GaussianArrays& second_as_floats,
                                  double* beta_powers) const {
    unpack_parameters(first_moments_.data(), first_as_floats);
    unpack_parameters(second_moments_.data(), second_as_floats);
    beta_powers[0] = beta1_power_;
    beta_powers[1] = beta2_power_;
}

void TrainableRasterizer::set_moments(const GaussianArrays& first, const GaussianArrays& second,
                                      const double* beta_powers) {
    pack_parameters(first, first_moments_.data());
    pack_parameters(second, second_moments_.data());
    beta1_power_ = beta_powers[0];
    beta2_power_ = beta_powers[1];
}

void TrainableRasterizer::scores(float* out) const {
    for (int n = 0; n < count_; ++n) {
        const float* lane = scores_.data() + n / kLanes * kScorePlanes * kLanes + n % kLanes;
        for (int k = 0; k < kScorePlanes; ++k) out[n * kScorePlanes + k] = lane[k * kLanes];
    }
}

void TrainableRasterizer::set_scores(const float* scores) {
    for (int n = 0; n < count_; ++n) {
        float* lane = scores_.data() + n / kLanes * kScorePlanes * kLanes + n % kLanes;
        for (int k = 0; k < kScorePlanes; ++k) lane[k * kLanes] = scores[n * kScorePlanes + k];
    }
}

TrainableBlocks TrainableRasterizer::blocks() {
    return {parameters_.data(), first_moments_.data(), second_moments_.data(),
            scores_.data(),     count_,                degree_};
}

// Room for `count` Gaussians, transparent behind those that are there; moments and scores zero.
void TrainableRasterizer::make_room(int count) {
    const int wanted = (count + kLanes - 1) / kLanes;
    if (wanted <= room_) return;
    const auto grow = [&](AlignedBuffer<float>& buffer, int planes) {
        const size_t kept = static_cast<size_t>(room_) * static_cast<size_t>(planes) * kLanes;
        const size_t size = static_cast<size_t>(wanted) * static_cast<size_t>(planes) * kLanes;
        AlignedBuffer<float> larger;
        larger.reserve(size);
        if (kept > 0) std::memcpy(larger.data(), buffer.data(), kept * sizeof(float));
        std::memset(larger.data() + kept, 0, (size - kept) * sizeof(float));
        swap(buffer, larger);
    };
    const int planes = parameter_planes(degree_);
    grow(parameters_, planes);
    grow(first_moments_, planes);
    grow(second_moments_, planes);
    grow(scores_, kScorePlanes);
    room_ = wanted;
    hide_lanes_from(count_);
}

// Lanes behind the last Gaussian are transparent.
void TrainableRasterizer::hide_lanes_from(int first) {
    const size_t stride = static_cast<size_t>(parameter_planes(degree_)) * kLanes;
    for (int n = first; n < room_ * kLanes; ++n) {
        float* lane = parameters_.data() + static_cast<size_t>(n / kLanes) * stride + n % kLanes;
        lane[kLogitPlane * kLanes] = kTransparentLogit;
    }
}

void TrainableRasterizer::set_count(int count) {
    count_ = count;
    blocks_ = (count + kLanes - 1) / kLanes;
}

int TrainableRasterizer::control_density(const DensityPlan& plan) {
    make_room(count_ + plan.added);
    const int replaced = rfcore::raster::control_density(blocks(), plan);
    if (replaced >= 0) set_count(count_ + plan.added);
    return std::max(replaced, 0);
}

void TrainableRasterizer::perturb(float strength, uint64_t seed) {
    rfcore::raster::perturb(blocks(), strength, seed);
}

void TrainableRasterizer::order_along_curve() { rfcore::raster::order_along_curve(blocks()); }

void TrainableRasterizer::remove_dead(float dead_logit) {
    set_count(rfcore::raster::remove_dead(blocks(), dead_logit));
    hide_lanes_from(count_);
}

}  // namespace rfcore::raster

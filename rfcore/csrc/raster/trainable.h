// Gaussians being optimised: parameters and Adam's moments stay in blocks from step to step.
#pragma once

#include <vector>

#include "raster/density.h"
#include "raster/rasterizer.h"

namespace rfcore::raster {

struct LearningRates {
    float mean, log_scale, quaternion, opacity, sh_dc, sh_rest;
    float beta1, beta2, epsilon;
    float opacity_pull, scale_pull;  // see AdamStep
};

class TrainableRasterizer {
  public:
    TrainableRasterizer(const GaussianArrays& gaussians, const Kernels& kernels, int threads,
                        bool antialiased);

    // Render with the first `degree` bands; depth and opacity both or neither (null).
    void forward(const Camera& camera, int degree, float* colour, float* depth, float* opacity);
    // L1 + D-SSIM of `colour` against `target` [H, W, 3]; keeps its gradient for backward().
    double loss(const float* colour, const float* target, float dssim_weight);
    // The same with `affine` (exposure.h) applied to `colour`; writes its gradient [12] too.
    double exposed_loss(const float* colour, const float* target, float dssim_weight,
                        const float* affine, double* d_affine);
    // Take a gradient [H, W, 3] instead of a loss.
    void set_colour_gradient(const float* d_colour);
    // Gradients of the splats of `colour`, the picture of the last forward().
    void backward(const float* colour);
    // After backward(): gradients of all parameters in the caller's layout, zero where invisible.
    void gradients(const GaussianArrays& out_as_floats);
    // After backward(): one Adam step for the Gaussians that were visible.
    void adam_step(const LearningRates& rates);
    // The parameters in the caller's layout; Adam's moments in the same.
    void parameters(const GaussianArrays& out_as_floats) const;
    void moments(const GaussianArrays& first_as_floats, const GaussianArrays& second_as_floats,
                 double* beta_powers) const;
    // Continue from moments that moments() returned.
    void set_moments(const GaussianArrays& first, const GaussianArrays& second,
                     const double* beta_powers);
    // Sums since the last density control: [count, kScorePlanes].
    void scores(float* out) const;
    void set_scores(const float* scores);

    // Whether backward passes of a step note what density control by gradient needs.
    void keep_scores(bool keep) { keep_scores_ = keep; }
    // See density.h; the pictures and gradients of earlier calls are void after the first and last.
    int control_density(const DensityPlan& plan);
    void perturb(float strength, uint64_t seed);
    void remove_dead(float dead_logit);
    void order_along_curve();

    int count() const { return count_; }
    int degree() const { return degree_; }
    int width() const { return camera_.width; }
    int height() const { return camera_.height; }
    const Kernels& kernels() const { return kernels_; }

  private:
    void project_backward(float* gradients, const AdamStep* adam, float* scores);
    TrainableBlocks blocks();
    void make_room(int count);
    void hide_lanes_from(int first);
    void set_count(int count);
    AdamStep next_step(const LearningRates& rates);

    const Kernels& kernels_;
    ThreadPool pool_;
    int count_, blocks_, degree_;
    bool antialiased_;
    AlignedBuffer<float> parameters_, first_moments_, second_moments_, scores_;
    int room_ = 0;  // blocks the four have room for
    bool keep_scores_ = false;
    FrontEnd front_end_;
    Camera camera_{};
    int active_degree_ = 0;
    AlignedBuffer<float> d_colour_;  // [3, H, W]
    AlignedBuffer<EntryGradient> entry_gradients_;
    AlignedBuffer<float> exposed_;   // [H, W, 3]
    std::vector<float> loss_scratch_;
    int loss_scratch_width_ = 0;
    std::vector<double> row_sums_;
    double beta1_power_ = 1.0, beta2_power_ = 1.0;  // beta^steps
};

}  // namespace rfcore::raster

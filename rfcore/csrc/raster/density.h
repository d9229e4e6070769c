// Density control: Gaussians that show nothing end, others are split to take their places.
//
// Everything here runs between iterations, in one thread and in double precision from IEEE
// operations alone, so the result depends on neither instruction set nor C library.
#pragma once

#include <cstdint>
#include <vector>

#include "raster/types.h"

namespace rfcore::raster {

// Gaussians being optimised, all in blocks of 16, with room for whatever is added.
struct TrainableBlocks {
    float* parameters;
    float* first_moments;
    float* second_moments;
    float* scores;  // [blocks][kScorePlanes][16]
    int count, degree;
};

enum class SourceRule {
    kOpacity,   // MCMC (Kheradmand et al. 2024): drawn by opacity
    kGradient,  // Kerbl et al. 2023: drawn by the mean gradient of the centre in the picture
};

enum class SplitRule {
    kInPlace,   // MCMC, eq. 9: N copies in place that look like the original
    kLongAxis,  // two halves side by side along the longest axis
};

struct DensityPlan {
    float dead_logit;  // Gaussians at or below this opacity logit are dead
    int added;         // how many to add beyond those that replace the dead
    SourceRule source;
    SplitRule split;
    uint64_t seed;
};

// Replace every dead Gaussian of `blocks` and fill `plan.added` lanes behind the last one, each
// from a living one; scores start anew. Return how many dead were replaced, or -1 when none
// is alive to be split: then nothing happens.
int control_density(const TrainableBlocks& blocks, const DensityPlan& plan);

// Move faint Gaussians at random by up to `strength` of their own deviation (the noise of MCMC,
// eq. 8, in units of the Gaussian; its gate 1 / (1 + e^(100 (o - 0.005)))).
void perturb(const TrainableBlocks& blocks, float strength, uint64_t seed);

// Close the gaps of the dead, order kept; return how many Gaussians are left.
int remove_dead(const TrainableBlocks& blocks, float dead_logit);

// Sort along a Morton curve through the cube around all centres, moments and scores along with
// them: what is near in space is then near in memory, and most blocks are wholly in view or out.
void order_along_curve(const TrainableBlocks& blocks);

// Systematic resampling: item i comes floor or ceil of draws * w_i / sum(w) times, in order.
// `offset` is in 0..1. No weight may be negative, one must be positive.
std::vector<uint32_t> draw_by_weight(const std::vector<double>& weights, int draws, double offset);

}  // namespace rfcore::raster

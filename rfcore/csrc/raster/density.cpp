#include "raster/density.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "raster/portable_math.h"

namespace rfcore::raster {
namespace {

constexpr int kMaxCopies = 50;        // of one Gaussian in one go (the binomials stay exact)
constexpr double kMinOpacity = 1e-4;  // of a copy: below it nothing would ever be seen
constexpr double kMaxOpacity = 1.0 - 1e-6;
// Halves of a Gaussian of deviation 1: together they have 85 % of its variance, its height in the
// middle to 1 % and no dip there.
constexpr double kHalfOffset = 0.7, kHalfScale = 0.6, kHalfOpacity = 0.85;
constexpr double kGateSteepness = 100.0, kGateOpacity = 0.005;
constexpr double kGateClosedLogit = -2.2;  // an opacity of 0.1 moves by e^-9.5 of the strength

constexpr int kCurveBits = 21;             // an axis of the Morton curve; three fit in 64 bits

// SplitMix64 (Steele et al. 2014): a stream that can be entered anywhere.
uint64_t mix(uint64_t x) {
    x += 0x9e3779b97f4a7c15u;
    x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
    x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
    return x ^ (x >> 31);
}
double unit(uint64_t bits) { return static_cast<double>(bits >> 11) * 0x1.0p-53; }

// Close to normal, mean 0 and variance 1: twelve uniform numbers of 16 bits (Irwin-Hall).
double near_normal(uint64_t seed, uint64_t index) {
    uint64_t sum = 0;
    for (uint64_t k = 0; k < 3; ++k) {
        for (uint64_t bits = mix(mix(seed) ^ (3 * index + k)), i = 0; i < 4; ++i, bits >>= 16) {
            sum += bits & 0xffffu;
        }
    }
    return (static_cast<double>(sum) + 6.0) * 0x1.0p-16 - 6.0;
}

// One lane of a block of `planes` planes.
struct Lane {
    float* first;
    float& operator[](int plane) const { return first[plane * kLanes]; }
};

Lane lane_of(float* blocks, int planes, int n) {
    return {blocks + static_cast<size_t>(n / kLanes) * planes * kLanes + n % kLanes};
}
Lane gaussian(const TrainableBlocks& b, int n) {
    return lane_of(b.parameters, parameter_planes(b.degree), n);
}
float logit(const TrainableBlocks& b, int n) { return gaussian(b, n)[kLogitPlane]; }

void set_opacity(const Lane& g, double opacity) {
    const double o = std::clamp(opacity, kMinOpacity, kMaxOpacity);
    g[kLogitPlane] = static_cast<float>(portable_log(o / (1.0 - o)));
}

void copy_lane(const Lane& from, const Lane& to, int planes) {
    for (int k = 0; k < planes; ++k) to[k] = from[k];
}
void clear_lane(const Lane& lane, int planes) {
    for (int k = 0; k < planes; ++k) lane[k] = 0.0f;
}

void clear_moments(const TrainableBlocks& b, int n) {
    const int planes = parameter_planes(b.degree);
    clear_lane(lane_of(b.first_moments, planes, n), planes);
    clear_lane(lane_of(b.second_moments, planes, n), planes);
}

// Column `axis` of the rotation of a Gaussian.
void axis_of(const Lane& g, int axis, double* out) {
    double q[4], norm = 0.0;
    for (int k = 0; k < 4; ++k) {
        q[k] = g[kQuaternionPlane + k];
        norm += q[k] * q[k];
    }
    norm = norm > 1e-24 ? std::sqrt(norm) : 1.0;
    const double w = q[0] / norm, x = q[1] / norm, y = q[2] / norm, z = q[3] / norm;
    const double columns[3][3] = {
        {1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
        {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
        {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}};
    std::copy_n(columns[axis], 3, out);
}

void shift(const Lane& g, int axis, double sigmas) {
    double direction[3];
    axis_of(g, axis, direction);
    const double length = sigmas * portable_exp(static_cast<double>(g[kScalePlane + axis]));
    for (int k = 0; k < 3; ++k) {
        g[kMeanPlane + k] =
            static_cast<float>(static_cast<double>(g[kMeanPlane + k]) + length * direction[k]);
    }
}

void split_along_axis(const TrainableBlocks& b, int from, int to) {
    const Lane source = gaussian(b, from), target = gaussian(b, to);
    int longest = 0;
    for (int k = 1; k < 3; ++k) {
        if (source[kScalePlane + k] > source[kScalePlane + longest]) longest = k;
    }
    set_opacity(source,
                kHalfOpacity * portable_sigmoid(static_cast<double>(source[kLogitPlane])));
    copy_lane(source, target, parameter_planes(b.degree));
    const float narrower = static_cast<float>(portable_log(kHalfScale));
    for (const auto& [half, side] : {std::pair{source, 1.0}, std::pair{target, -1.0}}) {
        shift(half, longest, side * kHalfOffset);
        half[kScalePlane + longest] += narrower;
    }
}

// What `parts` equal Gaussians in place of one of opacity o look like: their opacity, and the
// factor on their scale (Kheradmand et al. 2024, eq. 9).
struct Part {
    double opacity, scale;
};
Part part_of(double o, int parts) {
    const double root = portable_exp(portable_log(1.0 - o) / parts);
    const double small = 1.0 - root;
    double sum = 0.0;
    for (int i = 0; i < parts; ++i) {
        double term = small;  // binomial(i, k) (-1)^k small^(k + 1)
        for (int k = 0; k <= i; ++k) {
            sum += term / std::sqrt(k + 1.0);
            term *= -small * (i - k) / (k + 1.0);
        }
    }
    return {small, o / sum};
}

void split_in_place(const TrainableBlocks& b, int from, const uint32_t* to, int copies) {
    const Lane source = gaussian(b, from);
    const double o = std::clamp(portable_sigmoid(static_cast<double>(source[kLogitPlane])),
                                kMinOpacity, kMaxOpacity);
    const Part part = part_of(o, std::min(copies, kMaxCopies) + 1);
    const float wider = static_cast<float>(portable_log(part.scale));
    set_opacity(source, part.opacity);
    for (int k = 0; k < 3; ++k) source[kScalePlane + k] += wider;
    for (int i = 0; i < copies; ++i) {
        copy_lane(source, gaussian(b, static_cast<int>(to[i])), parameter_planes(b.degree));
    }
}

std::vector<double> source_weights(const TrainableBlocks& b, const DensityPlan& plan) {
    std::vector<double> weights(static_cast<size_t>(b.count), 0.0);
    for (int n = 0; n < b.count; ++n) {
        const float l = logit(b, n);
        if (l <= plan.dead_logit) continue;
        if (plan.source == SourceRule::kOpacity) {
            weights[static_cast<size_t>(n)] = portable_sigmoid(static_cast<double>(l));
        } else {
            const Lane score = lane_of(b.scores, kScorePlanes, n);
            const double visits = score[kVisitsPlane];
            if (visits > 0.0) {
                weights[static_cast<size_t>(n)] =
                    static_cast<double>(score[kGradientPlane]) / visits;
            }
        }
    }
    return weights;
}

std::vector<uint32_t> places_to_fill(const TrainableBlocks& b, const DensityPlan& plan) {
    std::vector<uint32_t> places;
    for (int n = 0; n < b.count; ++n) {
        if (logit(b, n) <= plan.dead_logit) places.push_back(static_cast<uint32_t>(n));
    }
    return places;
}

// Return x with bit i moved to bit 3 i, for the kCurveBits lowest bits.
uint64_t spread_bits(uint64_t x) {
    x = (x | x << 32) & 0x001f00000000ffffu;
    x = (x | x << 16) & 0x001f0000ff0000ffu;
    x = (x | x << 8) & 0x100f00f00f00f00fu;
    x = (x | x << 4) & 0x10c30c30c30c30c3u;
    return (x | x << 2) & 0x1249249249249249u;
}

// Which Gaussian comes first along the curve, which second and so on; equal cells keep their order.
std::vector<uint32_t> curve_order(const TrainableBlocks& b) {
    double low[3], side = 0.0;
    for (int k = 0; k < 3; ++k) {
        double high = std::numeric_limits<double>::lowest();
        low[k] = std::numeric_limits<double>::max();
        for (int n = 0; n < b.count; ++n) {
            const double x = static_cast<double>(gaussian(b, n)[kMeanPlane + k]);
            low[k] = std::min(low[k], x);
            high = std::max(high, x);
        }
        side = std::max(side, high - low[k]);
    }
    constexpr double kLastCell = (1 << kCurveBits) - 1;
    std::vector<std::pair<uint64_t, uint32_t>> places(static_cast<size_t>(b.count));
    for (int n = 0; n < b.count; ++n) {
        uint64_t code = 0;
        for (int k = 0; k < 3; ++k) {
            const double x = static_cast<double>(gaussian(b, n)[kMeanPlane + k]);
            const double cell = (x - low[k]) / side * kLastCell;
            const double inside = cell > 0.0 ? std::min(cell, kLastCell) : 0.0;  // 0 also for NaN
            code |= spread_bits(static_cast<uint64_t>(inside)) << k;
        }
        places[static_cast<size_t>(n)] = {code, static_cast<uint32_t>(n)};
    }
    std::sort(places.begin(), places.end());
    std::vector<uint32_t> order;
    order.reserve(places.size());
    for (const auto& place : places) order.push_back(place.second);
    return order;
}

// Lane i of `part` becomes what lane order[i] was.
void permute(float* part, int planes, const std::vector<uint32_t>& order,
             std::vector<float>* scratch) {
    const size_t blocks = (order.size() + kLanes - 1) / kLanes;
    scratch->assign(part, part + blocks * static_cast<size_t>(planes) * kLanes);
    for (size_t i = 0; i < order.size(); ++i) {
        copy_lane(lane_of(scratch->data(), planes, static_cast<int>(order[i])),
                  lane_of(part, planes, static_cast<int>(i)), planes);
    }
}

}  // namespace

std::vector<uint32_t> draw_by_weight(const std::vector<double>& weights, int draws,
                                     double offset) {
    double total = 0.0;
    for (const double w : weights) total += w;
    const double step = total / draws;
    std::vector<uint32_t> drawn;
    drawn.reserve(static_cast<size_t>(draws));
    double passed = 0.0, next = offset * step;
    uint32_t last = 0;
    for (size_t i = 0; i < weights.size(); ++i) {
        passed += weights[i];
        if (weights[i] > 0.0) last = static_cast<uint32_t>(i);
        while (next < passed && drawn.size() < static_cast<size_t>(draws)) {
            drawn.push_back(static_cast<uint32_t>(i));
            next = (static_cast<double>(drawn.size()) + offset) * step;
        }
    }
    drawn.resize(static_cast<size_t>(draws), last);  // rounding may leave out the last one
    return drawn;
}

int control_density(const TrainableBlocks& blocks, const DensityPlan& plan) {
    const std::vector<double> weights = source_weights(blocks, plan);
    if (std::none_of(weights.begin(), weights.end(), [](double w) { return w > 0.0; })) return -1;
    std::vector<uint32_t> places = places_to_fill(blocks, plan);
    const int dead = static_cast<int>(places.size());
    for (int i = 0; i < plan.added; ++i) {
        places.push_back(static_cast<uint32_t>(blocks.count + i));
    }
    const int draws = static_cast<int>(places.size());
    if (draws == 0) return 0;
    const std::vector<uint32_t> sources = draw_by_weight(weights, draws, unit(mix(plan.seed)));
    for (int i = 0; i < draws;) {
        int end = i;
        while (end < draws && sources[static_cast<size_t>(end)] == sources[static_cast<size_t>(i)]) {
            ++end;
        }
        const int from = static_cast<int>(sources[static_cast<size_t>(i)]);
        const uint32_t* to = places.data() + i;
        if (plan.split == SplitRule::kInPlace) {
            split_in_place(blocks, from, to, end - i);
        } else {
            for (int k = 0; k < end - i; ++k) {
                split_along_axis(blocks, from, static_cast<int>(to[k]));
            }
        }
        clear_moments(blocks, from);
        for (int k = 0; k < end - i; ++k) clear_moments(blocks, static_cast<int>(to[k]));
        i = end;
    }
    const size_t padded = static_cast<size_t>(blocks.count + plan.added + kLanes - 1) / kLanes;
    std::fill_n(blocks.scores, padded * kScorePlanes * kLanes, 0.0f);
    return dead;
}

void perturb(const TrainableBlocks& blocks, float strength, uint64_t seed) {
    for (int n = 0; n < blocks.count; ++n) {
        const Lane g = gaussian(blocks, n);
        const double l = static_cast<double>(g[kLogitPlane]);
        if (l > kGateClosedLogit) continue;
        const double opacity = portable_sigmoid(l);
        const double gate = 1.0 / (1.0 + portable_exp(kGateSteepness * (opacity - kGateOpacity)));
        const auto index = static_cast<uint64_t>(3) * static_cast<uint64_t>(n);
        for (int k = 0; k < 3; ++k) {
            shift(g, k,
                  static_cast<double>(strength) * gate *
                      near_normal(seed, index + static_cast<uint64_t>(k)));
        }
    }
}

void order_along_curve(const TrainableBlocks& blocks) {
    const std::vector<uint32_t> order = curve_order(blocks);
    const int planes = parameter_planes(blocks.degree);
    std::vector<float> scratch;
    for (float* part : {blocks.parameters, blocks.first_moments, blocks.second_moments}) {
        permute(part, planes, order, &scratch);
    }
    permute(blocks.scores, kScorePlanes, order, &scratch);
}

int remove_dead(const TrainableBlocks& blocks, float dead_logit) {
    const int planes = parameter_planes(blocks.degree);
    int kept = 0;
    for (int n = 0; n < blocks.count; ++n) {
        if (logit(blocks, n) <= dead_logit) continue;
        if (kept != n) {
            for (float* part : {blocks.parameters, blocks.first_moments, blocks.second_moments}) {
                copy_lane(lane_of(part, planes, n), lane_of(part, planes, kept), planes);
            }
            copy_lane(lane_of(blocks.scores, kScorePlanes, n),
                      lane_of(blocks.scores, kScorePlanes, kept), kScorePlanes);
        }
        ++kept;
    }
    return kept;
}

}  // namespace rfcore::raster

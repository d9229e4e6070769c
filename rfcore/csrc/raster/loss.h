// L1 and D-SSIM with their gradient, one channel of one strip of rows at a time.
//
// SSIM after Wang et al. 2004: 11x11 Gaussian window of sigma 1.5, zero padding, C1 = 0.01^2,
// C2 = 0.03^2. Rows stream through two rings of 11: blurred moments in, blurred derivatives out,
// all of it in the second-level cache. A row depends on its neighbours alone, so where the strips
// begin changes nothing. Equal pictures have a loss of exactly 0: 1 - SSIM is summed, from terms
// that vanish.
#pragma once

#include "simd/simd.h"
#include "raster/types.h"

namespace {

using namespace rfcore::raster;

constexpr float kC1 = 1e-4f;
constexpr float kC2 = 9e-4f;
constexpr float kTaps[6] = {2.660117249e-01f, 2.130055377e-01f, 1.093606895e-01f,
                            3.600077213e-02f, 7.598758135e-03f, 1.028380084e-03f};

enum Moment { kX, kY, kXX, kYY, kXY, kMoments };
enum Derivative { kByMean = kMoments, kByVariance, kByCovariance };

// Scratch of one strip: rings of blurred rows, then five plain rows.
struct LossRows {
    float* base;
    int stride;
    int width;

    float* ring(int plane_index, int row) const {
        const int slot = (row + kLossRing * 2) % kLossRing;
        return base + static_cast<size_t>(plane_index * kLossRing + slot) * stride + kLossPad;
    }
    float* plain(int index) const {
        return base + static_cast<size_t>(kLossPlanes * kLossRing + index) * stride + kLossPad;
    }
    Mask inside(int x) const {
        return mask_from_bits(x + kLanes <= width ? 0xffffu : (1u << (width - x)) - 1);
    }
};

RF_INLINE void clear_row(const LossRows& rows, float* row) {
    for (int x = 0; x < rows.width; x += kLanes) store(row + x, zero());
}

RF_INLINE void blur_along_row(const LossRows& rows, const float* from, float* to) {
    for (int x = 0; x < rows.width; x += kLanes) {
        Lanes sum = splat(kTaps[0]) * load(from + x);
        for (int k = 1; k <= kLossRadius; ++k) {
            sum = fma(splat(kTaps[k]),
                      load_unaligned(from + x - k) + load_unaligned(from + x + k), sum);
        }
        store(to + x, sum);
    }
}

// Blur of ring `index` across rows, centred on `row`, at column x.
RF_INLINE Lanes blur_across(const LossRows& rows, int index, int row, int x) {
    Lanes sum = splat(kTaps[0]) * load(rows.ring(index, row) + x);
    for (int k = 1; k <= kLossRadius; ++k) {
        sum = fma(splat(kTaps[k]),
                  load(rows.ring(index, row - k) + x) + load(rows.ring(index, row + k) + x), sum);
    }
    return sum;
}

RF_INLINE void read_channel(const float* picture, int width, int row, int channel, float* to) {
    const float* from = picture + 3 * static_cast<size_t>(row) * width + channel;
    for (int x = 0; x < width; ++x) to[x] = from[3 * x];
}

// Row `row` of the two pictures into the ring of moments, blurred along the row.
RF_INLINE void push_moments(const LossJob& job, const LossRows& rows, int channel, int row) {
    if (row < 0 || row >= job.height) {
        for (int i = 0; i < kMoments; ++i) clear_row(rows, rows.ring(i, row));
        return;
    }
    read_channel(job.colour, job.width, row, channel, rows.plain(kX));
    read_channel(job.target, job.width, row, channel, rows.plain(kY));
    for (int x = 0; x < job.width; x += kLanes) {
        const Lanes a = load(rows.plain(kX) + x), b = load(rows.plain(kY) + x);
        store(rows.plain(kXX) + x, a * a);
        store(rows.plain(kYY) + x, b * b);
        store(rows.plain(kXY) + x, a * b);
    }
    for (int i = 0; i < kMoments; ++i) blur_along_row(rows, rows.plain(i), rows.ring(i, row));
}

struct Ssim {
    Lanes dissimilarity;                        // 1 - SSIM
    Lanes by_mean, by_variance, by_covariance;  // of SSIM by E[x], E[x^2], E[x y]
};

RF_INLINE Ssim ssim_at(Lanes mx, Lanes my, Lanes xx, Lanes yy, Lanes xy) {
    const Lanes one = splat(1.0f), two = splat(2.0f);
    const Lanes var_x = max(fnma(mx, mx, xx), zero()), var_y = max(fnma(my, my, yy), zero());
    const Lanes cov = fnma(mx, my, xy);
    const Lanes gap = mx - my, spread = (var_x - cov) + (var_y - cov);
    const Lanes a = fma(two * mx, my, splat(kC1)), b = fma(two, cov, splat(kC2));
    const Lanes inverse_c = one / fma(gap, gap, a);  // mx^2 + my^2 + C1
    const Lanes inverse_d = one / max(b + spread, splat(kC2));  // var_x + var_y + C2
    const Lanes luminance = a * inverse_c, structure = b * inverse_d;
    const Lanes ssim = luminance * structure;
    Ssim s;
    s.dissimilarity = fma(gap * gap, inverse_c, luminance * (spread * inverse_d));
    s.by_variance = negate(ssim * inverse_d);
    s.by_covariance = two * luminance * inverse_d;
    s.by_mean = two * inverse_c * (my * structure - mx * ssim) -
                fma(two * mx, s.by_variance, my * s.by_covariance);
    return s;
}

// Derivatives of the loss by the moments of row `row` into their ring, blurred along the row.
RF_INLINE void push_derivatives(const LossJob& job, const LossRows& rows, int row, double* dssim) {
    if (row < 0 || row >= job.height) {
        for (int i = kByMean; i <= kByCovariance; ++i) clear_row(rows, rows.ring(i, row));
        return;
    }
    const float pixels = static_cast<float>(job.width) * static_cast<float>(job.height);
    const Lanes scale = splat(-job.dssim_weight / (3.0f * pixels));
    float *by_mean = rows.plain(2), *by_variance = rows.plain(3), *by_covariance = rows.plain(4);
    Lanes sum = zero();
    for (int x = 0; x < job.width; x += kLanes) {
        Lanes m[kMoments];
        for (int i = 0; i < kMoments; ++i) m[i] = blur_across(rows, i, row, x);
        const Ssim s = ssim_at(m[kX], m[kY], m[kXX], m[kYY], m[kXY]);
        const Mask inside = rows.inside(x);
        sum = sum + keep(inside, s.dissimilarity);
        store(by_mean + x, keep(inside, scale * s.by_mean));
        store(by_variance + x, keep(inside, scale * s.by_variance));
        store(by_covariance + x, keep(inside, scale * s.by_covariance));
    }
    *dssim = sum_in_order(sum);
    for (int i = 0; i < 3; ++i) blur_along_row(rows, rows.plain(2 + i), rows.ring(kByMean + i, row));
}

// Gradient of row `row`: what the moments carry back, and the sign of the difference.
RF_INLINE void write_gradient(const LossJob& job, const LossRows& rows, int channel, int row) {
    const float pixels = static_cast<float>(job.width) * static_cast<float>(job.height);
    const Lanes l1_scale = splat((1.0f - job.dssim_weight) / (3.0f * pixels));
    float *colour = rows.plain(kX), *target = rows.plain(kY), *out = rows.plain(2);
    read_channel(job.colour, job.width, row, channel, colour);
    read_channel(job.target, job.width, row, channel, target);
    Lanes sum = zero();
    for (int x = 0; x < job.width; x += kLanes) {
        const Lanes a = load(colour + x), b = load(target + x), d = a - b;
        Lanes g = fma(splat(2.0f) * a, blur_across(rows, kByVariance, row, x),
                      fma(b, blur_across(rows, kByCovariance, row, x),
                          blur_across(rows, kByMean, row, x)));
        g = g + keep(gt(d, zero()), l1_scale) - keep(gt(zero(), d), l1_scale);
        sum = sum + keep(rows.inside(x), absolute(d));
        store(out + x, g);
    }
    const size_t first =
        (static_cast<size_t>(channel) * job.height + row) * static_cast<size_t>(job.width);
    memcpy(job.d_colour + first, out, static_cast<size_t>(job.width) * sizeof(float));
    job.l1_of_row[static_cast<size_t>(channel) * job.height + row] = sum_in_order(sum);
}

static void loss_strip(const LossJob& job, int channel, int begin, int end, float* scratch) {
    const LossRows rows = {scratch, loss_stride(job.width), job.width};
    double elsewhere;  // rows outside the strip are counted by the strip that owns them
    for (int row = begin - 2 * kLossRadius; row < end + 2 * kLossRadius; ++row) {
        push_moments(job, rows, channel, row);
        const int middle = row - kLossRadius;
        if (middle < begin - kLossRadius) continue;
        double* dssim = middle >= begin && middle < end
                            ? job.dssim_of_row + static_cast<size_t>(channel) * job.height + middle
                            : &elsewhere;
        push_derivatives(job, rows, middle, dssim);
        const int done = middle - kLossRadius;
        if (done >= begin) write_gradient(job, rows, channel, done);
    }
}

}  // namespace

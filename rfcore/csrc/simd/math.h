// exp2, log2 and the real spherical harmonics on 16 lanes, the same bits everywhere.
#pragma once

#include "simd/simd.h"

namespace {

constexpr float kAlphaBits = 8.0f;

// 2^(p - 8) for 0 <= p < 126 by a degree-4 minimax polynomial on [0, 1), relative error 2.6e-6;
// anything for p < 0. Blending spends a third of its time here; with the offset of 8, log2 of
// every alpha that counts is positive, and there p - floor(p) is a single exact instruction.
RF_INLINE Lanes alpha_from_log2(Lanes p) {
    constexpr float kScale = 1.0f / 256.0f;
    const Lanes f = above_floor_of_positive(p);
    Lanes e = fma(splat(kScale * 1.3534167915e-02f), f, splat(kScale * 5.2011460612e-02f));
    e = fma(e, f, splat(kScale * 2.4144275689e-01f));
    e = fma(e, f, splat(kScale * 6.9300383447e-01f));
    e = fma(e, f, splat(kScale * 1.0000025934e+00f));
    return times_exp2_floor(e, p);
}

// 1 / x for normal x > 0 to 2e-7: a guess from the bits of x within 12 %, then two steps of third
// order. A division of 16 lanes keeps the divider busy for longer than all of this.
RF_INLINE Lanes reciprocal(Lanes x) {
    Lanes r = reciprocal_guess(x);
    for (int step = 0; step < 2; ++step) {
        const Lanes error = fnma(x, r, splat(1.0f));
        r = fma(fma(error, error, error), r, r);
    }
    return r;
}

// 2^p to 1e-7, p clamped to +-120: for scales and opacities.
RF_INLINE Lanes exp2_accurate(Lanes p) {
    p = clamp(p, splat(-120.0f), splat(120.0f));
    const Lanes f = above_floor(p);
    Lanes e = fma(splat(2.1702255472e-04f), f, splat(1.2439687824e-03f));
    e = fma(e, f, splat(9.6788409965e-03f));
    e = fma(e, f, splat(5.5483341984e-02f));
    e = fma(e, f, splat(2.4022983627e-01f));
    e = fma(e, f, splat(6.9314698384e-01f));
    e = fma(e, f, splat(1.0000000019e+00f));
    return times_exp2_floor(e, p);
}

// log2 of normal x > 0: atanh series in s = (m - 1) / (m + 1), minimax, 2e-9 before rounding.
RF_INLINE Lanes log2_accurate(Lanes x) {
    Lanes m;
    const Lanes exponent = split_exponent(x, &m);
    const Lanes s = (m - splat(1.0f)) / (m + splat(1.0f));
    const Lanes z = s * s;
    Lanes r = fma(splat(4.3174903923e-01f), z, splat(5.7671382547e-01f));
    r = fma(r, z, splat(9.6179885343e-01f));
    r = fma(r, z, splat(2.8853900798e+00f));
    return fma(r, s, exponent);
}

constexpr float kLog2E = 1.44269504f;

RF_INLINE Lanes sigmoid(Lanes logit) {
    return splat(1.0f) / (splat(1.0f) + exp2_accurate(logit * splat(-kLog2E)));
}

// Constants of the real basis with the Condon-Shortley phase, in the INRIA order.
constexpr float kSh0 = 0.28209479177387814f;
constexpr float kSh1 = 0.4886025119029199f;
constexpr float kSh2[5] = {1.0925484305920792f, -1.0925484305920792f, 0.31539156525252005f,
                           -1.0925484305920792f, 0.5462742152960396f};
constexpr float kSh3[7] = {-0.5900435899266435f, 2.890611442640554f,  -0.4570457994644658f,
                           0.3731763325901154f,  -0.4570457994644658f, 1.445305721320277f,
                           -0.5900435899266435f};

// basis[k] of the unit vector (x, y, z), k < (kDegree + 1)^2.
template <int kDegree>
RF_INLINE void sh_basis(Lanes x, Lanes y, Lanes z, Lanes* basis) {
    basis[0] = splat(kSh0);
    if (kDegree > 0) {
        basis[1] = splat(-kSh1) * y;
        basis[2] = splat(kSh1) * z;
        basis[3] = splat(-kSh1) * x;
    }
    if (kDegree > 1) {
        const Lanes xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
        basis[4] = splat(kSh2[0]) * xy;
        basis[5] = splat(kSh2[1]) * yz;
        basis[6] = splat(kSh2[2]) * (splat(2.0f) * zz - xx - yy);
        basis[7] = splat(kSh2[3]) * xz;
        basis[8] = splat(kSh2[4]) * (xx - yy);
        if (kDegree > 2) {
            const Lanes three = splat(3.0f);
            const Lanes f = splat(4.0f) * zz - xx - yy;
            basis[9] = splat(kSh3[0]) * y * (three * xx - yy);
            basis[10] = splat(kSh3[1]) * xy * z;
            basis[11] = splat(kSh3[2]) * y * f;
            basis[12] = splat(kSh3[3]) * z * (splat(2.0f) * zz - three * xx - three * yy);
            basis[13] = splat(kSh3[4]) * x * f;
            basis[14] = splat(kSh3[5]) * z * (xx - yy);
            basis[15] = splat(kSh3[6]) * x * (xx - three * yy);
        }
    }
}

}  // namespace

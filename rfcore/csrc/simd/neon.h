// Sixteen lanes as four 128-bit registers (AArch64 Advanced SIMD).
#pragma once

#include <arm_neon.h>

namespace {

struct Lanes {
    float32x4_t q[4];
};
struct Mask {
    uint32x4_t q[4];
};

#define RF_QUARTERS for (int i = 0; i < 4; ++i)
RF_INLINE Lanes splat(float x) {
    const float32x4_t q = vdupq_n_f32(x);
    return {{q, q, q, q}};
}
RF_INLINE Lanes load(const float* p) {
    return {{vld1q_f32(p), vld1q_f32(p + 4), vld1q_f32(p + 8), vld1q_f32(p + 12)}};
}
RF_INLINE Lanes load_unaligned(const float* p) { return load(p); }
RF_INLINE Lanes load_repeated(const float* p) {
    const float32x4_t q = vld1q_f32(p);
    return {{q, q, q, q}};
}
RF_INLINE void store(float* p, Lanes x) { RF_QUARTERS vst1q_f32(p + 4 * i, x.q[i]); }
RF_INLINE void store_unaligned(float* p, Lanes x) { store(p, x); }

#define RF_BINARY(name, expression)                  \
    RF_INLINE Lanes name(Lanes x, Lanes y) {         \
        RF_QUARTERS x.q[i] = expression;             \
        return x;                                    \
    }
RF_BINARY(operator+, vaddq_f32(x.q[i], y.q[i]))
RF_BINARY(operator-, vsubq_f32(x.q[i], y.q[i]))
RF_BINARY(operator*, vmulq_f32(x.q[i], y.q[i]))
RF_BINARY(operator/, vdivq_f32(x.q[i], y.q[i]))
// Not vminq/vmaxq: those return NaN where x86 returns the second operand.
RF_BINARY(min, vbslq_f32(vcltq_f32(x.q[i], y.q[i]), x.q[i], y.q[i]))
RF_BINARY(max, vbslq_f32(vcgtq_f32(x.q[i], y.q[i]), x.q[i], y.q[i]))
#undef RF_BINARY
RF_INLINE Lanes fma(Lanes x, Lanes y, Lanes z) {
    RF_QUARTERS z.q[i] = vfmaq_f32(z.q[i], x.q[i], y.q[i]);
    return z;
}
RF_INLINE Lanes fnma(Lanes x, Lanes y, Lanes z) {
    RF_QUARTERS z.q[i] = vfmsq_f32(z.q[i], x.q[i], y.q[i]);
    return z;
}
RF_INLINE Lanes sqrt(Lanes x) {
    RF_QUARTERS x.q[i] = vsqrtq_f32(x.q[i]);
    return x;
}

RF_INLINE Mask ge(Lanes x, Lanes y) {
    Mask m;
    RF_QUARTERS m.q[i] = vcgeq_f32(x.q[i], y.q[i]);
    return m;
}
RF_INLINE Mask gt(Lanes x, Lanes y) {
    Mask m;
    RF_QUARTERS m.q[i] = vcgtq_f32(x.q[i], y.q[i]);
    return m;
}
RF_INLINE Mask both(Mask x, Mask y) {
    RF_QUARTERS x.q[i] = vandq_u32(x.q[i], y.q[i]);
    return x;
}
RF_INLINE uint32_t bits(Mask m) {
    const uint32_t weights[4] = {1, 2, 4, 8};
    const uint32x4_t weight = vld1q_u32(weights);
    uint32_t all = 0;
    RF_QUARTERS all |= vaddvq_u32(vandq_u32(m.q[i], weight)) << (4 * i);
    return all;
}
RF_INLINE Mask mask_from_bits(uint32_t set) {
    const uint32_t weights[4] = {1, 2, 4, 8};
    const uint32x4_t weight = vld1q_u32(weights);
    Mask m;
    RF_QUARTERS m.q[i] = vtstq_u32(vdupq_n_u32(set >> (4 * i)), weight);
    return m;
}
RF_INLINE Lanes select(Mask m, Lanes x, Lanes y) {
    RF_QUARTERS x.q[i] = vbslq_f32(m.q[i], x.q[i], y.q[i]);
    return x;
}
RF_INLINE Lanes keep(Mask m, Lanes x) { return select(m, x, splat(0.0f)); }
RF_INLINE Lanes keep_min(Mask m, Lanes x, Lanes y) { return keep(m, min(x, y)); }
RF_INLINE Lanes keep_mul(Mask m, Lanes x, Lanes y) { return keep(m, x * y); }
RF_INLINE void store_where(float* p, Mask m, Lanes x) { store(p, select(m, x, load(p))); }

RF_INLINE Lanes above_floor(Lanes p) {
    RF_QUARTERS p.q[i] = vsubq_f32(p.q[i], vrndmq_f32(p.q[i]));
    return p;
}
RF_INLINE Lanes above_floor_of_positive(Lanes p) { return above_floor(p); }
RF_INLINE Lanes reciprocal_guess(Lanes x) {
    const int32x4_t magic = vdupq_n_s32(0x7ef311c3);
    RF_QUARTERS {
        x.q[i] = vreinterpretq_f32_s32(vsubq_s32(magic, vreinterpretq_s32_f32(x.q[i])));
    }
    return x;
}
RF_INLINE Lanes times_exp2_floor(Lanes x, Lanes p) {
    RF_QUARTERS {
        const int32x4_t exponent = vshlq_n_s32(vcvtmq_s32_f32(p.q[i]), 23);
        x.q[i] = vreinterpretq_f32_s32(vaddq_s32(vreinterpretq_s32_f32(x.q[i]), exponent));
    }
    return x;
}
RF_INLINE Lanes split_exponent(Lanes x, Lanes* mantissa) {
    const int32x4_t root_half = vdupq_n_s32(0x3f3504f3);
    RF_QUARTERS {
        const int32x4_t shifted = vsubq_s32(vreinterpretq_s32_f32(x.q[i]), root_half);
        const int32x4_t fraction = vandq_s32(shifted, vdupq_n_s32(0x007fffff));
        mantissa->q[i] = vreinterpretq_f32_s32(vaddq_s32(fraction, root_half));
        x.q[i] = vcvtq_f32_s32(vshrq_n_s32(shifted, 23));
    }
    return x;
}

RF_INLINE int append_offsets(uint16_t* out, uint32_t mask, int base, int step) {
    int count = 0;
    for (; mask != 0; mask &= mask - 1) {
        out[count++] = static_cast<uint16_t>(base + step * __builtin_ctz(mask));
    }
    return count;
}
RF_INLINE void transpose(const float* rows, Lanes* columns) {
    alignas(64) float turned[256];
    for (int i = 0; i < 16; ++i) {
        for (int j = 0; j < 16; ++j) turned[16 * j + i] = rows[16 * i + j];
    }
    for (int j = 0; j < 16; ++j) columns[j] = load(turned + 16 * j);
}
#undef RF_QUARTERS

}  // namespace

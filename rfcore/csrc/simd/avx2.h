// Sixteen lanes as two 256-bit registers (AVX2 and FMA).
#pragma once

#include <immintrin.h>

namespace {

struct Lanes {
    __m256 a, b;
};
struct Mask {
    __m256 a, b;
};

RF_INLINE Lanes splat(float x) { return {_mm256_set1_ps(x), _mm256_set1_ps(x)}; }
RF_INLINE Lanes load(const float* p) { return {_mm256_load_ps(p), _mm256_load_ps(p + 8)}; }
RF_INLINE Lanes load_unaligned(const float* p) {
    return {_mm256_loadu_ps(p), _mm256_loadu_ps(p + 8)};
}
RF_INLINE Lanes load_repeated(const float* p) {
    const __m256 four = _mm256_broadcast_ps(reinterpret_cast<const __m128*>(p));
    return {four, four};
}
RF_INLINE void store(float* p, Lanes x) {
    _mm256_store_ps(p, x.a);
    _mm256_store_ps(p + 8, x.b);
}
RF_INLINE void store_unaligned(float* p, Lanes x) {
    _mm256_storeu_ps(p, x.a);
    _mm256_storeu_ps(p + 8, x.b);
}
RF_INLINE void store_where(float* p, Mask m, Lanes x) {
    _mm256_maskstore_ps(p, _mm256_castps_si256(m.a), x.a);
    _mm256_maskstore_ps(p + 8, _mm256_castps_si256(m.b), x.b);
}

#define RF_BOTH(op) {op(x.a, y.a), op(x.b, y.b)}
RF_INLINE Lanes operator+(Lanes x, Lanes y) { return RF_BOTH(_mm256_add_ps); }
RF_INLINE Lanes operator-(Lanes x, Lanes y) { return RF_BOTH(_mm256_sub_ps); }
RF_INLINE Lanes operator*(Lanes x, Lanes y) { return RF_BOTH(_mm256_mul_ps); }
RF_INLINE Lanes operator/(Lanes x, Lanes y) { return RF_BOTH(_mm256_div_ps); }
RF_INLINE Lanes min(Lanes x, Lanes y) { return RF_BOTH(_mm256_min_ps); }
RF_INLINE Lanes max(Lanes x, Lanes y) { return RF_BOTH(_mm256_max_ps); }
RF_INLINE Mask both(Mask x, Mask y) { return RF_BOTH(_mm256_and_ps); }
#undef RF_BOTH
RF_INLINE Lanes fma(Lanes x, Lanes y, Lanes z) {
    return {_mm256_fmadd_ps(x.a, y.a, z.a), _mm256_fmadd_ps(x.b, y.b, z.b)};
}
RF_INLINE Lanes fnma(Lanes x, Lanes y, Lanes z) {
    return {_mm256_fnmadd_ps(x.a, y.a, z.a), _mm256_fnmadd_ps(x.b, y.b, z.b)};
}
RF_INLINE Lanes sqrt(Lanes x) { return {_mm256_sqrt_ps(x.a), _mm256_sqrt_ps(x.b)}; }

RF_INLINE Mask ge(Lanes x, Lanes y) {
    return {_mm256_cmp_ps(x.a, y.a, _CMP_GE_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_GE_OQ)};
}
RF_INLINE Mask gt(Lanes x, Lanes y) {
    return {_mm256_cmp_ps(x.a, y.a, _CMP_GT_OQ), _mm256_cmp_ps(x.b, y.b, _CMP_GT_OQ)};
}
RF_INLINE uint32_t bits(Mask m) {
    return static_cast<uint32_t>(_mm256_movemask_ps(m.a)) |
           static_cast<uint32_t>(_mm256_movemask_ps(m.b)) << 8;
}
RF_INLINE __m256 half_mask_from_bits(uint32_t m) {
    const __m256i bit = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
    const __m256i present = _mm256_and_si256(_mm256_set1_epi32(static_cast<int>(m)), bit);
    return _mm256_castsi256_ps(_mm256_cmpeq_epi32(present, bit));
}
RF_INLINE Mask mask_from_bits(uint32_t m) {
    return {half_mask_from_bits(m & 255), half_mask_from_bits(m >> 8)};
}
RF_INLINE Lanes select(Mask m, Lanes x, Lanes y) {
    return {_mm256_blendv_ps(y.a, x.a, m.a), _mm256_blendv_ps(y.b, x.b, m.b)};
}
RF_INLINE Lanes keep(Mask m, Lanes x) {
    return {_mm256_and_ps(m.a, x.a), _mm256_and_ps(m.b, x.b)};
}
RF_INLINE Lanes keep_min(Mask m, Lanes x, Lanes y) { return keep(m, min(x, y)); }
RF_INLINE Lanes keep_mul(Mask m, Lanes x, Lanes y) { return keep(m, x * y); }

RF_INLINE Lanes above_floor(Lanes p) {
    return {_mm256_sub_ps(p.a, _mm256_floor_ps(p.a)), _mm256_sub_ps(p.b, _mm256_floor_ps(p.b))};
}
RF_INLINE Lanes above_floor_of_positive(Lanes p) { return above_floor(p); }
RF_INLINE __m256 half_reciprocal_guess(__m256 x) {
    const __m256i magic = _mm256_set1_epi32(0x7ef311c3);
    return _mm256_castsi256_ps(_mm256_sub_epi32(magic, _mm256_castps_si256(x)));
}
RF_INLINE Lanes reciprocal_guess(Lanes x) {
    return {half_reciprocal_guess(x.a), half_reciprocal_guess(x.b)};
}
RF_INLINE __m256 half_times_exp2_floor(__m256 x, __m256 p) {
    const __m256i exponent = _mm256_slli_epi32(_mm256_cvttps_epi32(_mm256_floor_ps(p)), 23);
    return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(x), exponent));
}
RF_INLINE Lanes times_exp2_floor(Lanes x, Lanes p) {
    return {half_times_exp2_floor(x.a, p.a), half_times_exp2_floor(x.b, p.b)};
}
RF_INLINE __m256 half_split_exponent(__m256 x, __m256* mantissa) {
    const __m256i root_half = _mm256_set1_epi32(0x3f3504f3);
    const __m256i shifted = _mm256_sub_epi32(_mm256_castps_si256(x), root_half);
    const __m256i fraction = _mm256_and_si256(shifted, _mm256_set1_epi32(0x007fffff));
    *mantissa = _mm256_castsi256_ps(_mm256_add_epi32(fraction, root_half));
    return _mm256_cvtepi32_ps(_mm256_srai_epi32(shifted, 23));
}
RF_INLINE Lanes split_exponent(Lanes x, Lanes* mantissa) {
    return {half_split_exponent(x.a, &mantissa->a), half_split_exponent(x.b, &mantissa->b)};
}

RF_INLINE int append_offsets(uint16_t* out, uint32_t mask, int base, int step) {
    int count = 0;
    for (; mask != 0; mask &= mask - 1) {
        out[count++] = static_cast<uint16_t>(base + step * __builtin_ctz(mask));
    }
    return count;
}

// columns[j] of one 8x8 corner: lane i = rows[16 * i + j].
RF_INLINE void transpose_corner(const float* rows, __m256* columns) {
    __m256 a[8], t[8];
    for (int i = 0; i < 8; ++i) a[i] = _mm256_load_ps(rows + 16 * i);
    for (int i = 0; i < 4; ++i) {
        t[2 * i] = _mm256_unpacklo_ps(a[2 * i], a[2 * i + 1]);
        t[2 * i + 1] = _mm256_unpackhi_ps(a[2 * i], a[2 * i + 1]);
    }
    for (int i = 0; i < 2; ++i) {
        for (int h = 0; h < 2; ++h) {
            const __m256d low = _mm256_castps_pd(t[4 * i + h]);
            const __m256d high = _mm256_castps_pd(t[4 * i + 2 + h]);
            a[4 * i + 2 * h] = _mm256_castpd_ps(_mm256_unpacklo_pd(low, high));
            a[4 * i + 2 * h + 1] = _mm256_castpd_ps(_mm256_unpackhi_pd(low, high));
        }
    }
    for (int j = 0; j < 4; ++j) {
        columns[j] = _mm256_permute2f128_ps(a[j], a[4 + j], 0x20);
        columns[4 + j] = _mm256_permute2f128_ps(a[j], a[4 + j], 0x31);
    }
}

RF_INLINE void transpose(const float* rows, Lanes* columns) {
    __m256 corner[8];
    for (int right = 0; right < 2; ++right) {
        transpose_corner(rows + 8 * right, corner);
        for (int j = 0; j < 8; ++j) columns[8 * right + j].a = corner[j];
        transpose_corner(rows + 128 + 8 * right, corner);
        for (int j = 0; j < 8; ++j) columns[8 * right + j].b = corner[j];
    }
}

}  // namespace

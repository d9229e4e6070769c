// Sixteen lanes as one 512-bit register (AVX-512 F, BW, DQ, VL).
#pragma once

#include <immintrin.h>

namespace {

struct Lanes {
    __m512 v;
};
using Mask = __mmask16;

RF_INLINE Lanes splat(float a) { return {_mm512_set1_ps(a)}; }
RF_INLINE Lanes load(const float* p) { return {_mm512_load_ps(p)}; }
RF_INLINE Lanes load_unaligned(const float* p) { return {_mm512_loadu_ps(p)}; }
// Four floats, repeated four times: lane i holds p[i & 3].
RF_INLINE Lanes load_repeated(const float* p) { return {_mm512_broadcast_f32x4(_mm_load_ps(p))}; }
RF_INLINE void store(float* p, Lanes a) { _mm512_store_ps(p, a.v); }
RF_INLINE void store_unaligned(float* p, Lanes a) { _mm512_storeu_ps(p, a.v); }
RF_INLINE void store_where(float* p, Mask m, Lanes a) { _mm512_mask_store_ps(p, m, a.v); }

RF_INLINE Lanes operator+(Lanes a, Lanes b) { return {_mm512_add_ps(a.v, b.v)}; }
RF_INLINE Lanes operator-(Lanes a, Lanes b) { return {_mm512_sub_ps(a.v, b.v)}; }
RF_INLINE Lanes operator*(Lanes a, Lanes b) { return {_mm512_mul_ps(a.v, b.v)}; }
RF_INLINE Lanes operator/(Lanes a, Lanes b) { return {_mm512_div_ps(a.v, b.v)}; }
RF_INLINE Lanes fma(Lanes a, Lanes b, Lanes c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
RF_INLINE Lanes fnma(Lanes a, Lanes b, Lanes c) { return {_mm512_fnmadd_ps(a.v, b.v, c.v)}; }
RF_INLINE Lanes sqrt(Lanes a) { return {_mm512_sqrt_ps(a.v)}; }
RF_INLINE Lanes min(Lanes a, Lanes b) { return {_mm512_min_ps(a.v, b.v)}; }
RF_INLINE Lanes max(Lanes a, Lanes b) { return {_mm512_max_ps(a.v, b.v)}; }

RF_INLINE Mask ge(Lanes a, Lanes b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ); }
RF_INLINE Mask gt(Lanes a, Lanes b) { return _mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ); }
RF_INLINE Mask both(Mask a, Mask b) { return a & b; }
RF_INLINE uint32_t bits(Mask m) { return m; }
RF_INLINE Mask mask_from_bits(uint32_t m) { return static_cast<Mask>(m); }
RF_INLINE Lanes select(Mask m, Lanes a, Lanes b) { return {_mm512_mask_blend_ps(m, b.v, a.v)}; }
// a where the mask is set, 0 elsewhere; the fused forms cost no instruction of their own.
RF_INLINE Lanes keep(Mask m, Lanes a) { return {_mm512_maskz_mov_ps(m, a.v)}; }
RF_INLINE Lanes keep_min(Mask m, Lanes a, Lanes b) { return {_mm512_maskz_min_ps(m, a.v, b.v)}; }
RF_INLINE Lanes keep_mul(Mask m, Lanes a, Lanes b) { return {_mm512_maskz_mul_ps(m, a.v, b.v)}; }

// p - floor(p), rounded once.
RF_INLINE Lanes above_floor(Lanes p) {
    constexpr int kFloor = _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC;
    return {_mm512_sub_ps(p.v, _mm512_roundscale_ps(p.v, kFloor))};
}
// The same for p >= 0, where it is exact; the one-instruction form rounds downwards below 0.
RF_INLINE Lanes above_floor_of_positive(Lanes p) {
    return {_mm512_reduce_ps(p.v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC)};
}
// Within 12 % of 1 / x for normal x > 0.
RF_INLINE Lanes reciprocal_guess(Lanes x) {
    const __m512i magic = _mm512_set1_epi32(0x7ef311c3);
    return {_mm512_castsi512_ps(_mm512_sub_epi32(magic, _mm512_castps_si512(x.v)))};
}
// a * 2^floor(p), exact while normal.
RF_INLINE Lanes times_exp2_floor(Lanes a, Lanes p) { return {_mm512_scalef_ps(a.v, p.v)}; }
// Split x > 0 (normal) into mantissa in [sqrt(1/2), sqrt(2)) and exponent.
RF_INLINE Lanes split_exponent(Lanes x, Lanes* mantissa) {
    const __m512i root_half = _mm512_set1_epi32(0x3f3504f3);
    const __m512i shifted = _mm512_sub_epi32(_mm512_castps_si512(x.v), root_half);
    const __m512i fraction = _mm512_and_si512(shifted, _mm512_set1_epi32(0x007fffff));
    mantissa->v = _mm512_castsi512_ps(_mm512_add_epi32(fraction, root_half));
    return {_mm512_cvtepi32_ps(_mm512_srai_epi32(shifted, 23))};
}

// Append to `out` base + step * lane for every lane set; may write 16 entries; return the count.
RF_INLINE int append_offsets(uint16_t* out, uint32_t mask, int base, int step) {
    const __m512i lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const __m512i offset = _mm512_add_epi32(
        _mm512_set1_epi32(base), _mm512_mullo_epi32(lane, _mm512_set1_epi32(step)));
    const __m512i packed = _mm512_maskz_compress_epi32(static_cast<Mask>(mask), offset);
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(out), _mm512_cvtepi32_epi16(packed));
    return __builtin_popcount(mask);
}

// Append to `out` first + lane for every lane < count whose set holds `bit`; may write 16 entries;
// return how many. 16 sets must be readable.
RF_INLINE int append_matching(uint32_t* out, const uint32_t* sets, uint32_t bit, uint32_t first,
                              uint32_t count) {
    const __m512i lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    const __mmask16 listed = static_cast<__mmask16>(count < 16 ? (1u << count) - 1 : 0xffffu);
    const __m512i bits = _mm512_set1_epi32(static_cast<int>(bit));
    const __mmask16 found = _mm512_mask_test_epi32_mask(listed, _mm512_loadu_si512(sets), bits);
    const __m512i number = _mm512_add_epi32(_mm512_set1_epi32(static_cast<int>(first)), lane);
    _mm512_storeu_si512(out, _mm512_maskz_compress_epi32(found, number));
    return __builtin_popcount(found);
}
// Byte i of the result: bits pixel[i] / 16 to pixel[8 + i] / 16, both in -1..127; none of them
// where the second is less.
RF_INLINE uint64_t tiles_of_rows(Lanes pixel) {
    const __m512i column = _mm512_srai_epi32(_mm512_cvttps_epi32(pixel.v), 4);
    const __m256i first = _mm512_castsi512_si256(column);
    const __m256i last = _mm512_extracti32x8_epi32(column, 1);
    const __mmask8 some = _mm256_cmp_ps_mask(_mm512_extractf32x8_ps(pixel.v, 1),
                                             _mm512_castps512_ps256(pixel.v), _CMP_GE_OQ);
    const __m256i columns =
        _mm256_maskz_sub_epi32(some, _mm256_sllv_epi32(_mm256_set1_epi32(2), last),
                               _mm256_sllv_epi32(_mm256_set1_epi32(1), first));
    return static_cast<uint64_t>(_mm_cvtsi128_si64(_mm256_cvtepi32_epi8(columns)));
}

// rows[s] lane 4 j + c = blocks[j] lane 4 c + s (see simd.h).
RF_INLINE void rows_from_blocks(const Lanes* blocks, Lanes* rows) {
    const __m512i turned = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
    __m512 b[4];
    for (int j = 0; j < 4; ++j) b[j] = _mm512_permutexvar_ps(turned, blocks[j].v);
    const __m512 low01 = _mm512_shuffle_f32x4(b[0], b[1], 0x44);
    const __m512 high01 = _mm512_shuffle_f32x4(b[0], b[1], 0xee);
    const __m512 low23 = _mm512_shuffle_f32x4(b[2], b[3], 0x44);
    const __m512 high23 = _mm512_shuffle_f32x4(b[2], b[3], 0xee);
    rows[0].v = _mm512_shuffle_f32x4(low01, low23, 0x88);
    rows[1].v = _mm512_shuffle_f32x4(low01, low23, 0xdd);
    rows[2].v = _mm512_shuffle_f32x4(high01, high23, 0x88);
    rows[3].v = _mm512_shuffle_f32x4(high01, high23, 0xdd);
}
// Lane i of channel c = in[3 i + c]: lanes 0..10 or so from the first two vectors, the rest from
// the third.
RF_INLINE void load_interleaved(const float* in, Lanes* channels) {
    const __m512i step = _mm512_setr_epi32(0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 33, 36, 39, 42, 45);
    const __m512 first = _mm512_loadu_ps(in), second = _mm512_loadu_ps(in + 16);
    const __m512 third = _mm512_loadu_ps(in + 32);
    for (int c = 0; c < 3; ++c) {
        const __m512i from = _mm512_add_epi32(step, _mm512_set1_epi32(c));
        const __mmask16 in_third = _mm512_cmpge_epi32_mask(from, _mm512_set1_epi32(32));
        const __m512 two = _mm512_permutex2var_ps(first, from, second);
        channels[c].v = _mm512_mask_permutexvar_ps(two, in_third, from, third);
    }
}
// out[3 i + c] = lane i of channel c. Lane numbers from 16 on mean the second operand.
RF_INLINE void store_interleaved(float* out, Lanes red, Lanes green, Lanes blue) {
    const __m512i red_green[3] = {
        _mm512_setr_epi32(0, 16, 0, 1, 17, 0, 2, 18, 0, 3, 19, 0, 4, 20, 0, 5),
        _mm512_setr_epi32(21, 0, 6, 22, 0, 7, 23, 0, 8, 24, 0, 9, 25, 0, 10, 26),
        _mm512_setr_epi32(0, 11, 27, 0, 12, 28, 0, 13, 29, 0, 14, 30, 0, 15, 31, 0)};
    const __m512i only_blue[3] = {
        _mm512_setr_epi32(0, 0, 0, 0, 0, 1, 0, 0, 2, 0, 0, 3, 0, 0, 4, 0),
        _mm512_setr_epi32(0, 5, 0, 0, 6, 0, 0, 7, 0, 0, 8, 0, 0, 9, 0, 0),
        _mm512_setr_epi32(10, 0, 0, 11, 0, 0, 12, 0, 0, 13, 0, 0, 14, 0, 0, 15)};
    const __mmask16 is_blue[3] = {0x4924, 0x2492, 0x9249};
    for (int k = 0; k < 3; ++k) {
        const __m512 two = _mm512_permutex2var_ps(red.v, red_green[k], green.v);
        _mm512_storeu_ps(out + 16 * k,
                         _mm512_mask_permutexvar_ps(two, is_blue[k], only_blue[k], blue.v));
    }
}

// columns[j] lane i = rows[16 * i + j].
RF_INLINE void transpose(const float* rows, Lanes* columns) {
    __m512 a[16], t[16];
    for (int i = 0; i < 16; ++i) a[i] = _mm512_load_ps(rows + 16 * i);
    for (int i = 0; i < 8; ++i) {
        t[2 * i] = _mm512_unpacklo_ps(a[2 * i], a[2 * i + 1]);
        t[2 * i + 1] = _mm512_unpackhi_ps(a[2 * i], a[2 * i + 1]);
    }
    for (int i = 0; i < 4; ++i) {
        for (int h = 0; h < 2; ++h) {
            const __m512d low = _mm512_castps_pd(t[4 * i + h]);
            const __m512d high = _mm512_castps_pd(t[4 * i + 2 + h]);
            a[4 * i + 2 * h] = _mm512_castpd_ps(_mm512_unpacklo_pd(low, high));
            a[4 * i + 2 * h + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(low, high));
        }
    }
    for (int j = 0; j < 4; ++j) {
        const __m512 x0 = _mm512_shuffle_f32x4(a[j], a[4 + j], 0x88);
        const __m512 x1 = _mm512_shuffle_f32x4(a[j], a[4 + j], 0xdd);
        const __m512 y0 = _mm512_shuffle_f32x4(a[8 + j], a[12 + j], 0x88);
        const __m512 y1 = _mm512_shuffle_f32x4(a[8 + j], a[12 + j], 0xdd);
        columns[j].v = _mm512_shuffle_f32x4(x0, y0, 0x88);
        columns[8 + j].v = _mm512_shuffle_f32x4(x0, y0, 0xdd);
        columns[4 + j].v = _mm512_shuffle_f32x4(x1, y1, 0x88);
        columns[12 + j].v = _mm512_shuffle_f32x4(x1, y1, 0xdd);
    }
}

}  // namespace

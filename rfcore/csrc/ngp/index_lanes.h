// Sixteen 32-bit integers beside the sixteen floats of raster/simd.h: cell numbers, hashes, and
// reads at them. Everything is exact, so every instruction set gives the same bits.
#pragma once

#include "simd/simd.h"

namespace {

#if defined(RF_ISA_AVX512)

struct Ints {
    __m512i v;
};
RF_INLINE Ints splat_int(uint32_t a) { return {_mm512_set1_epi32(static_cast<int>(a))}; }
RF_INLINE Ints truncate(Lanes a) { return {_mm512_cvttps_epi32(a.v)}; }
RF_INLINE Lanes to_float(Ints a) { return {_mm512_cvtepi32_ps(a.v)}; }
RF_INLINE Ints operator+(Ints a, Ints b) { return {_mm512_add_epi32(a.v, b.v)}; }
RF_INLINE Ints operator*(Ints a, Ints b) { return {_mm512_mullo_epi32(a.v, b.v)}; }
RF_INLINE Ints operator^(Ints a, Ints b) { return {_mm512_xor_si512(a.v, b.v)}; }
RF_INLINE Ints operator&(Ints a, Ints b) { return {_mm512_and_si512(a.v, b.v)}; }
// The smaller of signed numbers.
RF_INLINE Ints min(Ints a, Ints b) { return {_mm512_min_epi32(a.v, b.v)}; }
RF_INLINE void store(uint32_t* p, Ints a) { _mm512_storeu_si512(p, a.v); }
RF_INLINE Ints load_ints(const uint32_t* p) { return {_mm512_loadu_si512(p)}; }
// first = pairs[2 i], second = pairs[2 i + 1]: one read of eight bytes a lane.
RF_INLINE void gather_pairs(const float* pairs, Ints i, Lanes* first, Lanes* second) {
    const __m512 low = _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_castsi512_si256(i.v), pairs, 8));
    const __m512 high =
        _mm512_castpd_ps(_mm512_i32gather_pd(_mm512_extracti64x4_epi64(i.v, 1), pairs, 8));
    const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    const __m512i odd = _mm512_add_epi32(even, _mm512_set1_epi32(1));
    first->v = _mm512_permutex2var_ps(low, even, high);
    second->v = _mm512_permutex2var_ps(low, odd, high);
}
// Lane i is set where bit cell % 32 of words[cell / 32] is.
RF_INLINE Mask test_bits(const uint32_t* words, Ints cell) {
    const __m512i word = _mm512_i32gather_epi32(_mm512_srli_epi32(cell.v, 5), words, 4);
    const __m512i bit = _mm512_sllv_epi32(_mm512_set1_epi32(1),
                                          _mm512_and_si512(cell.v, _mm512_set1_epi32(31)));
    return _mm512_test_epi32_mask(word, bit);
}

#elif defined(RF_ISA_AVX2)

struct Ints {
    __m256i a, b;
};
#define RF_BOTH(op) {op(x.a, y.a), op(x.b, y.b)}
RF_INLINE Ints splat_int(uint32_t v) {
    const __m256i half = _mm256_set1_epi32(static_cast<int>(v));
    return {half, half};
}
RF_INLINE Ints truncate(Lanes x) { return {_mm256_cvttps_epi32(x.a), _mm256_cvttps_epi32(x.b)}; }
RF_INLINE Lanes to_float(Ints x) { return {_mm256_cvtepi32_ps(x.a), _mm256_cvtepi32_ps(x.b)}; }
RF_INLINE Ints operator+(Ints x, Ints y) { return RF_BOTH(_mm256_add_epi32); }
RF_INLINE Ints operator*(Ints x, Ints y) { return RF_BOTH(_mm256_mullo_epi32); }
RF_INLINE Ints operator^(Ints x, Ints y) { return RF_BOTH(_mm256_xor_si256); }
RF_INLINE Ints operator&(Ints x, Ints y) { return RF_BOTH(_mm256_and_si256); }
RF_INLINE Ints min(Ints x, Ints y) { return RF_BOTH(_mm256_min_epi32); }
#undef RF_BOTH
RF_INLINE void store(uint32_t* p, Ints x) {
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(p), x.a);
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(p + 8), x.b);
}
RF_INLINE Ints load_ints(const uint32_t* p) {
    return {_mm256_loadu_si256(reinterpret_cast<const __m256i*>(p)),
            _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p + 8))};
}
RF_INLINE void gather_half(const float* pairs, __m256i i, __m256* first, __m256* second) {
    const double* from = reinterpret_cast<const double*>(pairs);
    const __m256 low = _mm256_castpd_ps(_mm256_i32gather_pd(from, _mm256_castsi256_si128(i), 8));
    const __m256 high =
        _mm256_castpd_ps(_mm256_i32gather_pd(from, _mm256_extracti128_si256(i, 1), 8));
    const __m256d even = _mm256_castps_pd(_mm256_shuffle_ps(low, high, 0x88));
    const __m256d odd = _mm256_castps_pd(_mm256_shuffle_ps(low, high, 0xdd));
    *first = _mm256_castpd_ps(_mm256_permute4x64_pd(even, 0xd8));
    *second = _mm256_castpd_ps(_mm256_permute4x64_pd(odd, 0xd8));
}
RF_INLINE void gather_pairs(const float* pairs, Ints i, Lanes* first, Lanes* second) {
    gather_half(pairs, i.a, &first->a, &second->a);
    gather_half(pairs, i.b, &first->b, &second->b);
}
RF_INLINE __m256 test_half(const uint32_t* words, __m256i cell) {
    const __m256i word = _mm256_i32gather_epi32(reinterpret_cast<const int*>(words),
                                                _mm256_srli_epi32(cell, 5), 4);
    const __m256i bit = _mm256_sllv_epi32(_mm256_set1_epi32(1),
                                          _mm256_and_si256(cell, _mm256_set1_epi32(31)));
    return _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(word, bit), bit));
}
RF_INLINE Mask test_bits(const uint32_t* words, Ints cell) {
    return {test_half(words, cell.a), test_half(words, cell.b)};
}

#else

struct Ints {
    uint32_t v[16];
};
#define RF_ALL for (int i = 0; i < 16; ++i)
RF_INLINE Ints splat_int(uint32_t a) {
    Ints r;
    RF_ALL r.v[i] = a;
    return r;
}
RF_INLINE Ints truncate(Lanes a) {
    alignas(64) float f[16];
    store(f, a);
    Ints r;
    RF_ALL r.v[i] = static_cast<uint32_t>(static_cast<int32_t>(f[i]));
    return r;
}
RF_INLINE Lanes to_float(Ints a) {
    alignas(64) float f[16];
    RF_ALL f[i] = static_cast<float>(static_cast<int32_t>(a.v[i]));
    return load(f);
}
RF_INLINE Ints operator+(Ints a, Ints b) {
    RF_ALL a.v[i] += b.v[i];
    return a;
}
RF_INLINE Ints operator*(Ints a, Ints b) {
    RF_ALL a.v[i] *= b.v[i];
    return a;
}
RF_INLINE Ints operator^(Ints a, Ints b) {
    RF_ALL a.v[i] ^= b.v[i];
    return a;
}
RF_INLINE Ints operator&(Ints a, Ints b) {
    RF_ALL a.v[i] &= b.v[i];
    return a;
}
RF_INLINE Ints min(Ints a, Ints b) {
    RF_ALL if (static_cast<int32_t>(b.v[i]) < static_cast<int32_t>(a.v[i])) a.v[i] = b.v[i];
    return a;
}
RF_INLINE void store(uint32_t* p, Ints a) { memcpy(p, a.v, sizeof a.v); }
RF_INLINE Ints load_ints(const uint32_t* p) {
    Ints r;
    memcpy(r.v, p, sizeof r.v);
    return r;
}
RF_INLINE void gather_pairs(const float* pairs, Ints at, Lanes* first, Lanes* second) {
    alignas(64) float f[2][16];
    RF_ALL {
        f[0][i] = pairs[2 * static_cast<size_t>(at.v[i])];
        f[1][i] = pairs[2 * static_cast<size_t>(at.v[i]) + 1];
    }
    *first = load(f[0]);
    *second = load(f[1]);
}
RF_INLINE Mask test_bits(const uint32_t* words, Ints cell) {
    uint32_t set = 0;
    RF_ALL set |= (words[cell.v[i] >> 5] >> (cell.v[i] & 31) & 1) << i;
    return mask_from_bits(set);
}
#undef RF_ALL

#endif

}  // namespace

// Samples as lanes of wider integers and back: one instruction where the instruction set has one.
//
// GCC 12 widens sixteen bytes in two halves and narrows by shuffles; both are frequent here. The
// plain forms are the definition, and what scalar and NEON code is made of.
#pragma once

#include <cstddef>
#include <cstdint>

#include "simd/inline.h"

#if defined(RF_ISA_AVX2) || defined(RF_ISA_AVX512)
#define RF_H264_X86 1
#include <immintrin.h>
#endif

namespace {

typedef int32_t Row8 __attribute__((vector_size(32)));
typedef int32_t Row4 __attribute__((vector_size(16)));
typedef int16_t Short16 __attribute__((vector_size(32)));
typedef int16_t Short8 __attribute__((vector_size(16)));
typedef uint16_t UShort16 __attribute__((vector_size(32)));
typedef uint16_t UShort8 __attribute__((vector_size(16)));
typedef uint8_t Bytes16 __attribute__((vector_size(16)));
typedef uint8_t Bytes8 __attribute__((vector_size(8)));
typedef uint8_t Bytes4 __attribute__((vector_size(4)));
typedef uint32_t Words8 __attribute__((vector_size(32)));
typedef uint32_t Words4 __attribute__((vector_size(16)));

// Rows of a block as sixteen columns: of one 16 wide row i, of one 8 wide two rows, four apart: 0
// and 4, 1 and 5, 2 and 6, 3 and 7, 8 and 12 and so on.
template <int width>
RF_INLINE Bytes16 load_rows(const uint8_t* at, ptrdiff_t stride, int i) {
    Bytes16 bytes;
    if (width == 16) {
        __builtin_memcpy(&bytes, at + i * stride, 16);
        return bytes;
    }
    at += (i + (i & ~3)) * stride;
#ifdef RF_H264_X86
    const __m128i first = _mm_loadl_epi64(reinterpret_cast<const __m128i*>(at));
    return reinterpret_cast<Bytes16>(_mm_unpacklo_epi64(
        first, _mm_loadl_epi64(reinterpret_cast<const __m128i*>(at + 4 * stride))));
#else
    uint8_t both[16];
    __builtin_memcpy(both, at, 8);
    __builtin_memcpy(both + 8, at + 4 * stride, 8);
    __builtin_memcpy(&bytes, both, 16);
    return bytes;
#endif
}

RF_INLINE Row8 load_row8(const uint8_t* at) {
#ifdef RF_H264_X86
    return reinterpret_cast<Row8>(
        _mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(at))));
#else
    Bytes8 bytes;
    __builtin_memcpy(&bytes, at, 8);
    return __builtin_convertvector(bytes, Row8);
#endif
}

RF_INLINE Row4 load_row4(const uint8_t* at) {
#ifdef RF_H264_X86
    int32_t bytes;
    __builtin_memcpy(&bytes, at, 4);
    return reinterpret_cast<Row4>(_mm_cvtepu8_epi32(_mm_cvtsi32_si128(bytes)));
#else
    Bytes4 bytes;
    __builtin_memcpy(&bytes, at, 4);
    return __builtin_convertvector(bytes, Row4);
#endif
}

RF_INLINE Short16 load_shorts(const uint8_t* at, Short16) {
#ifdef RF_H264_X86
    return reinterpret_cast<Short16>(
        _mm256_cvtepu8_epi16(_mm_loadu_si128(reinterpret_cast<const __m128i*>(at))));
#else
    Bytes16 bytes;
    __builtin_memcpy(&bytes, at, 16);
    return __builtin_convertvector(bytes, Short16);
#endif
}

RF_INLINE Short8 load_shorts(const uint8_t* at, Short8) {
#ifdef RF_H264_X86
    return reinterpret_cast<Short8>(
        _mm_cvtepu8_epi16(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(at))));
#else
    Bytes8 bytes;
    __builtin_memcpy(&bytes, at, 8);
    return __builtin_convertvector(bytes, Short8);
#endif
}

// Lanes clipped to 0..255.
RF_INLINE void store_clipped(Row8 v, uint8_t* at) {
#ifdef RF_H264_X86
    const __m256i w = reinterpret_cast<__m256i>(v);
    const __m128i s = _mm_packs_epi32(_mm256_castsi256_si128(w), _mm256_extracti128_si256(w, 1));
    _mm_storel_epi64(reinterpret_cast<__m128i*>(at), _mm_packus_epi16(s, s));
#else
    const Row8 most = {255, 255, 255, 255, 255, 255, 255, 255};
    v = v < 0 ? Row8{} : v;
    v = v > most ? most : v;
    const Bytes8 bytes = __builtin_convertvector(v, Bytes8);
    __builtin_memcpy(at, &bytes, 8);
#endif
}

RF_INLINE void store_clipped(Row4 v, uint8_t* at) {
#ifdef RF_H264_X86
    const __m128i s = _mm_packs_epi32(reinterpret_cast<__m128i>(v), reinterpret_cast<__m128i>(v));
    const int32_t bytes = _mm_cvtsi128_si32(_mm_packus_epi16(s, s));
    __builtin_memcpy(at, &bytes, 4);
#else
    v = v < 0 ? Row4{} : v;
    v = v > 255 ? Row4{255, 255, 255, 255} : v;
    const Bytes4 bytes = __builtin_convertvector(v, Bytes4);
    __builtin_memcpy(at, &bytes, 4);
#endif
}

RF_INLINE void store_clipped(Short16 v, uint8_t* at) {
#ifdef RF_H264_X86
    const __m256i w = reinterpret_cast<__m256i>(v);
    const __m128i bytes =
        _mm_packus_epi16(_mm256_castsi256_si128(w), _mm256_extracti128_si256(w, 1));
    _mm_storeu_si128(reinterpret_cast<__m128i*>(at), bytes);
#else
    v = v < 0 ? Short16{} : v;
    v = v > 255 ? Short16{} + 255 : v;
    const Bytes16 bytes = __builtin_convertvector(v, Bytes16);
    __builtin_memcpy(at, &bytes, 16);
#endif
}

// A bit for each of eight values above `limit`.
RF_INLINE uint32_t above(const int32_t* values, int32_t limit) {
    Row8 v;
    __builtin_memcpy(&v, values, sizeof v);
    const Row8 mask = v > limit;
#ifdef RF_H264_X86
    return static_cast<uint32_t>(_mm256_movemask_ps(reinterpret_cast<__m256>(mask)));
#else
    uint32_t bits = 0;
    for (int i = 0; i < 8; ++i) bits |= static_cast<uint32_t>(mask[i] & 1) << i;
    return bits;
#endif
}

// (a + b + 1) >> 1 of each lane. (GCC 12 takes the plain form of eight lanes apart, byte by byte.)
RF_INLINE Bytes16 mean_of_bytes(Bytes16 a, Bytes16 b) {
#ifdef RF_H264_X86
    return reinterpret_cast<Bytes16>(
        _mm_avg_epu8(reinterpret_cast<__m128i>(a), reinterpret_cast<__m128i>(b)));
#else
    return (a | b) - ((a ^ b) >> 1);
#endif
}

RF_INLINE Bytes8 mean_of_bytes(Bytes8 a, Bytes8 b) {
#ifdef RF_H264_X86
    const __m128i mean = _mm_avg_epu8(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(&a)),
                                      _mm_loadl_epi64(reinterpret_cast<const __m128i*>(&b)));
    _mm_storel_epi64(reinterpret_cast<__m128i*>(&a), mean);
    return a;
#else
    return (a | b) - ((a ^ b) >> 1);
#endif
}

// The low byte of each lane.
RF_INLINE Bytes8 low_bytes(Short8 v) {
#ifdef RF_H264_X86
    const __m128i w = _mm_and_si128(reinterpret_cast<__m128i>(v), _mm_set1_epi16(255));
    const int64_t bytes = _mm_cvtsi128_si64(_mm_packus_epi16(w, w));
    Bytes8 result;
    __builtin_memcpy(&result, &bytes, 8);
    return result;
#else
    return __builtin_convertvector(v, Bytes8);
#endif
}

// Of lanes without sign.
RF_INLINE uint32_t sum_of_lanes(Words4 v) {
    v += __builtin_shuffle(v, Words4{2, 3, 0, 1});
    return v[0] + v[1];
}

RF_INLINE uint32_t sum_of_lanes(Words8 w) {
    w += __builtin_shuffle(w, Words8{4, 5, 6, 7, 0, 1, 2, 3});
    return sum_of_lanes(Words4{w[0], w[1], w[2], w[3]});
}

RF_INLINE uint32_t sum_of_lanes(Short8 v) {
    const Words4 w = reinterpret_cast<Words4>(v);
    return sum_of_lanes((w & 0xFFFF) + (w >> 16));
}

RF_INLINE uint32_t sum_of_lanes(Short16 v) {
    const Words8 w = reinterpret_cast<Words8>(v);
    return sum_of_lanes((w & 0xFFFF) + (w >> 16));
}

// Adds the squares of neighbouring lanes, each within -255..255, to `sum`.
RF_INLINE void add_squares(Words8& sum, Short16 v) {
#ifdef RF_H264_X86
    const __m256i w = reinterpret_cast<__m256i>(v);
    sum += reinterpret_cast<Words8>(_mm256_madd_epi16(w, w));
#else
    const UShort16 u = reinterpret_cast<UShort16>(v);  // squares are at most 65025: without sign
    const Words8 pairs = reinterpret_cast<Words8>(UShort16(u * u));
    sum += (pairs & 0xFFFF) + (pairs >> 16);
#endif
}

RF_INLINE void add_squares(Words4& sum, Short8 v) {
#ifdef RF_H264_X86
    const __m128i w = reinterpret_cast<__m128i>(v);
    sum += reinterpret_cast<Words4>(_mm_madd_epi16(w, w));
#else
    const UShort8 u = reinterpret_cast<UShort8>(v);
    const Words4 pairs = reinterpret_cast<Words4>(UShort8(u * u));
    sum += (pairs & 0xFFFF) + (pairs >> 16);
#endif
}

template <class Short>
RF_INLINE Short magnitude(Short v) { return v < 0 ? -v : v; }

template <class Short>
RF_INLINE Short difference(const uint8_t* a, const uint8_t* b, Short) {
    return load_shorts(a, Short{}) - load_shorts(b, Short{});
}

// The 4x4 Hadamard transform along rows of sixteen columns, in two halves; between them rows are
// added up. `begin_transform` is linear, so that differences may be taken after it.
// `absolute_sums` takes the magnitudes of coefficients, whose pairs come from a last butterfly:
// |a + b| + |a - b| = 2 max(|a|, |b|). `columns_of` returns half their sum for each four columns.
// Lanes may be added up in between over sixteen rows of differences of samples.
#ifdef RF_H264_X86
// Sums of neighbours in the lower lanes, their differences in the upper.
RF_INLINE Short16 begin_transform(Bytes16 row) {
    const __m256i signs = _mm256_set_m128i(_mm_set1_epi16(-255), _mm_set1_epi8(1));  // 1, -1
    const __m256i twice = _mm256_broadcastsi128_si256(reinterpret_cast<__m128i>(row));
    return reinterpret_cast<Short16>(_mm256_maddubs_epi16(twice, signs));
}

RF_INLINE Short16 absolute_sums(Short16 v) {
    const __m256i size = _mm256_abs_epi16(reinterpret_cast<__m256i>(v));
    return reinterpret_cast<Short16>(_mm256_max_epi16(size, _mm256_srli_epi32(size, 16)));
}

// Every other lane holds a maximum.
RF_INLINE Words4 columns_of(Short16 sums) {
    const Words8 words = reinterpret_cast<Words8>(sums) & 0xFFFF;
    const __m256i w = reinterpret_cast<__m256i>(words);
    return reinterpret_cast<Words4>(
        _mm_add_epi32(_mm256_castsi256_si128(w), _mm256_extracti128_si256(w, 1)));
}
#else
RF_INLINE Short16 begin_transform(Bytes16 row) { return __builtin_convertvector(row, Short16); }

RF_INLINE Short16 absolute_sums(Short16 v) {
    const Short16 signs = {1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1};
    const Short16 u =
        v * signs +
        __builtin_shuffle(v, Short16{1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14});
    const Short16 size = magnitude(u);
    const Short16 other = __builtin_shuffle(
        size, Short16{2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13});
    return size > other ? size : other;
}

RF_INLINE Words4 columns_of(Short16 sums) {
    const Words8 words = reinterpret_cast<Words8>(sums);
    const Words8 pairs = (words & 0xFFFF) + (words >> 16);
    return Words4{pairs[0] + pairs[1], pairs[2] + pairs[3], pairs[4] + pairs[5],
                  pairs[6] + pairs[7]} >> 1;
}
#endif

#ifdef RF_H264_X86
// How many rows of a block 8 or 16 wide sixteen lanes hold.
template <int width>
constexpr int kRowsInLanes = width == 16 ? 1 : 2;

template <int width>
RF_INLINE __m128i load_rows(const uint8_t* at, ptrdiff_t stride) {
    if constexpr (width == 16) return _mm_loadu_si128(reinterpret_cast<const __m128i*>(at));
    return _mm_unpacklo_epi64(_mm_loadl_epi64(reinterpret_cast<const __m128i*>(at)),
                              _mm_loadl_epi64(reinterpret_cast<const __m128i*>(at + stride)));
}

RF_INLINE uint32_t sum_of_differences(__m128i sums) {
    return static_cast<uint32_t>(_mm_cvtsi128_si32(sums) + _mm_extract_epi32(sums, 2));
}
#endif

// Sum of absolute differences of a block 8 or 16 wide; its height is a multiple of 4, 16 at most.
template <int width>
RF_INLINE uint32_t absolute_difference(const uint8_t* a, ptrdiff_t a_stride, const uint8_t* b,
                                       ptrdiff_t b_stride, int height) {
#ifdef RF_H264_X86
    constexpr int kRows = kRowsInLanes<width>;
    __m128i sum = _mm_setzero_si128();
    for (int y = 0; y < height; y += 4) {
        for (int i = 0; i < 4; i += kRows, a += kRows * a_stride, b += kRows * b_stride) {
            const __m128i row = load_rows<width>(a, a_stride);
            sum = _mm_add_epi32(sum, _mm_sad_epu8(row, load_rows<width>(b, b_stride)));
        }
    }
    return sum_of_differences(sum);
#else
    Short8 sum{};
    for (int y = 0; y < height; ++y, a += a_stride, b += b_stride) {
        for (int x = 0; x < width; x += 8) sum += magnitude(difference(a + x, b + x, Short8{}));
    }
    return sum_of_lanes(sum);
#endif
}

// The same between `a` and the four blocks one sample right, left, below and above `b`.
template <int width>
RF_INLINE void absolute_differences_around(const uint8_t* a, ptrdiff_t a_stride, const uint8_t* b,
                                           ptrdiff_t b_stride, int height, uint32_t* sums) {
    const uint8_t* around[4] = {b + 1, b - 1, b + b_stride, b - b_stride};
#ifdef RF_H264_X86
    constexpr int kRows = kRowsInLanes<width>;
    __m128i sum[4] = {};
    for (int y = 0; y < height; y += kRows, a += kRows * a_stride) {
        const __m128i row = load_rows<width>(a, a_stride);
        for (int i = 0; i < 4; ++i) {
            const __m128i other = load_rows<width>(around[i] + y * b_stride, b_stride);
            sum[i] = _mm_add_epi32(sum[i], _mm_sad_epu8(row, other));
        }
    }
    for (int i = 0; i < 4; ++i) sums[i] = sum_of_differences(sum[i]);
#else
    for (int i = 0; i < 4; ++i) {
        sums[i] = absolute_difference<width>(a, a_stride, around[i], b_stride, height);
    }
#endif
}

template <int side>
RF_INLINE uint32_t squared_error(const uint8_t* a, ptrdiff_t a_stride, const uint8_t* b,
                                 ptrdiff_t b_stride) {
    if constexpr (side == 16) {
        Words8 sum{};
        for (int y = 0; y < 16; ++y) {
            add_squares(sum, difference(a + y * a_stride, b + y * b_stride, Short16{}));
        }
        return sum_of_lanes(sum);
    } else if constexpr (side == 8) {
        Words4 sum{};
        for (int y = 0; y < 8; ++y) {
            add_squares(sum, difference(a + y * a_stride, b + y * b_stride, Short8{}));
        }
        return sum_of_lanes(sum);
    } else {
        Row4 sum{};
        for (int y = 0; y < 4; ++y) {
            const Row4 d = load_row4(a + y * a_stride) - load_row4(b + y * b_stride);
            sum += d * d;
        }
        return sum_of_lanes(reinterpret_cast<Words4>(sum));
    }
}

}  // namespace

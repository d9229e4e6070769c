// Sixteen float lanes with one meaning on every instruction set.
//
// Every operation below is IEEE-754 exact (or a comparison, a move or an integer operation), so
// the same sequence of calls gives the same bits on every machine. min and max return the second
// operand when one of the two is not a number, as x86 does. The wrapper and everything that
// includes it live in anonymous namespaces: the units are compiled with different machine flags,
// and a weak symbol would let the linker pick the copy of the wrong one.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>

#include "simd/inline.h"

#if defined(RF_ISA_AVX512)
#include "simd/avx512.h"
#elif defined(RF_ISA_AVX2)
#include "simd/avx2.h"
#elif defined(RF_ISA_NEON)
#include "simd/neon.h"
#else
#include "simd/scalar.h"
#endif

namespace {

RF_INLINE Lanes zero() { return splat(0.0f); }
RF_INLINE Lanes negate(Lanes a) { return zero() - a; }
RF_INLINE Lanes clamp(Lanes a, Lanes low, Lanes high) { return max(min(a, high), low); }
RF_INLINE Lanes absolute(Lanes a) { return max(a, negate(a)); }
RF_INLINE bool any(Mask m) { return bits(m) != 0; }

// Return the sum of the lanes in a fixed order.
RF_INLINE double sum_in_order(Lanes a) {
    alignas(64) float lane[16];
    store(lane, a);
    double sum = 0.0;
    for (int i = 0; i < 16; ++i) sum += static_cast<double>(lane[i]);
    return sum;
}

#if !defined(RF_ISA_AVX512)
// Append to `out` first + lane for every lane < count whose set holds `bit`; may write 16 entries;
// return how many. 16 sets must be readable.
RF_INLINE int append_matching(uint32_t* out, const uint32_t* sets, uint32_t bit, uint32_t first,
                              uint32_t count) {
    int found = 0;
    for (uint32_t lane = 0; lane < (count < 16 ? count : 16); ++lane) {
        out[found] = first + lane;
        found += (sets[lane] & bit) != 0;
    }
    return found;
}
// Byte i of the result: bits pixel[i] / 16 to pixel[8 + i] / 16, both in -1..127; none of them
// where the second is less.
RF_INLINE uint64_t tiles_of_rows(Lanes pixel) {
    alignas(64) float p[16];
    store(p, pixel);
    uint64_t tiles = 0;
    for (int i = 0; i < 8; ++i) {
        const int first = static_cast<int>(p[i]) / 16, last = static_cast<int>(p[8 + i]) / 16;
        const uint64_t columns = (uint64_t{2} << last) - (uint64_t{1} << first);
        tiles |= (p[8 + i] < p[i] ? 0 : columns) << (8 * i);
    }
    return tiles;
}
// rows[s] lane 4 j + c = blocks[j] lane 4 c + s: four 4x4 blocks side by side, columns first, as
// four rows of 16. It turns the three indices round, so twice more brings the blocks back.
RF_INLINE void rows_from_blocks(const Lanes* blocks, Lanes* rows) {
    alignas(64) float in[4][16], out[4][16];
    for (int j = 0; j < 4; ++j) store(in[j], blocks[j]);
    for (int s = 0; s < 4; ++s) {
        for (int i = 0; i < 16; ++i) out[s][i] = in[i >> 2][4 * (i & 3) + s];
    }
    for (int s = 0; s < 4; ++s) rows[s] = load(out[s]);
}
// Lane i of channel c = in[3 i + c].
RF_INLINE void load_interleaved(const float* in, Lanes* channels) {
    alignas(64) float lanes[3][16];
    for (int i = 0; i < 16; ++i) {
        for (int c = 0; c < 3; ++c) lanes[c][i] = in[3 * i + c];
    }
    for (int c = 0; c < 3; ++c) channels[c] = load(lanes[c]);
}
// out[3 i + c] = lane i of channel c.
RF_INLINE void store_interleaved(float* out, Lanes red, Lanes green, Lanes blue) {
    alignas(64) float channels[3][16];
    store(channels[0], red);
    store(channels[1], green);
    store(channels[2], blue);
    for (int i = 0; i < 16; ++i) {
        for (int c = 0; c < 3; ++c) out[3 * i + c] = channels[c][i];
    }
}
#endif

}  // namespace

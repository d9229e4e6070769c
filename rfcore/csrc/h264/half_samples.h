// Half-sample planes of a reference (8.4.2.2.1), once for a whole picture.
#pragma once

#include "h264/inter.h"

namespace {

// Six neighbours at `step`, two by two: the weights are 1, -5, 20, 20, -5, 1.
struct SixTaps {
    Short16 outer, middle, inner;

    static SixTaps of_samples(const uint8_t* at, ptrdiff_t step) {
        const auto pair = [&](int i) {
            return load_shorts(at - i * step, Short16{}) +
                   load_shorts(at + (i + 1) * step, Short16{});
        };
        return {pair(2), pair(1), pair(0)};
    }

    static SixTaps of_sums(const int16_t* at) {
        const auto load = [&](int i) {
            Short16 v;
            __builtin_memcpy(&v, at + i, sizeof v);
            return v;
        };
        return {load(-2) + load(3), load(-1) + load(2), load(0) + load(1)};
    }

    // Of samples, within -2550..10710.
    Short16 sum() const { return outer - 5 * middle + 20 * inner; }

    // (sum + 512) >> 10 of sums, in 16 bits: floors of quarters of (outer - middle) / 4 + inner -
    // middle, whose two terms are halved before they are added up.
    Short16 rounded_sum() const {
        const Short16 x = (outer - middle) >> 2, y = inner - middle;
        const Short16 half = (x & y) + ((x ^ y) >> 1);
        return ((half >> 1) + inner + 32) >> 6;
    }
};

// All of a padded plane but the outermost three rows and columns, which nobody may look at: `out`
// are the planes b, h, j, of the same size and stride, a multiple of 16.
inline void half_samples(const uint8_t* whole, ptrdiff_t stride, int width, int height,
                         uint8_t* const* out) {
    constexpr int kMostWidth = kMaxSide + 2 * kBorder + 32;
    int16_t sums[kMostWidth + 32] = {};
    int16_t* vertical = sums + 16;
    for (int y = 3; y < height - 3; ++y) {
        const ptrdiff_t row = y * stride;
        for (int x = 0; x < width; x += 16) {
            const Short16 sum = SixTaps::of_samples(whole + row + x, stride).sum();
            __builtin_memcpy(vertical + x, &sum, sizeof sum);
            store_clipped((sum + 16) >> 5, out[1] + row + x);
        }
        for (int x = 0; x < width; x += 16) {
            const Short16 sum = SixTaps::of_samples(whole + row + x, 1).sum();
            store_clipped((sum + 16) >> 5, out[0] + row + x);
            store_clipped(SixTaps::of_sums(vertical + x).rounded_sum(), out[2] + row + x);
        }
    }
}

}  // namespace

// Half-sample planes of a reference (8.4.2.2.1), once for a whole picture.
#pragma once

#include "h264/inter.h"

namespace {

inline int six_taps(int a, int b, int c, int d, int e, int f) {
    return a - 5 * b + 20 * c + 20 * d - 5 * e + f;
}

// All rows and columns of a padded plane but the outermost three, which stay as they are: `out`
// are the planes b, h, j, of the same size and stride.
inline void half_samples(const uint8_t* whole, ptrdiff_t stride, int width, int height,
                         uint8_t* const* out) {
    constexpr int kMostWidth = kMaxSide + 2 * kBorder + 32;
    int16_t vertical[kMostWidth];
    for (int y = 3; y < height - 3; ++y) {
        const uint8_t* row = whole + y * stride;
        uint8_t* b = out[0] + y * stride;
        uint8_t* h = out[1] + y * stride;
        uint8_t* j = out[2] + y * stride;
        for (int x = 0; x < width; ++x) {
            const int sum = six_taps(row[x - 2 * stride], row[x - stride], row[x], row[x + stride],
                                     row[x + 2 * stride], row[x + 3 * stride]);
            vertical[x] = static_cast<int16_t>(sum);
            h[x] = clipped((sum + 16) >> 5);
        }
        for (int x = 3; x < width - 3; ++x) {
            b[x] = clipped((six_taps(row[x - 2], row[x - 1], row[x], row[x + 1], row[x + 2],
                                     row[x + 3]) + 16) >> 5);
            j[x] = clipped((six_taps(vertical[x - 2], vertical[x - 1], vertical[x], vertical[x + 1],
                                     vertical[x + 2], vertical[x + 3]) + 512) >> 10);
        }
    }
}

}  // namespace

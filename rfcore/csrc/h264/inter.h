// Motion compensation (8.4.2.2) and differences between blocks.
#pragma once

#include "h264/intra.h"

namespace {

typedef int16_t Short16 __attribute__((vector_size(32)));
typedef int16_t Short8 __attribute__((vector_size(16)));
typedef uint8_t Bytes16 __attribute__((vector_size(16)));

// Where the two samples that make a quarter-sample position lie: plane and offset (Table 8-12).
// 8.4.2.2.1 names them G (plane 0), b (1), h (2), j (3).
struct QuarterPosition {
    uint8_t plane[2], dx[2], dy[2];
    bool mean;
};

constexpr QuarterPosition kQuarter[16] = {
    {{0, 0}, {0, 0}, {0, 0}, false}, {{0, 1}, {0, 0}, {0, 0}, true},
    {{1, 1}, {0, 0}, {0, 0}, false}, {{1, 0}, {0, 1}, {0, 0}, true},
    {{0, 2}, {0, 0}, {0, 0}, true},  {{1, 2}, {0, 0}, {0, 0}, true},
    {{1, 3}, {0, 0}, {0, 0}, true},  {{1, 2}, {0, 1}, {0, 0}, true},
    {{2, 2}, {0, 0}, {0, 0}, false}, {{2, 3}, {0, 0}, {0, 0}, true},
    {{3, 3}, {0, 0}, {0, 0}, false}, {{3, 2}, {0, 1}, {0, 0}, true},
    {{2, 0}, {0, 0}, {0, 1}, true},  {{2, 1}, {0, 0}, {0, 1}, true},
    {{3, 1}, {0, 0}, {0, 1}, true},  {{2, 1}, {1, 0}, {0, 1}, true},
};

struct Block {
    const uint8_t* at;
    ptrdiff_t stride;
};

// (a + b + 1) >> 1 of blocks as wide as `Bytes`, to `out` with stride 16.
template <class Bytes>
RF_INLINE void mean_of_blocks(const uint8_t* a, const uint8_t* b, ptrdiff_t stride, int height,
                              uint8_t* out) {
    for (int y = 0; y < height; ++y, a += stride, b += stride, out += 16) {
        Bytes p, q;
        __builtin_memcpy(&p, a, sizeof p);
        __builtin_memcpy(&q, b, sizeof q);
        const Bytes mean = (p | q) - ((p ^ q) >> 1);
        __builtin_memcpy(out, &mean, sizeof mean);
    }
}

// The luma prediction of a block at (x, y) by `mv`, 8 or 16 wide: in the reference's planes where
// no mean is needed, else in `scratch` (stride 16).
inline Block luma_prediction(const Reference& reference, int x, int y, Mv mv, int width, int height,
                             uint8_t* scratch) {
    const QuarterPosition& q = kQuarter[4 * (mv.y & 3) + (mv.x & 3)];
    const ptrdiff_t stride = reference.luma[0].stride;
    const ptrdiff_t base = (y + (mv.y >> 2)) * stride + x + (mv.x >> 2);
    const uint8_t* first = reference.luma[q.plane[0]].at + base + q.dy[0] * stride + q.dx[0];
    if (!q.mean) return {first, stride};
    const uint8_t* second = reference.luma[q.plane[1]].at + base + q.dy[1] * stride + q.dx[1];
    if (width == 16) {
        mean_of_blocks<Bytes16>(first, second, stride, height, scratch);
    } else {
        mean_of_blocks<Bytes8>(first, second, stride, height, scratch);
    }
    return {scratch, 16};
}

// 8.4.2.2.2; (x, y) and sizes in chroma samples, out with stride 8.
template <int width>
void predict_chroma(const Plane& plane, int x, int y, Mv mv, int height, uint8_t* out) {
    const int fx = mv.x & 7, fy = mv.y & 7;
    const uint8_t* in = plane.at + (y + (mv.y >> 3)) * plane.stride + x + (mv.x >> 3);
    const int a = (8 - fx) * (8 - fy), b = fx * (8 - fy), c = (8 - fx) * fy, d = fx * fy;
    for (int j = 0; j < height; ++j, in += plane.stride, out += 8) {
        const uint8_t* below = in + plane.stride;
        for (int i = 0; i < width; ++i) {
            out[i] = static_cast<uint8_t>(
                (a * in[i] + b * in[i + 1] + c * below[i] + d * below[i + 1] + 32) >> 6);
        }
    }
}

template <int side>
RF_INLINE uint32_t squared_error(const uint8_t* a, ptrdiff_t a_stride, const uint8_t* b,
                                 ptrdiff_t b_stride) {
    uint32_t sum = 0;
    for (int y = 0; y < side; ++y, a += a_stride, b += b_stride) {
        for (int x = 0; x < side; ++x) {
            const int d = a[x] - b[x];
            sum += static_cast<uint32_t>(d * d);
        }
    }
    return sum;
}

template <class Short>
RF_INLINE Short magnitude(Short v) { return v < 0 ? -v : v; }

RF_INLINE Short16 difference(const uint8_t* a, const uint8_t* b, Short16) {
    Bytes16 p, q;
    __builtin_memcpy(&p, a, 16);
    __builtin_memcpy(&q, b, 16);
    return __builtin_convertvector(p, Short16) - __builtin_convertvector(q, Short16);
}

RF_INLINE Short8 difference(const uint8_t* a, const uint8_t* b, Short8) {
    Bytes8 p, q;
    __builtin_memcpy(&p, a, 8);
    __builtin_memcpy(&q, b, 8);
    return __builtin_convertvector(p, Short8) - __builtin_convertvector(q, Short8);
}

typedef uint32_t Words8 __attribute__((vector_size(32)));
typedef uint32_t Words4 __attribute__((vector_size(16)));

// Of lanes without sign.
RF_INLINE uint32_t sum_of_lanes(Words4 v) {
    v += __builtin_shuffle(v, Words4{2, 3, 0, 1});
    return v[0] + v[1];
}
RF_INLINE uint32_t sum_of_lanes(Short8 v) {
    const Words4 w = reinterpret_cast<Words4>(v);
    return sum_of_lanes((w & 0xFFFF) + (w >> 16));
}
RF_INLINE uint32_t sum_of_lanes(Short16 v) {
    Words8 w = reinterpret_cast<Words8>(v);
    w = (w & 0xFFFF) + (w >> 16);
    w += __builtin_shuffle(w, Words8{4, 5, 6, 7, 0, 1, 2, 3});
    return sum_of_lanes(Words4{w[0], w[1], w[2], w[3]});
}

template <class Short>
RF_INLINE uint32_t absolute_difference_of(const uint8_t* a, ptrdiff_t a_stride, const uint8_t* b,
                                          ptrdiff_t b_stride, int height) {
    Short sum{};
    for (int y = 0; y < height; ++y, a += a_stride, b += b_stride) {
        sum += magnitude(difference(a, b, Short{}));
    }
    return sum_of_lanes(sum);
}

// Sum of absolute differences of a block 8 or 16 wide and at most 16 high.
template <int width>
uint32_t absolute_difference(const uint8_t* a, ptrdiff_t a_stride, const uint8_t* b,
                             ptrdiff_t b_stride, int height) {
    return width == 16 ? absolute_difference_of<Short16>(a, a_stride, b, b_stride, height)
                       : absolute_difference_of<Short8>(a, a_stride, b, b_stride, height);
}

RF_INLINE Short16 swap1(Short16 v) {
    return __builtin_shuffle(v, Short16{1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14});
}
RF_INLINE Short16 swap2(Short16 v) {
    return __builtin_shuffle(v, Short16{2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13});
}
RF_INLINE Short8 swap1(Short8 v) { return __builtin_shuffle(v, Short8{1, 0, 3, 2, 5, 4, 7, 6}); }
RF_INLINE Short8 swap2(Short8 v) { return __builtin_shuffle(v, Short8{2, 3, 0, 1, 6, 7, 4, 5}); }
RF_INLINE Short16 signs1(Short16) {
    return Short16{1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1};
}
RF_INLINE Short8 signs1(Short8) { return Short8{1, -1, 1, -1, 1, -1, 1, -1}; }

// The sum of absolute 4x4 Hadamard coefficients of the difference, lane by lane: the last
// butterfly of a pair adds up to |a + b| + |a - b| = 2 max(|a|, |b|), found in both its lanes.
template <class Short>
RF_INLINE Short hadamard_rows(const uint8_t* a, ptrdiff_t a_stride, const uint8_t* b,
                              ptrdiff_t b_stride) {
    Short d[4];
    for (int y = 0; y < 4; ++y) d[y] = difference(a + y * a_stride, b + y * b_stride, Short{});
    const Short s0 = d[0] + d[1], s1 = d[0] - d[1], s2 = d[2] + d[3], s3 = d[2] - d[3];
    Short m[4] = {s0 + s2, s1 + s3, s0 - s2, s1 - s3};
    Short sum{};
    for (int y = 0; y < 4; ++y) {
        const Short u = swap1(m[y]) + m[y] * signs1(Short{});
        const Short v = magnitude(u), w = swap2(v);
        sum += v > w ? v : w;
    }
    return sum;
}

// Sum of absolute transformed differences, half the Hadamard sum, of a block 8 or 16 wide.
template <int width>
uint32_t transformed_difference(const uint8_t* a, ptrdiff_t a_stride, const uint8_t* b,
                                ptrdiff_t b_stride, int height) {
    uint32_t total = 0;
    if (width == 16) {
        Short16 sum{};
        for (int y = 0; y < height; y += 4) {
            sum += hadamard_rows<Short16>(a + y * a_stride, a_stride, b + y * b_stride, b_stride);
        }
        total = sum_of_lanes(sum);
    } else {
        Short8 sum{};
        for (int y = 0; y < height; y += 4) {
            sum += hadamard_rows<Short8>(a + y * a_stride, a_stride, b + y * b_stride, b_stride);
        }
        total = sum_of_lanes(sum);
    }
    return total >> 1;
}

// The predictions of a block by every mode side by side, mode m from column side * m on.
template <int side>
struct ModeStrip {
    static constexpr int kPerVector = 16 / side;  // modes in sixteen columns
    static constexpr int kVectors = (kBlockModes + kPerVector - 1) / kPerVector;
    static constexpr ptrdiff_t kStride = 16 * kVectors;
    alignas(32) uint8_t sample[side * 16 * kVectors];
    uint8_t* of(int mode) { return sample + side * mode; }
};

// The transformed differences between `source` and all predictions of the strip.
template <int side>
void strip_differences(const uint8_t* source, ptrdiff_t stride, const ModeStrip<side>& strip,
                       uint32_t* differences) {
    using Strip = ModeStrip<side>;
    alignas(32) uint8_t repeated[side * 16];
    for (int y = 0; y < side; ++y) {
        for (int i = 0; i < Strip::kPerVector; ++i) {
            __builtin_memcpy(repeated + 16 * y + side * i, source + y * stride, side);
        }
    }
    for (int v = 0; v < Strip::kVectors; ++v) {
        Short16 sum{};
        for (int y = 0; y < side; y += 4) {
            const uint8_t* predictions = strip.sample + y * Strip::kStride + 16 * v;
            sum += hadamard_rows<Short16>(repeated + 16 * y, 16, predictions, Strip::kStride);
        }
        for (int i = 0; i < Strip::kPerVector; ++i) {
            uint32_t total = 0;
            for (int lane = 0; lane < side; ++lane) {
                total += static_cast<uint16_t>(sum[side * i + lane]);
            }
            differences[Strip::kPerVector * v + i] = total >> 1;
        }
    }
}

}  // namespace

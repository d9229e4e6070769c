// Motion compensation (8.4.2.2) and differences between blocks.
#pragma once

#include "h264/intra.h"

namespace {

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
        const Bytes mean = mean_of_bytes(p, q);
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
    const auto a = static_cast<int16_t>((8 - fx) * (8 - fy));
    const auto b = static_cast<int16_t>(fx * (8 - fy));
    const auto c = static_cast<int16_t>((8 - fx) * fy), d = static_cast<int16_t>(fx * fy);
    for (int j = 0; j < height; ++j, in += plane.stride, out += 8) {  // 8 wide: lanes are free
        const uint8_t* below = in + plane.stride;
        const Short8 sum = a * load_shorts(in, Short8{}) + b * load_shorts(in + 1, Short8{}) +
                           c * load_shorts(below, Short8{}) + d * load_shorts(below + 1, Short8{});
        const Bytes8 bytes = low_bytes((sum + 32) >> 6);
        __builtin_memcpy(out, &bytes, width);
    }
}

RF_INLINE Short16 swap1(Short16 v) {
    return __builtin_shuffle(v, Short16{1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14});
}
RF_INLINE Short16 swap2(Short16 v) {
    return __builtin_shuffle(v, Short16{2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13});
}
RF_INLINE Short16 signs1() {
    return Short16{1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1};
}

// The sum of absolute 4x4 Hadamard coefficients of four rows of differences, lane by lane: the last
// butterfly of a pair adds up to |a + b| + |a - b| = 2 max(|a|, |b|), found in both its lanes.
RF_INLINE Short16 hadamard_sums(const Short16* d) {
    const Short16 s0 = d[0] + d[1], s1 = d[0] - d[1], s2 = d[2] + d[3], s3 = d[2] - d[3];
    const Short16 m[4] = {s0 + s2, s1 + s3, s0 - s2, s1 - s3};
    Short16 sum{};
    for (int y = 0; y < 4; ++y) {
        const Short16 u = swap1(m[y]) + m[y] * signs1();
        const Short16 v = magnitude(u), w = swap2(v);
        sum += v > w ? v : w;
    }
    return sum;
}

// Of four rows of a block 16 wide.
RF_INLINE Short16 hadamard_rows(const uint8_t* a, ptrdiff_t a_stride, const uint8_t* b,
                                ptrdiff_t b_stride) {
    Short16 d[4];
    for (int y = 0; y < 4; ++y) d[y] = difference(a + y * a_stride, b + y * b_stride, Short16{});
    return hadamard_sums(d);
}

// Of eight rows of a block 8 wide: the lower four beside the upper.
RF_INLINE Short16 hadamard_rows8(const uint8_t* a, ptrdiff_t a_stride, const uint8_t* b,
                                 ptrdiff_t b_stride) {
    Short16 d[4];
    for (int y = 0; y < 4; ++y, a += a_stride, b += b_stride) {
        d[y] = load_shorts(a, a + 4 * a_stride) - load_shorts(b, b + 4 * b_stride);
    }
    return hadamard_sums(d);
}

// Sum of absolute transformed differences, half the Hadamard sum, of a block 8 or 16 wide; its
// height is a multiple of 8.
template <int width>
uint32_t transformed_difference(const uint8_t* a, ptrdiff_t a_stride, const uint8_t* b,
                                ptrdiff_t b_stride, int height) {
    constexpr int kRows = width == 16 ? 4 : 8;
    Short16 sum{};
    for (int y = 0; y < height; y += kRows, a += kRows * a_stride, b += kRows * b_stride) {
        sum += width == 16 ? hadamard_rows(a, a_stride, b, b_stride)
                           : hadamard_rows8(a, a_stride, b, b_stride);
    }
    return sum_of_lanes(sum) >> 1;
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
            sum += hadamard_rows(repeated + 16 * y, 16, predictions, Strip::kStride);
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

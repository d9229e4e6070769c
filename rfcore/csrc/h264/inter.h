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

// Where the samples of a luma prediction lie: a block, or two to take the mean of.
struct QuarterSamples {
    const uint8_t *first, *second;  // second: nullptr where there is none
    ptrdiff_t stride;
};

// Where those of sample (0, 0) lie for each of the sixteen quarter-sample positions.
struct QuarterPlanes {
    const uint8_t *first[16], *second[16];
    ptrdiff_t stride;

    void begin(const Reference& reference) {
        stride = reference.luma[0].stride;
        for (int i = 0; i < 16; ++i) {
            const QuarterPosition& q = kQuarter[i];
            const auto at = [&](int k) {
                return reference.luma[q.plane[k]].at + q.dy[k] * stride + q.dx[k];
            };
            first[i] = at(0);
            second[i] = q.mean ? at(1) : nullptr;
        }
    }

    // The integer samples of the block at (x, y).
    const uint8_t* whole(int x, int y) const { return first[0] + y * stride + x; }

    // The samples of the block at (x, y) moved by `mv`.
    QuarterSamples at(int x, int y, Mv mv) const {
        const int position = 4 * (mv.y & 3) + (mv.x & 3);
        const ptrdiff_t offset = (y + (mv.y >> 2)) * stride + x + (mv.x >> 2);
        const uint8_t* other = second[position];
        return {first[position] + offset, other ? other + offset : nullptr, stride};
    }
};

// The luma prediction of a block at (x, y) by `mv`, 8 or 16 wide: in the reference's planes where
// no mean is needed, else in `scratch` (stride 16).
inline Block luma_prediction(const QuarterPlanes& planes, int x, int y, Mv mv, int width,
                             int height, uint8_t* scratch) {
    const QuarterSamples at = planes.at(x, y, mv);
    if (at.second == nullptr) return {at.first, at.stride};
    if (width == 16) {
        mean_of_blocks<Bytes16>(at.first, at.second, at.stride, height, scratch);
    } else {
        mean_of_blocks<Bytes8>(at.first, at.second, at.stride, height, scratch);
    }
    return {scratch, 16};
}

// The chroma prediction (8.4.2.2.2): (x, y) and sizes in chroma samples, `out` of stride 8.
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

// The sums of absolute 4x4 Hadamard coefficients, in lanes for `columns_of`, of four rows of
// differences that `begin_transform` was applied to.
RF_INLINE Short16 hadamard_sums(const Short16* d) {
    const Short16 s0 = d[0] + d[1], s1 = d[0] - d[1], s2 = d[2] + d[3], s3 = d[2] - d[3];
    return absolute_sums(s0 + s2) + absolute_sums(s1 + s3) + absolute_sums(s0 - s2) +
           absolute_sums(s1 - s3);
}

// A macroblock's luma after `begin_transform`, which each prediction is compared with: as rows of
// sixteen samples, and its left and right half as rows of eight (`load_rows`).
struct TransformedSource {
    Short16 wide[16];
    Short16 half[2][8];

    void begin(const uint8_t* at, ptrdiff_t stride) {
        for (int y = 0; y < 16; ++y) wide[y] = begin_transform(load_rows<16>(at, stride, y));
        for (int i = 0; i < 8; ++i) {
            half[0][i] = begin_transform(load_rows<8>(at, stride, i));
            half[1][i] = begin_transform(load_rows<8>(at + 8, stride, i));
        }
    }

    // Of the block at (x, y), 8 or 16 wide.
    const Short16* rows(int x, int y, int width) const {
        return width == 16 ? wide + y : half[x >> 3] + y / 2;
    }
};

// Sum of absolute transformed differences, half the Hadamard sum, of a block 8 or 16 wide whose
// height is a multiple of 8. `difference(i)`: rows as `load_rows` numbers them.
template <int width, class Difference>
RF_INLINE uint32_t transformed_sum(int height, Difference difference) {
    Short16 sum{};
    for (int i = 0; i < height * width / 16; i += 4) {
        const Short16 d[4] = {difference(i), difference(i + 1), difference(i + 2),
                              difference(i + 3)};
        sum += hadamard_sums(d);
    }
    return sum_of_lanes(columns_of(sum));
}

// The same of rows of a TransformedSource and a prediction.
template <int width>
uint32_t transformed_difference(const Short16* source, const QuarterSamples& prediction,
                                int height) {
    const ptrdiff_t stride = prediction.stride;
    if (prediction.second == nullptr) {
        return transformed_sum<width>(height, [&](int i) {
            return source[i] - begin_transform(load_rows<width>(prediction.first, stride, i));
        });
    }
    return transformed_sum<width>(height, [&](int i) {
        const Bytes16 mean = mean_of_bytes(load_rows<width>(prediction.first, stride, i),
                                           load_rows<width>(prediction.second, stride, i));
        return source[i] - begin_transform(mean);
    });
}

// The same of two blocks of samples.
template <int width>
uint32_t transformed_difference(const uint8_t* a, ptrdiff_t a_stride, const uint8_t* b,
                                ptrdiff_t b_stride, int height) {
    return transformed_sum<width>(height, [&](int i) {
        return begin_transform(load_rows<width>(a, a_stride, i)) -
               begin_transform(load_rows<width>(b, b_stride, i));
    });
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
    alignas(16) uint8_t repeated[16];
    Short16 begun[side];
    for (int y = 0; y < side; ++y) {
        for (int i = 0; i < Strip::kPerVector; ++i) {
            __builtin_memcpy(repeated + side * i, source + y * stride, side);
        }
        begun[y] = begin_transform(load_rows<16>(repeated, 0, 0));
    }
    for (int v = 0; v < Strip::kVectors; ++v) {
        Short16 sum{};
        for (int y = 0; y < side; y += 4) {
            Short16 d[4];
            for (int i = 0; i < 4; ++i) {
                const Bytes16 row =
                    load_rows<16>(strip.sample + 16 * v, Strip::kStride, y + i);
                d[i] = begun[y + i] - begin_transform(row);
            }
            sum += hadamard_sums(d);
        }
        const Words4 columns = columns_of(sum);
        for (int i = 0; i < Strip::kPerVector; ++i) {
            differences[Strip::kPerVector * v + i] =
                side == 4 ? columns[i] : columns[2 * i] + columns[2 * i + 1];
        }
    }
}

}  // namespace

// Intra prediction (8.3): 4x4 and 8x8 luma blocks in nine modes, 16x16 luma, 8x8 chroma.
#pragma once

#include "h264/transform.h"

namespace {

enum BlockMode : int8_t {
    kVertical, kHorizontal, kDc, kDownLeft, kDownRight, kVerticalRight, kHorizontalDown,
    kVerticalLeft, kHorizontalUp, kBlockModes
};

inline int mean3(int a, int b, int c) { return (a + 2 * b + c + 2) >> 2; }
inline uint8_t clipped(int v) { return static_cast<uint8_t>(v < 0 ? 0 : v > 255 ? 255 : v); }

// The samples around a block of `side`: `at[0]` is the corner, at[1 + x] above it, to 2 * side,
// at[-1 - y] left of it.
template <int side>
struct Edge {
    uint8_t sample[3 * side + 1] = {};
    bool left, above, corner;
    const uint8_t* at() const { return sample + side; }
};

// Reads the edge of the block at `block`; where there is nothing above to the right, the last
// sample above goes on.
template <int side>
void read_edge(const uint8_t* block, ptrdiff_t stride, bool left, bool above, bool corner,
               bool right, Edge<side>& edge) {
    edge.left = left;
    edge.above = above;
    edge.corner = corner;
    uint8_t* at = edge.sample + side;
    if (corner) at[0] = block[-stride - 1];
    for (int y = 0; left && y < side; ++y) at[-1 - y] = block[y * stride - 1];
    for (int x = 0; above && x < 2 * side; ++x) {
        at[1 + x] = block[-stride + (x < side || right ? x : side - 1)];
    }
}

// 8.3.2.2.1: reference sample filtering of 8x8 blocks.
inline void filter_edge(const Edge<8>& in, Edge<8>& out) {
    out = in;
    const uint8_t* p = in.at();
    uint8_t* q = out.sample + 8;
    if (in.above) {
        q[1] = static_cast<uint8_t>(in.corner ? mean3(p[0], p[1], p[2])
                                              : (3 * p[1] + p[2] + 2) >> 2);
        for (int x = 2; x < 16; ++x) q[x] = static_cast<uint8_t>(mean3(p[x - 1], p[x], p[x + 1]));
        q[16] = static_cast<uint8_t>((p[15] + 3 * p[16] + 2) >> 2);
    }
    if (in.corner) {
        q[0] = static_cast<uint8_t>(in.above && in.left ? mean3(p[-1], p[0], p[1])
                                    : in.above          ? (3 * p[0] + p[1] + 2) >> 2
                                    : in.left           ? (3 * p[0] + p[-1] + 2) >> 2
                                                        : p[0]);
    }
    if (in.left) {
        q[-1] = static_cast<uint8_t>(in.corner ? mean3(p[0], p[-1], p[-2])
                                               : (3 * p[-1] + p[-2] + 2) >> 2);
        for (int y = 2; y < 8; ++y) q[-y] = static_cast<uint8_t>(mean3(p[1 - y], p[-y], p[-1 - y]));
        q[-8] = static_cast<uint8_t>((p[-7] + 3 * p[-8] + 2) >> 2);
    }
}

template <int side>
bool mode_available(int mode, const Edge<side>& e) {
    switch (mode) {
        case kDc: return true;
        case kVertical: case kDownLeft: case kVerticalLeft: return e.above;
        case kHorizontal: case kHorizontalUp: return e.left;
        default: return e.above && e.left && e.corner;
    }
}

template <int side>
int block_dc(const Edge<side>& e) {
    const uint8_t* p = e.at();
    int above = 0, left = 0;
    for (int i = 0; i < side; ++i) {
        above += e.above ? p[1 + i] : 0;
        left += e.left ? p[-1 - i] : 0;
    }
    if (e.above && e.left) return (above + left + side) / (2 * side);
    if (e.above || e.left) return (above + left + side / 2) / side;
    return 128;
}

// What the directional modes of 8.3.1.2 (4x4) and 8.3.2.2 (8x8) consist of: means of two and of
// three neighbours along the edge. Every row of a prediction is a slice of one of these sequences
// or of two of them interleaved.
template <int side>
struct EdgeMeans {
    static constexpr int kCount = 16 * ((3 * side + 16) / 16);
    uint8_t means2[kCount], means3[kCount];

    // `two(i)`: of p[i] and p[i + 1]; `three(i)`: around p[i], with the outermost samples repeated;
    // i from -side on.
    const uint8_t* two(int i) const { return means2 + side + i; }
    const uint8_t* three(int i) const { return means3 + side + i; }

    void measure(const Edge<side>& edge) {
        uint8_t p[kCount + 2] = {};
        __builtin_memcpy(p + 1, edge.sample, sizeof edge.sample);
        p[0] = p[1];
        p[3 * side + 2] = p[3 * side + 1];
        for (int i = 0; i < kCount; i += 16) {
            Bytes16 a, b, c;
            __builtin_memcpy(&a, p + i, sizeof a);
            __builtin_memcpy(&b, p + i + 1, sizeof b);
            __builtin_memcpy(&c, p + i + 2, sizeof c);
            const Bytes16 m2 = mean_of_bytes(b, c);
            // (a + 2 b + c + 2) >> 2 is the mean of b and of (a + c) >> 1, rounded up.
            const Bytes16 m3 = mean_of_bytes(b, (a & c) + ((a ^ c) >> 1));
            __builtin_memcpy(means2 + i, &m2, sizeof m2);
            __builtin_memcpy(means3 + i, &m3, sizeof m3);
        }
    }
};

// Row y of `out` is `side` samples from `first` + y * `step` on.
template <int side>
RF_INLINE void take_rows(const uint8_t* first, int step, uint8_t* out, ptrdiff_t stride, int rows) {
    for (int y = 0; y < rows; ++y) __builtin_memcpy(out + y * stride, first + y * step, side);
}

template <int side>
void predict_vertical_right(const EdgeMeans<side>& means, uint8_t* out, ptrdiff_t stride) {
    constexpr int kHalf = side / 2;
    uint8_t even[side + kHalf], odd[side + kHalf];
    for (int k = 1; k < kHalf; ++k) {
        even[kHalf - k] = *means.three(1 - 2 * k);
        odd[kHalf - k] = *means.three(-2 * k);
    }
    __builtin_memcpy(even + kHalf, means.two(0), side);
    __builtin_memcpy(odd + kHalf, means.three(0), side);
    take_rows<side>(even + kHalf, -1, out, 2 * stride, kHalf);
    take_rows<side>(odd + kHalf, -1, out + stride, 2 * stride, kHalf);
}

template <int side>
void predict_horizontal_down(const EdgeMeans<side>& means, uint8_t* out, ptrdiff_t stride) {
    uint8_t sequence[3 * side];
    for (int j = 0; j < side; ++j) {
        sequence[2 * j] = *means.two(j - side);
        sequence[2 * j + 1] = *means.three(j + 1 - side);
    }
    __builtin_memcpy(sequence + 2 * side, means.three(1), side);
    take_rows<side>(sequence + 2 * (side - 1), -2, out, stride, side);
}

template <int side>
void predict_horizontal_up(const Edge<side>& edge, const EdgeMeans<side>& means, uint8_t* out,
                           ptrdiff_t stride) {
    uint8_t sequence[3 * side];
    for (int j = 0; j < side - 1; ++j) {
        sequence[2 * j] = *means.two(-2 - j);
        sequence[2 * j + 1] = *means.three(-2 - j);
    }
    __builtin_memset(sequence + 2 * side - 2, edge.at()[-side], side + 2);
    take_rows<side>(sequence, 2, out, stride, side);
}

template <int side>
void predict_block(int mode, const Edge<side>& edge, const EdgeMeans<side>& means, uint8_t* out,
                   ptrdiff_t stride) {
    switch (mode) {
        case kVertical: return take_rows<side>(edge.at() + 1, 0, out, stride, side);
        case kHorizontal:
            for (int y = 0; y < side; ++y) {
                __builtin_memset(out + y * stride, edge.at()[-1 - y], side);
            }
            return;
        case kDownLeft: return take_rows<side>(means.three(2), 1, out, stride, side);
        case kDownRight: return take_rows<side>(means.three(0), -1, out, stride, side);
        case kVerticalRight: return predict_vertical_right(means, out, stride);
        case kHorizontalDown: return predict_horizontal_down(means, out, stride);
        case kVerticalLeft:
            take_rows<side>(means.two(1), 1, out, 2 * stride, side / 2);
            return take_rows<side>(means.three(2), 1, out + stride, 2 * stride, side / 2);
        case kHorizontalUp: return predict_horizontal_up(edge, means, out, stride);
        default: {
            const int dc = block_dc(edge);
            for (int y = 0; y < side; ++y) __builtin_memset(out + y * stride, dc, side);
        }
    }
}

// Plane prediction of luma (8.3.3.4) and of chroma (8.3.4.4).
template <int side>
void predict_plane(const uint8_t* at, ptrdiff_t stride, uint8_t* out) {
    constexpr int kHalf = side / 2;
    int h = 0, v = 0;
    for (int i = 0; i < kHalf; ++i) {
        h += (i + 1) * (at[-stride + kHalf + i] - at[-stride + kHalf - 2 - i]);
        v += (i + 1) * (at[(kHalf + i) * stride - 1] - at[(kHalf - 2 - i) * stride - 1]);
    }
    const int factor = side == 16 ? 5 : 34;
    const int b = (factor * h + 32) >> 6, c = (factor * v + 32) >> 6;
    const int a = 16 * (at[(side - 1) * stride - 1] + at[-stride + side - 1]);
    for (int y = 0; y < side; ++y) {
        for (int x = 0; x < side; x += 8) {
            const Row8 across = Row8{0, 1, 2, 3, 4, 5, 6, 7} + (x - kHalf + 1);
            const Row8 v = (across * b + (a + c * (y - kHalf + 1) + 16)) >> 5;
            store_clipped(v, out + side * y + x);
        }
    }
}

// Intra16x16PredMode: 0 vertical, 1 horizontal, 2 DC, 3 plane. `at`: the macroblock in the picture.
inline bool predict_luma16(int mode, const uint8_t* at, ptrdiff_t stride, const Around& around,
                           uint8_t* out) {
    const bool left = around.left, above = around.above;
    if ((mode == 0 && !above) || (mode == 1 && !left) ||
        (mode == 3 && !(left && above && around.above_left))) {
        return false;
    }
    if (mode == 3) {
        predict_plane<16>(at, stride, out);
        return true;
    }
    int sum = 0;
    for (int i = 0; mode == 2 && i < 16; ++i) {
        sum += (above ? at[-stride + i] : 0) + (left ? at[i * stride - 1] : 0);
    }
    const int dc = above && left ? (sum + 16) >> 5 : above || left ? (sum + 8) >> 4 : 128;
    for (int y = 0; y < 16; ++y) {
        if (mode == 0) {
            __builtin_memcpy(out + 16 * y, at - stride, 16);
        } else {
            __builtin_memset(out + 16 * y, mode == 1 ? at[y * stride - 1] : dc, 16);
        }
    }
    return true;
}

// intra_chroma_pred_mode: 0 DC, 1 horizontal, 2 vertical, 3 plane (8.3.4).
inline bool predict_chroma8(int mode, const uint8_t* at, ptrdiff_t stride, const Around& around,
                            uint8_t* out) {
    const bool left = around.left, above = around.above;
    if ((mode == 2 && !above) || (mode == 1 && !left) ||
        (mode == 3 && !(left && above && around.above_left))) {
        return false;
    }
    if (mode == 3) {
        predict_plane<8>(at, stride, out);
        return true;
    }
    for (int block = 0; block < 4; ++block) {
        const int bx = 4 * (block & 1), by = 4 * (block >> 1);
        int from_above = 0, from_left = 0;
        for (int i = 0; i < 4; ++i) {
            from_above += above ? at[-stride + bx + i] : 0;
            from_left += left ? at[(by + i) * stride - 1] : 0;
        }
        const bool both = (bx == 0) == (by == 0);  // the blocks on the diagonal take the mean
        int dc = 128;
        if (both && above && left) {
            dc = (from_above + from_left + 4) >> 3;
        } else if (above && (bx > 0 || !left || (both && !left))) {
            dc = (from_above + 2) >> 2;
        } else if (left) {
            dc = (from_left + 2) >> 2;
        } else if (above) {
            dc = (from_above + 2) >> 2;
        }
        for (int y = by; y < by + 4; ++y) {
            uint8_t* row = out + 8 * y + bx;
            if (mode == 2) {
                __builtin_memcpy(row, at - stride + bx, 4);
            } else {
                __builtin_memset(row, mode == 1 ? at[y * stride - 1] : dc, 4);
            }
        }
    }
    return true;
}

}  // namespace

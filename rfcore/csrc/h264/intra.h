// Intra prediction (8.3): 4x4 and 8x8 luma blocks in nine modes, 16x16 luma, 8x8 chroma.
#pragma once

#include "h264/transform.h"

namespace {

enum BlockMode : int8_t {
    kVertical, kHorizontal, kDc, kDownLeft, kDownRight, kVerticalRight, kHorizontalDown,
    kVerticalLeft, kHorizontalUp, kBlockModes
};

inline int mean2(int a, int b) { return (a + b + 1) >> 1; }
inline int mean3(int a, int b, int c) { return (a + 2 * b + c + 2) >> 2; }
inline uint8_t clipped(int v) { return static_cast<uint8_t>(v < 0 ? 0 : v > 255 ? 255 : v); }

// The samples around a block of `side`: `at[0]` is the corner, at[1 + x] above it, to 2 * side,
// at[-1 - y] left of it.
template <int side>
struct Edge {
    uint8_t sample[3 * side + 1];
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

// One sample of 8.3.1.2 (4x4) or 8.3.2.2 (8x8). `p` as in Edge; left samples go downwards from it.
template <int side>
int block_sample(int mode, const uint8_t* p, int dc, int x, int y) {
    const uint8_t* above = p + 1;
    const auto left = [p](int i) -> int { return p[-1 - i]; };  // left(-1) is the corner
    const auto top = [p](int i) -> int { return p[1 + i]; };    // top(-1) is the corner
    switch (mode) {
        case kVertical: return above[x];
        case kHorizontal: return left(y);
        case kDownLeft:
            return x == side - 1 && y == side - 1
                       ? (top(2 * side - 2) + 3 * top(2 * side - 1) + 2) >> 2
                       : mean3(top(x + y), top(x + y + 1), top(x + y + 2));
        case kDownRight: {
            const uint8_t* d = p + x - y;
            return mean3(d[-1], d[0], d[1]);
        }
        case kVerticalRight: {
            const int z = 2 * x - y, i = x - (y >> 1);
            if (z >= 0) {
                return z & 1 ? mean3(top(i - 2), top(i - 1), top(i)) : mean2(top(i - 1), top(i));
            }
            if (z == -1) return mean3(left(0), p[0], top(0));
            return mean3(left(y - 2 * x - 1), left(y - 2 * x - 2), left(y - 2 * x - 3));
        }
        case kHorizontalDown: {
            const int z = 2 * y - x, i = y - (x >> 1);
            if (z >= 0) {
                return z & 1 ? mean3(left(i - 2), left(i - 1), left(i))
                             : mean2(left(i - 1), left(i));
            }
            if (z == -1) return mean3(left(0), p[0], top(0));
            return mean3(top(x - 2 * y - 1), top(x - 2 * y - 2), top(x - 2 * y - 3));
        }
        case kVerticalLeft: {
            const int i = x + (y >> 1);
            return y & 1 ? mean3(top(i), top(i + 1), top(i + 2)) : mean2(top(i), top(i + 1));
        }
        case kHorizontalUp: {
            const int z = x + 2 * y, i = y + (x >> 1);
            if (z > 2 * side - 3) return left(side - 1);
            if (z == 2 * side - 3) return (left(side - 2) + 3 * left(side - 1) + 2) >> 2;
            return z & 1 ? mean3(left(i), left(i + 1), left(i + 2)) : mean2(left(i), left(i + 1));
        }
        default: return dc;
    }
}

template <int side, int mode>
void predict_block_mode(const Edge<side>& edge, uint8_t* out, ptrdiff_t stride) {
    const int dc = mode == kDc ? block_dc(edge) : 0;
    for (int y = 0; y < side; ++y) {
        for (int x = 0; x < side; ++x) {
            out[y * stride + x] =
                static_cast<uint8_t>(block_sample<side>(mode, edge.at(), dc, x, y));
        }
    }
}

template <int side>
void predict_block(int mode, const Edge<side>& edge, uint8_t* out, ptrdiff_t stride) {
    switch (mode) {
        case kVertical: return predict_block_mode<side, kVertical>(edge, out, stride);
        case kHorizontal: return predict_block_mode<side, kHorizontal>(edge, out, stride);
        case kDc: return predict_block_mode<side, kDc>(edge, out, stride);
        case kDownLeft: return predict_block_mode<side, kDownLeft>(edge, out, stride);
        case kDownRight: return predict_block_mode<side, kDownRight>(edge, out, stride);
        case kVerticalRight: return predict_block_mode<side, kVerticalRight>(edge, out, stride);
        case kHorizontalDown: return predict_block_mode<side, kHorizontalDown>(edge, out, stride);
        case kVerticalLeft: return predict_block_mode<side, kVerticalLeft>(edge, out, stride);
        default: return predict_block_mode<side, kHorizontalUp>(edge, out, stride);
    }
}

// 8.3.3.4 and 8.3.4.4.
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
        for (int x = 0; x < side; ++x) {
            out[side * y + x] = clipped((a + b * (x - kHalf + 1) + c * (y - kHalf + 1) + 16) >> 5);
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
        for (int x = 0; x < 16; ++x) {
            out[16 * y + x] = mode == 0 ? at[-stride + x] : mode == 1 ? at[y * stride - 1]
                                                                      : static_cast<uint8_t>(dc);
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
            for (int x = bx; x < bx + 4; ++x) {
                out[8 * y + x] = mode == 1   ? at[y * stride - 1]
                                 : mode == 2 ? at[-stride + x]
                                             : static_cast<uint8_t>(dc);
            }
        }
    }
    return true;
}

}  // namespace

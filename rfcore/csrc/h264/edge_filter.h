// The deblocking filter across one edge (8.7.2.2 to 8.7.2.4): sixteen samples of luma, or eight of
// either chroma plane. The scalar kernels go line by line, as the standard says it; the others take
// all lines of an edge at once and give the same samples.
#pragma once

#include "h264/inter.h"

namespace {

// Tables 8-16 (alpha', beta') and 8-17 (t'C0 for bS 1, 2, 3), from index 16 on; below nothing is
// filtered.
constexpr int kFirstFiltered = 16;
constexpr uint8_t kAlpha[36] = {4,  4,  5,  6,  7,  8,  9,  10, 12,  13,  15,  17,
                                20, 22, 25, 28, 32, 36, 40, 45, 50,  56,  63,  71,
                                80, 90, 101, 113, 127, 144, 162, 182, 203, 226, 255, 255};
constexpr uint8_t kBeta[36] = {2, 2, 2,  3,  3,  3,  3,  4,  4,  4,  6,  6,  7,  7,  8,  8,  9,  9,
                               10, 10, 11, 11, 12, 12, 13, 13, 14, 14, 15, 15, 16, 16, 17, 17, 18, 18};
constexpr uint8_t kClip[36][3] = {
    {0, 0, 0},  {0, 0, 1},  {0, 0, 1},  {0, 0, 1},   {0, 0, 1},   {0, 1, 1},
    {0, 1, 1},  {1, 1, 1},  {1, 1, 1},  {1, 1, 1},   {1, 1, 1},   {1, 1, 2},
    {1, 1, 2},  {1, 1, 2},  {1, 1, 2},  {1, 2, 3},   {1, 2, 3},   {2, 2, 3},
    {2, 2, 4},  {2, 3, 4},  {2, 3, 4},  {3, 3, 5},   {3, 4, 6},   {3, 4, 6},
    {4, 5, 7},  {4, 5, 8},  {4, 6, 9},  {5, 7, 10},  {6, 8, 11},  {6, 8, 13},
    {7, 10, 14}, {8, 11, 16}, {9, 12, 18}, {10, 13, 20}, {11, 15, 23}, {13, 17, 25}};

// An edge to filter: bS for each quarter of it, and what its quantiser allows.
struct EdgeLimits {
    uint8_t strength[4];
    int16_t clip[4];  // tC0 for each quarter, -1 where bS is 0
    int16_t alpha, beta;
};

// The thresholds of 8.7.2.2; false where no sample can change. `qp`: the mean of both sides.
inline bool set_limits(const uint8_t* strength, int qp, EdgeLimits& edge) {
    const int index = qp - kFirstFiltered;
    if (index < 0) return false;
    edge.alpha = kAlpha[index];
    edge.beta = kBeta[index];
    for (int i = 0; i < 4; ++i) {
        const int s = edge.strength[i] = strength[i];
        edge.clip[i] = s == 0 ? -1 : s == 4 ? 0 : static_cast<int16_t>(kClip[index][s - 1]);
    }
    return true;
}

#if defined(RF_ISA_SCALAR)

inline int limited(int v, int most) { return v < -most ? -most : v > most ? most : v; }
inline int apart(int a, int b) { return a < b ? b - a : a - b; }

// Samples p3 p2 p1 p0 | q0 q1 q2 q3 of a line across an edge; `q0` at `at`, the others by `step`.
struct Line {
    uint8_t* at;
    ptrdiff_t step;
    int p(int i) const { return at[-(i + 1) * step]; }
    int q(int i) const { return at[i * step]; }
    void set_p(int i, int v) { at[-(i + 1) * step] = static_cast<uint8_t>(v); }
    void set_q(int i, int v) { at[i * step] = static_cast<uint8_t>(v); }
};

// 8.7.2.3, bS 1 to 3.
inline void filter_normal(Line line, const EdgeLimits& edge, int clip, bool luma) {
    const int p0 = line.p(0), p1 = line.p(1), q0 = line.q(0), q1 = line.q(1);
    const bool flat_p = luma && apart(line.p(2), p0) < edge.beta;
    const bool flat_q = luma && apart(line.q(2), q0) < edge.beta;
    const int mean = (p0 + q0 + 1) >> 1;
    if (flat_p) line.set_p(1, p1 + limited((line.p(2) + mean - 2 * p1) >> 1, clip));
    if (flat_q) line.set_q(1, q1 + limited((line.q(2) + mean - 2 * q1) >> 1, clip));
    const int most = luma ? clip + flat_p + flat_q : clip + 1;
    const int delta = limited((4 * (q0 - p0) + (p1 - q1) + 4) >> 3, most);
    line.set_p(0, clipped(p0 + delta));
    line.set_q(0, clipped(q0 - delta));
}

// 8.7.2.4, bS 4: one side; `line` runs away from the edge on the p side, `o0`, `o1` are opposite.
inline void filter_strong(Line line, int o0, int o1, bool smooth) {
    const int p0 = line.p(0), p1 = line.p(1);
    if (!smooth) return line.set_p(0, (2 * p1 + p0 + o1 + 2) >> 2);
    const int p2 = line.p(2), p3 = line.p(3);
    line.set_p(0, (p2 + 2 * p1 + 2 * p0 + 2 * o0 + o1 + 4) >> 3);
    line.set_p(1, (p2 + p1 + p0 + o0 + 2) >> 2);
    line.set_p(2, (2 * p3 + 3 * p2 + p1 + p0 + o0 + 4) >> 3);
}

inline void filter_line(Line line, const EdgeLimits& edge, int quarter, bool luma) {
    const int p0 = line.p(0), p1 = line.p(1), q0 = line.q(0), q1 = line.q(1);
    if (edge.strength[quarter] == 0 || apart(p0, q0) >= edge.alpha ||
        apart(p1, p0) >= edge.beta || apart(q1, q0) >= edge.beta) {
        return;
    }
    if (edge.strength[quarter] < 4) return filter_normal(line, edge, edge.clip[quarter], luma);
    const bool near = luma && apart(p0, q0) < (edge.alpha >> 2) + 2;
    const bool smooth_p = near && apart(line.p(2), p0) < edge.beta;
    const bool smooth_q = near && apart(line.q(2), q0) < edge.beta;
    filter_strong(line, q0, q1, smooth_p);
    filter_strong({line.at - line.step, -line.step}, p0, p1, smooth_q);
}

// `at`: the first sample behind the edge. `down`: the edge is horizontal.
inline void filter_luma_edge(uint8_t* at, ptrdiff_t stride, bool down, const EdgeLimits& edge) {
    const ptrdiff_t step = down ? stride : 1, along = down ? 1 : stride;
    for (int i = 0; i < 16; ++i) filter_line({at + i * along, step}, edge, i / 4, true);
}

inline void filter_chroma_edge(uint8_t* cb, uint8_t* cr, ptrdiff_t stride, bool down,
                               const EdgeLimits& edge) {
    const ptrdiff_t step = down ? stride : 1, along = down ? 1 : stride;
    for (int i = 0; i < 8; ++i) {
        filter_line({cb + i * along, step}, edge, i / 2, false);
        filter_line({cr + i * along, step}, edge, i / 2, false);
    }
}

#else

RF_INLINE Short16 splat16(int v) { return Short16{} + static_cast<int16_t>(v); }
RF_INLINE Short16 least(Short16 a, Short16 b) { return a < b ? a : b; }
RF_INLINE Short16 most(Short16 a, Short16 b) { return a > b ? a : b; }
RF_INLINE Short16 limited(Short16 v, Short16 limit) { return most(least(v, limit), -limit); }
RF_INLINE Short16 widened(Bytes16 v) { return __builtin_convertvector(v, Short16); }
RF_INLINE Bytes16 narrowed(Short16 v) { return __builtin_convertvector(v, Bytes16); }

// Where the samples of an edge may change at all; `p`, `q` from the edge outwards.
RF_INLINE Short16 filtered(const Short16* p, const Short16* q, const EdgeLimits& edge) {
    const Short16 beta = splat16(edge.beta);
    return (magnitude(p[0] - q[0]) < splat16(edge.alpha)) & (magnitude(p[1] - p[0]) < beta) &
           (magnitude(q[1] - q[0]) < beta);
}

// 8.7.2.3, bS 1 to 3. `clip`: tC0 of every line, -1 where bS is 0.
RF_INLINE void filter_normal(Short16* p, Short16* q, const EdgeLimits& edge, Short16 clip,
                             bool luma) {
    const Short16 change = filtered(p, q, edge) & (clip >= 0);
    Short16 limit = clip + 1;
    const Short16 p0 = p[0], p1 = p[1], q0 = q[0], q1 = q[1];
    if (luma) {
        const Short16 beta = splat16(edge.beta), mean = (p0 + q0 + 1) >> 1;
        const Short16 flat_p = change & (magnitude(p[2] - p0) < beta);
        const Short16 flat_q = change & (magnitude(q[2] - q0) < beta);
        p[1] += flat_p & limited((p[2] + mean - 2 * p1) >> 1, clip);
        q[1] += flat_q & limited((q[2] + mean - 2 * q1) >> 1, clip);
        limit = clip - flat_p - flat_q;
    }
    const Short16 delta = change & limited((4 * (q0 - p0) + (p1 - q1) + 4) >> 3, limit);
    p[0] = most(least(p0 + delta, splat16(255)), splat16(0));
    q[0] = most(least(q0 - delta, splat16(255)), splat16(0));
}

// 8.7.2.4, bS 4: side `p` of the edge, `o0` and `o1` are the nearest on the other side.
RF_INLINE void filter_strong_side(Short16* p, Short16 o0, Short16 o1, Short16 change,
                                  Short16 smooth, bool luma) {
    const Short16 p0 = p[0], p1 = p[1], short_filter = (2 * p1 + p0 + o1 + 2) >> 2;
    p[0] = change ? short_filter : p0;
    if (!luma) return;
    const Short16 p2 = p[2], sum = p1 + p0 + o0;
    p[0] = smooth ? (p2 + 2 * sum + o1 + 4) >> 3 : p[0];
    p[1] = smooth ? (p2 + sum + 2) >> 2 : p1;
    p[2] = smooth ? (2 * p[3] + 3 * p2 + sum + 4) >> 3 : p2;
}

RF_INLINE void filter_strong(Short16* p, Short16* q, const EdgeLimits& edge, bool luma) {
    const Short16 change = filtered(p, q, edge), p0 = p[0], p1 = p[1], q0 = q[0], q1 = q[1];
    Short16 smooth_p{}, smooth_q{};
    if (luma) {
        const Short16 beta = splat16(edge.beta);
        const Short16 near = change & (magnitude(p0 - q0) < splat16((edge.alpha >> 2) + 2));
        smooth_p = near & (magnitude(p[2] - p0) < beta);
        smooth_q = near & (magnitude(q[2] - q0) < beta);
    }
    filter_strong_side(p, q0, q1, change, smooth_p, luma);
    filter_strong_side(q, p0, p1, change, smooth_q, luma);
}

// bS 4 is found along whole edges of macroblocks only.
RF_INLINE void filter_samples(Short16* p, Short16* q, const EdgeLimits& edge, bool luma) {
    if (edge.strength[0] == 4) return filter_strong(p, q, edge, luma);
    Short16 clip;
    for (int i = 0; i < 16; ++i) clip[i] = edge.clip[luma ? i / 4 : i % 8 / 2];
    filter_normal(p, q, edge, clip, luma);
}

// Interleaves the bytes of v[k] and v[k + count / 2]. The index of a byte among all is then rotated
// left by a bit, so that a few such steps transpose a matrix whose sides are powers of two.
template <int count>
RF_INLINE void interleave(Bytes16* v) {
    Bytes16 in[count];
    __builtin_memcpy(in, v, sizeof in);
    for (int k = 0; k < count / 2; ++k) {
        const Bytes16 a = in[k], b = in[k + count / 2];
        v[2 * k] = __builtin_shuffle(
            a, b, Bytes16{0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23});
        v[2 * k + 1] = __builtin_shuffle(
            a, b, Bytes16{8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31});
    }
}

// Rows p[count / 2 - 1] ... p[0], q[0] ... q[count / 2 - 1].
template <int count>
RF_INLINE void widen(const Bytes16* v, Short16* p, Short16* q) {
    for (int i = 0; i < count / 2; ++i) {
        p[i] = widened(v[count / 2 - 1 - i]);
        q[i] = widened(v[count / 2 + i]);
    }
}

template <int count>
RF_INLINE void narrow(const Short16* p, const Short16* q, Bytes16* v) {
    for (int i = 0; i < count / 2; ++i) {
        v[count / 2 - 1 - i] = narrowed(p[i]);
        v[count / 2 + i] = narrowed(q[i]);
    }
}

// `at`: the first sample behind the edge. `down`: the edge is horizontal.
inline void filter_luma_edge(uint8_t* at, ptrdiff_t stride, bool down, const EdgeLimits& edge) {
    Bytes16 v[8];
    Short16 p[4], q[4];
    if (down) {
        for (int i = 0; i < 8; ++i) __builtin_memcpy(&v[i], at + (i - 4) * stride, 16);
        widen<8>(v, p, q);
        filter_samples(p, q, edge, true);
        narrow<8>(p, q, v);
        for (int i = 1; i < 7; ++i) __builtin_memcpy(at + (i - 4) * stride, &v[i], 16);
        return;
    }
    uint8_t* const bytes = reinterpret_cast<uint8_t*>(v);
    for (int y = 0; y < 16; ++y) __builtin_memcpy(bytes + 8 * y, at - 4 + y * stride, 8);
    for (int i = 0; i < 4; ++i) interleave<8>(v);
    widen<8>(v, p, q);
    filter_samples(p, q, edge, true);
    narrow<8>(p, q, v);
    for (int i = 0; i < 3; ++i) interleave<8>(v);
    for (int y = 0; y < 16; ++y) __builtin_memcpy(at - 4 + y * stride, bytes + 8 * y, 8);
}

// Both planes at once: their quantisers are the same.
inline void filter_chroma_edge(uint8_t* cb, uint8_t* cr, ptrdiff_t stride, bool down,
                               const EdgeLimits& edge) {
    Bytes16 v[4];
    Short16 p[2], q[2];
    uint8_t* const bytes = reinterpret_cast<uint8_t*>(v);
    uint8_t* const planes[2] = {cb, cr};
    const int lines = down ? 4 : 8, length = down ? 8 : 4;
    const auto line = [&](int c, int i) {
        return planes[c] + (down ? (i - 2) * stride : i * stride - 2);
    };
    const auto room = [&](int c, int i) { return bytes + (down ? 16 * i + 8 * c : 32 * c + 4 * i); };
    for (int c = 0; c < 2; ++c) {
        for (int i = 0; i < lines; ++i) {
            __builtin_memcpy(room(c, i), line(c, i), static_cast<size_t>(length));
        }
    }
    for (int i = 0; !down && i < 4; ++i) interleave<4>(v);
    widen<4>(v, p, q);
    filter_samples(p, q, edge, false);
    narrow<4>(p, q, v);
    for (int i = 0; !down && i < 2; ++i) interleave<4>(v);
    for (int c = 0; c < 2; ++c) {
        for (int i = 0; i < lines; ++i) {
            __builtin_memcpy(line(c, i), room(c, i), static_cast<size_t>(length));
        }
    }
}

#endif

}  // namespace

// Transforms and the tables of quantisers (8.5.6 to 8.5.13).
//
// Costs are integers throughout, so that every machine decides alike: J = 2^16 D + lambda_q8 R_q8
// with D a sum of squared sample differences, R_q8 and lambda_q8 in 1/256.
#pragma once

#include "h264/lanes.h"
#include "h264/syntax.h"

namespace {

// normAdjust4x4 (8-315) by [qp % 6][class]: both indices even, both odd, else.
constexpr uint8_t kNorm4[6][3] = {{10, 16, 13}, {11, 18, 14}, {13, 20, 16},
                                  {14, 23, 18}, {16, 25, 20}, {18, 29, 23}};
// normAdjust8x8 (8-318).
constexpr uint8_t kNorm8[6][6] = {{20, 18, 32, 19, 25, 24}, {22, 19, 35, 21, 28, 26},
                                  {26, 23, 42, 24, 33, 31}, {28, 25, 45, 26, 35, 33},
                                  {32, 28, 51, 30, 40, 38}, {36, 32, 58, 34, 46, 43}};

constexpr int class4(int x, int y) { return x % 2 == 0 && y % 2 == 0 ? 0 : x % 2 && y % 2 ? 1 : 2; }

constexpr int class8(int x, int y) {
    if (x % 4 == 0 && y % 4 == 0) return 0;
    if (x % 2 == 1 && y % 2 == 1) return 1;
    if (x % 4 == 2 && y % 4 == 2) return 2;
    if ((x % 4 == 0 && y % 2 == 1) || (x % 2 == 1 && y % 4 == 0)) return 3;
    if ((x % 4 == 0 && y % 4 == 2) || (x % 4 == 2 && y % 4 == 0)) return 4;
    return 5;
}

// Of every coefficient of a block, for one qp % 6 (all tables are symmetric, so they hold for
// transposed blocks too): `norm` dequantises; `multiplier` quantises, level = w * multiplier /
// 2^(15 + qp / 6), for 8x8 blocks 2^(16 + qp / 6); `energy` is 2^8 times the squared error in
// samples that a whole level makes, at qp / 6 = 0.
template <int side>
struct Quantiser {
    uint8_t norm[side * side];
    uint16_t multiplier[side * side];
    uint16_t energy[side * side];
};

// Squared norms of the inverse transforms' basis functions: of 4x4 times 2, of 8x8 times 32.
constexpr int basis4(int i) { return i % 2 ? 5 : 8; }
constexpr int basis8(int i) { return i % 4 == 0 ? 256 : i % 2 ? 289 : 160; }
// Products of forward and inverse 4x4 basis functions: the odd forward ones are twice as long.
constexpr int product4(int i) { return i % 2 ? 5 : 4; }

constexpr Quantiser<4> make_quantiser4(int remainder) {
    Quantiser<4> q{};
    for (int i = 0; i < 16; ++i) {
        const int x = i % 4, y = i / 4, norm = kNorm4[remainder][class4(x, y)];
        const int basis = basis4(x) * basis4(y);  // times 4
        q.norm[i] = static_cast<uint8_t>(norm);
        const int divisor = norm * product4(x) * product4(y);
        q.multiplier[i] = static_cast<uint16_t>(((1 << 21) + divisor / 2) / divisor);
        q.energy[i] = static_cast<uint16_t>(norm * norm * basis / 64);
    }
    return q;
}

// For coefficients that were transformed once more: all are DC of their block.
constexpr Quantiser<4> make_quantiser_dc(int remainder) {
    const Quantiser<4> ac = make_quantiser4(remainder);
    Quantiser<4> q{};
    for (int i = 0; i < 16; ++i) {
        q.norm[i] = ac.norm[0];
        q.multiplier[i] = ac.multiplier[0];
        q.energy[i] = ac.energy[0];
    }
    return q;
}

constexpr Quantiser<8> make_quantiser8(int remainder) {
    Quantiser<8> q{};
    for (int i = 0; i < 64; ++i) {
        const int x = i % 8, y = i / 8, norm = kNorm8[remainder][class8(x, y)];
        const int64_t basis = int64_t{1} * basis8(x) * basis8(y);  // times 1024
        const int64_t divisor = norm * basis;
        q.norm[i] = static_cast<uint8_t>(norm);
        q.multiplier[i] = static_cast<uint16_t>(((int64_t{1} << 34) + divisor / 2) / divisor);
        q.energy[i] = static_cast<uint16_t>(norm * norm * basis >> 18);
    }
    return q;
}

constexpr Quantiser<4> kQuantiser4[6] = {make_quantiser4(0), make_quantiser4(1), make_quantiser4(2),
                                         make_quantiser4(3), make_quantiser4(4), make_quantiser4(5)};
constexpr Quantiser<4> kQuantiserDc[6] = {
    make_quantiser_dc(0), make_quantiser_dc(1), make_quantiser_dc(2),
    make_quantiser_dc(3), make_quantiser_dc(4), make_quantiser_dc(5)};
constexpr Quantiser<8> kQuantiser8[6] = {make_quantiser8(0), make_quantiser8(1), make_quantiser8(2),
                                         make_quantiser8(3), make_quantiser8(4), make_quantiser8(5)};

// QP_C by qP_I (Table 8-15).
constexpr uint8_t kChromaQp[52] = {0,  1,  2,  3,  4,  5,  6,  7,  8,  9,  10, 11, 12,
                                   13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25,
                                   26, 27, 28, 29, 29, 30, 31, 32, 32, 33, 34, 34, 35,
                                   35, 36, 36, 37, 37, 37, 38, 38, 38, 39, 39, 39, 39};

RF_INLINE void transpose4(Row4* r) {
    const Row4 a = __builtin_shuffle(r[0], r[1], Row4{0, 4, 1, 5});
    const Row4 b = __builtin_shuffle(r[0], r[1], Row4{2, 6, 3, 7});
    const Row4 c = __builtin_shuffle(r[2], r[3], Row4{0, 4, 1, 5});
    const Row4 d = __builtin_shuffle(r[2], r[3], Row4{2, 6, 3, 7});
    r[0] = __builtin_shuffle(a, c, Row4{0, 1, 4, 5});
    r[1] = __builtin_shuffle(a, c, Row4{2, 3, 6, 7});
    r[2] = __builtin_shuffle(b, d, Row4{0, 1, 4, 5});
    r[3] = __builtin_shuffle(b, d, Row4{2, 3, 6, 7});
}

RF_INLINE void transpose8(Row8* r) {
    Row8 t[8];
    for (int i = 0; i < 4; ++i) {  // pairs of elements of rows 2i, 2i + 1
        t[2 * i] = __builtin_shuffle(r[2 * i], r[2 * i + 1], Row8{0, 8, 2, 10, 4, 12, 6, 14});
        t[2 * i + 1] = __builtin_shuffle(r[2 * i], r[2 * i + 1], Row8{1, 9, 3, 11, 5, 13, 7, 15});
    }
    Row8 u[8];
    for (int half = 0; half < 2; ++half) {
        for (int odd = 0; odd < 2; ++odd) {
            const Row8 a = t[4 * half + odd], b = t[4 * half + 2 + odd];
            u[4 * half + odd] = __builtin_shuffle(a, b, Row8{0, 1, 8, 9, 4, 5, 12, 13});
            u[4 * half + 2 + odd] = __builtin_shuffle(a, b, Row8{2, 3, 10, 11, 6, 7, 14, 15});
        }
    }
    for (int i = 0; i < 4; ++i) {
        r[i] = __builtin_shuffle(u[i], u[4 + i], Row8{0, 1, 2, 3, 8, 9, 10, 11});
        r[4 + i] = __builtin_shuffle(u[i], u[4 + i], Row8{4, 5, 6, 7, 12, 13, 14, 15});
    }
}

RF_INLINE void forward_columns4(Row4* r) {
    const Row4 outer = r[0] + r[3], inner = r[1] + r[2];
    const Row4 far = r[0] - r[3], near = r[1] - r[2];
    r[0] = outer + inner;
    r[1] = 2 * far + near;
    r[2] = outer - inner;
    r[3] = far - 2 * near;
}

// The transpose of 8.5.13's flow graph.
RF_INLINE void forward_columns8(Row8* r) {
    const Row8 s0 = r[0] + r[7], s1 = r[1] + r[6], s2 = r[2] + r[5], s3 = r[3] + r[4];
    const Row8 d0 = r[0] - r[7], d1 = r[1] - r[6], d2 = r[2] - r[5], d3 = r[3] - r[4];
    const Row8 e0 = s0 + s3, e1 = s1 + s2, e2 = s0 - s3, e3 = s1 - s2;
    const Row8 o0 = d1 + d2 + d0 + (d0 >> 1), o1 = d0 - d3 - d2 - (d2 >> 1);
    const Row8 o2 = d0 + d3 - d1 - (d1 >> 1), o3 = d1 - d2 + d3 + (d3 >> 1);
    r[0] = e0 + e1;
    r[1] = o0 + (o3 >> 2);
    r[2] = e2 + (e3 >> 1);
    r[3] = o1 + (o2 >> 2);
    r[4] = e0 - e1;
    r[5] = o2 - (o1 >> 2);
    r[6] = (e2 >> 1) - e3;
    r[7] = (o0 >> 2) - o3;
}

RF_INLINE void inverse_columns4(Row4* r) {
    const Row4 e0 = r[0] + r[2], e1 = r[0] - r[2];
    const Row4 e2 = (r[1] >> 1) - r[3], e3 = r[1] + (r[3] >> 1);
    r[0] = e0 + e3;
    r[1] = e1 + e2;
    r[2] = e1 - e2;
    r[3] = e0 - e3;
}

RF_INLINE void inverse_columns8(Row8* r) {
    const Row8 a0 = r[0] + r[4], a2 = r[0] - r[4];
    const Row8 a4 = (r[2] >> 1) - r[6], a6 = r[2] + (r[6] >> 1);
    const Row8 a1 = r[5] - r[3] - r[7] - (r[7] >> 1), a3 = r[1] + r[7] - r[3] - (r[3] >> 1);
    const Row8 a5 = r[7] - r[1] + r[5] + (r[5] >> 1), a7 = r[3] + r[5] + r[1] + (r[1] >> 1);
    const Row8 b0 = a0 + a6, b2 = a2 + a4, b4 = a2 - a4, b6 = a0 - a6;
    const Row8 b1 = a1 + (a7 >> 2), b3 = a3 + (a5 >> 2), b5 = (a3 >> 2) - a5, b7 = a7 - (a1 >> 2);
    r[0] = b0 + b7;
    r[1] = b2 + b5;
    r[2] = b4 + b3;
    r[3] = b6 + b1;
    r[4] = b6 - b1;
    r[5] = b4 - b3;
    r[6] = b2 - b5;
    r[7] = b0 - b7;
}

// Transposed coefficients of source - prediction, [x][y].
RF_INLINE void forward4(const uint8_t* source, ptrdiff_t source_stride, const uint8_t* prediction,
                        ptrdiff_t stride, int32_t* out) {
    Row4 r[4];
    for (int y = 0; y < 4; ++y) {
        r[y] = load_row4(source + y * source_stride) - load_row4(prediction + y * stride);
    }
    forward_columns4(r);
    transpose4(r);
    forward_columns4(r);
    __builtin_memcpy(out, r, sizeof r);
}

RF_INLINE void forward8(const uint8_t* source, ptrdiff_t source_stride, const uint8_t* prediction,
                        ptrdiff_t stride, int32_t* out) {
    Row8 r[8];
    for (int y = 0; y < 8; ++y) {
        r[y] = load_row8(source + y * source_stride) - load_row8(prediction + y * stride);
    }
    forward_columns8(r);
    transpose8(r);
    forward_columns8(r);
    __builtin_memcpy(out, r, sizeof r);
}

// out = clip(prediction + inverse transform of the transposed `coefficients`): the rows first, as
// the roundings of 8x8 do not commute.
RF_INLINE void inverse4(const int32_t* coefficients, const uint8_t* prediction, ptrdiff_t stride,
                        uint8_t* out, ptrdiff_t out_stride) {
    Row4 r[4];
    __builtin_memcpy(r, coefficients, sizeof r);
    inverse_columns4(r);
    transpose4(r);
    inverse_columns4(r);
    for (int y = 0; y < 4; ++y) {
        store_clipped(load_row4(prediction + y * stride) + ((r[y] + 32) >> 6),
                      out + y * out_stride);
    }
}

RF_INLINE void inverse8(const int32_t* coefficients, const uint8_t* prediction, ptrdiff_t stride,
                        uint8_t* out, ptrdiff_t out_stride) {
    Row8 r[8];
    __builtin_memcpy(r, coefficients, sizeof r);
    inverse_columns8(r);
    transpose8(r);
    inverse_columns8(r);
    for (int y = 0; y < 8; ++y) {
        store_clipped(load_row8(prediction + y * stride) + ((r[y] + 32) >> 6),
                      out + y * out_stride);
    }
}

}  // namespace

// A prediction and what is coded beside it: transform, quantise, reconstruct, one macroblock.
#pragma once

#include "h264/inter.h"
#include "h264/quantise.h"

namespace {

// A candidate is given up when it falls behind another by one part in this many.
constexpr Cost kPatience = 32;

struct Candidate {
    Coded mb;
    uint8_t luma[256];
    uint8_t chroma[2][64];
    uint32_t luma_bits, chroma_bits;  // of levels, in 1/256
    uint32_t luma_error, chroma_error;  // squared
    Cost cost;
};

// What quantisation of the present macroblock depends on.
struct Quality {
    Rates* rates;
    const Around* around;
    int qp;
    uint32_t lambda_q8;

    // D + lambda R in 2^-16.
    Cost cost(uint32_t error, uint32_t bits) const {
        return (static_cast<Cost>(error) << 16) + static_cast<Cost>(lambda_q8) * bits;
    }
};

// Cost of the luma of a macroblock after each of its 8x8 blocks.
struct LumaCosts {
    Cost after[4];
};

// Dequantises coded positions (8.5.12.1, 8.5.13.1), but not a DC that was transformed twice.
template <Category category>
void dequantise4(const int16_t* levels, uint64_t coded, int qp, int32_t* out) {
    const Quantiser<4>& q = kQuantiser4[qp % 6];
    __builtin_memset(out, 0, 16 * sizeof(int32_t));
    for (; coded != 0; coded &= coded - 1) {
        const int position = __builtin_ctzll(coded), place = kScan[category].place[position];
        out[place] = (levels[position] * q.norm[place]) * (1 << (qp / 6));
    }
}

inline void dequantise8(const int16_t* levels, uint64_t coded, int qp, int32_t* out) {
    const Quantiser<8>& q = kQuantiser8[qp % 6];
    const int shift = qp / 6;
    __builtin_memset(out, 0, 64 * sizeof(int32_t));
    for (; coded != 0; coded &= coded - 1) {
        const int position = __builtin_ctzll(coded), place = kScan[kLuma8].place[position];
        const int32_t scaled = levels[position] * 16 * q.norm[place];
        out[place] = shift >= 6 ? scaled * (1 << (shift - 6))
                                : (scaled + (1 << (5 - shift))) >> (6 - shift);
    }
}

template <Category category>
RF_INLINE RateQuantiser<category> rate_quantiser(const Quality& quality, int flag_context, int qp) {
    const int shift = qp / 6 + (category == kLuma8 ? 16 : 15) - 8;
    const int more = category == kChromaDc ? 1 : category == kLumaDc ? 2 : 0;
    return {*quality.rates, flag_context, quality.lambda_q8, shift + more, 2 * (qp / 6)};
}

template <int width>
RF_INLINE void copy_block(const uint8_t* from, ptrdiff_t from_stride, uint8_t* to,
                          ptrdiff_t to_stride, int height) {
    for (int y = 0; y < height; ++y) {
        __builtin_memcpy(to + y * to_stride, from + y * from_stride, width);
    }
}

// Codes one 8x8 block of luma; returns the bits of its levels in 1/256, 0 where none is coded.
inline uint32_t code_block8(const Quality& quality, const uint8_t* source, ptrdiff_t source_stride,
                            const uint8_t* prediction, ptrdiff_t stride, int16_t* levels,
                            uint8_t* out, ptrdiff_t out_stride) {
    const Quantiser<8>& q = kQuantiser8[quality.qp % 6];
    alignas(32) int32_t coefficients[64];
    forward8(source, source_stride, prediction, stride, coefficients);
    const auto rate = rate_quantiser<kLuma8>(quality, -1, quality.qp);
    const Quantised block = quantise(rate, coefficients, q.multiplier, q.energy, levels);
    if (!block) {
        copy_block<8>(prediction, stride, out, out_stride, 8);
        return 0;
    }
    dequantise8(levels, block.coded, quality.qp, coefficients);
    inverse8(coefficients, prediction, stride, out, out_stride);
    return block.bits;
}

inline uint32_t code_block4(const Quality& quality, int flag_context, const uint8_t* source,
                            ptrdiff_t source_stride, const uint8_t* prediction, ptrdiff_t stride,
                            int16_t* levels, uint8_t* out, ptrdiff_t out_stride) {
    const Quantiser<4>& q = kQuantiser4[quality.qp % 6];
    alignas(16) int32_t coefficients[16];
    forward4(source, source_stride, prediction, stride, coefficients);
    const auto rate = rate_quantiser<kLuma4>(quality, flag_context, quality.qp);
    const Quantised block = quantise(rate, coefficients, q.multiplier, q.energy, levels);
    if (!block) {
        copy_block<4>(prediction, stride, out, out_stride, 4);
        return 0;
    }
    dequantise4<kLuma4>(levels, block.coded, quality.qp, coefficients);
    inverse4(coefficients, prediction, stride, out, out_stride);
    return block.bits;
}

// Inter luma with 8x8 transforms; gives up and returns false where it costs more than `most`.
// `prediction` and the candidate's luma have stride 16.
inline bool code_luma8(const Quality& quality, const Plane& source, const uint8_t* prediction,
                       Cost most, Candidate& c, LumaCosts& costs) {
    for (Cost& cost : costs.after) cost = kWorst;
    c.mb.transform8 = true;
    c.mb.cbp_luma = 0;
    c.mb.coded &= ~0xFFFFu;
    c.luma_bits = c.luma_error = 0;
    for (int b = 0; b < 4; ++b) {
        const int x = 8 * (b & 1), y = 8 * (b >> 1), at = 16 * y + x;
        const uint8_t* from = source.at + y * source.stride + x;
        const uint32_t bits = code_block8(quality, from, source.stride, prediction + at, 16,
                                          c.mb.luma + 64 * b, c.luma + at, 16);
        c.luma_bits += bits;
        c.luma_error += squared_error<8>(from, source.stride, c.luma + at, 16);
        costs.after[b] = quality.cost(c.luma_error, c.luma_bits);
        if (bits) {
            c.mb.cbp_luma |= static_cast<uint8_t>(1 << b);
            c.mb.coded |= 0x33u << (2 * (b & 1) + 8 * (b >> 1));
        }
        if (costs.after[b] > most) return false;
    }
    if (c.mb.cbp_luma == 0) c.mb.transform8 = false;
    return true;
}

// The same with 4x4 transforms; gives up, too, where it falls behind the `rival`.
inline bool code_luma4(const Quality& quality, const Plane& source, const uint8_t* prediction,
                       const LumaCosts& rival, Cost most, Candidate& c) {
    c.mb.transform8 = false;
    c.mb.cbp_luma = 0;
    c.mb.coded &= ~0xFFFFu;
    c.luma_bits = c.luma_error = 0;
    for (int blk = 0; blk < 16; ++blk) {
        const int raster = kRasterOfBlk[blk];
        const int x = 4 * (raster & 3), y = 4 * (raster >> 2), at = 16 * y + x;
        const int context =
            kFlagContext[kLuma4] + luma_flag_context(c.mb, *quality.around, raster, c.mb.coded);
        const uint8_t* from = source.at + y * source.stride + x;
        const uint32_t bits = code_block4(quality, context, from, source.stride, prediction + at,
                                          16, c.mb.luma + 16 * blk, c.luma + at, 16);
        c.luma_bits += bits;
        c.luma_error += squared_error<4>(from, source.stride, c.luma + at, 16);
        if (bits) {
            c.mb.cbp_luma |= static_cast<uint8_t>(1 << (blk >> 2));
            c.mb.coded |= 1u << raster;
        }
        if (blk % 4 == 3) {
            const Cost behind = rival.after[blk / 4] + rival.after[blk / 4] / kPatience;
            const Cost least = quality.cost(c.luma_error, c.luma_bits);
            if (least > behind || least > most) return false;
        }
    }
    return true;
}

inline void hadamard4(const int32_t* in, int32_t* out) {
    Row4 r[4];
    __builtin_memcpy(r, in, sizeof r);
    for (int pass = 0; pass < 2; ++pass) {
        const Row4 s0 = r[0] + r[1], s1 = r[0] - r[1], s2 = r[2] + r[3], s3 = r[2] - r[3];
        r[0] = s0 + s2;
        r[1] = s0 - s2;
        r[2] = s1 - s3;
        r[3] = s1 + s3;
        transpose4(r);
    }
    __builtin_memcpy(out, r, sizeof r);
}

// Intra16x16: the DC of the sixteen blocks is transformed once more (8.5.2, 8.5.10).
inline void code_luma16(const Quality& quality, const Plane& source, const uint8_t* prediction,
                        Candidate& c) {
    const int qp = quality.qp;
    const Quantiser<4>& q = kQuantiser4[qp % 6];
    alignas(16) int32_t coefficients[16][16], dc[16], transformed[16];
    uint64_t coded[16];
    bool any_ac = false;
    c.mb.transform8 = false;
    c.mb.coded &= ~0x1FFFFu;
    c.luma_bits = 0;
    for (int blk = 0; blk < 16; ++blk) {
        const int raster = kRasterOfBlk[blk];
        const int x = 4 * (raster & 3), y = 4 * (raster >> 2);
        forward4(source.at + y * source.stride + x, source.stride, prediction + 16 * y + x, 16,
                 coefficients[blk]);
        dc[raster] = coefficients[blk][0];
        const int context =
            kFlagContext[kLumaAc] + luma_flag_context(c.mb, *quality.around, raster, c.mb.coded);
        const Quantised block = quantise(rate_quantiser<kLumaAc>(quality, context, qp),
                                         coefficients[blk], q.multiplier, q.energy,
                                         c.mb.luma + 16 * blk + 1);
        coded[blk] = block.coded;
        c.luma_bits += block.bits;
        if (block) {
            any_ac = true;
            c.mb.coded |= 1u << raster;
        }
    }
    c.mb.cbp_luma = any_ac ? 15 : 0;
    hadamard4(dc, transformed);
    const Quantiser<4>& q_dc = kQuantiserDc[qp % 6];
    const int context = kFlagContext[kLumaDc] + flag_of(quality.around->left, 16, true) +
                        2 * flag_of(quality.around->above, 16, true);
    const Quantised levels_dc = quantise(rate_quantiser<kLumaDc>(quality, context, qp), transformed,
                                         q_dc.multiplier, q_dc.energy, c.mb.luma_dc);
    c.luma_bits += levels_dc.bits;
    if (levels_dc) c.mb.coded |= 1u << 16;
    for (int i = 0; i < 16; ++i) dc[kZigzag4[i]] = levels_dc ? c.mb.luma_dc[i] : 0;
    hadamard4(dc, transformed);
    const int scale = 16 * q.norm[0], shift = qp / 6;
    for (int blk = 0; blk < 16; ++blk) {
        const int raster = kRasterOfBlk[blk];
        const int at = 64 * (raster >> 2) + 4 * (raster & 3);
        dequantise4<kLumaAc>(c.mb.luma + 16 * blk + 1, coded[blk], qp, coefficients[blk]);
        const int32_t value = transformed[raster] * scale;
        coefficients[blk][0] =
            shift >= 6 ? value * (1 << (shift - 6)) : (value + (1 << (5 - shift))) >> (6 - shift);
        inverse4(coefficients[blk], prediction + at, 16, c.luma + at, 16);
    }
    c.luma_error = squared_error<16>(source.at, source.stride, c.luma, 16);
}

// Both chroma planes (8.5.4, 8.5.11); `prediction` and the candidate's chroma have stride 8.
inline void code_chroma(const Quality& quality, const Plane* source,
                        const uint8_t (*prediction)[64], Candidate& c) {
    const int qp = kChromaQp[quality.qp];
    const Quantiser<4>& q = kQuantiser4[qp % 6];
    const bool intra = c.mb.kind >= Kind::kIntra16;
    alignas(16) int32_t coefficients[2][4][16];
    int32_t dc[2][4];
    uint64_t coded_dc[2], coded[2][4];
    c.chroma_bits = 0;
    c.mb.coded &= 0x1FFFFu;
    for (int p = 0; p < 2; ++p) {
        for (int b = 0; b < 4; ++b) {
            const int x = 4 * (b & 1), y = 4 * (b >> 1);
            forward4(source[p].at + y * source[p].stride + x, source[p].stride,
                     prediction[p] + 8 * y + x, 8, coefficients[p][b]);
            dc[p][b] = coefficients[p][b][0];
        }
        const int32_t s0 = dc[p][0] + dc[p][1], s1 = dc[p][0] - dc[p][1];
        const int32_t s2 = dc[p][2] + dc[p][3], s3 = dc[p][2] - dc[p][3];
        const int32_t transformed[4] = {s0 + s2, s1 + s3, s0 - s2, s1 - s3};
        const Quantiser<4>& q_dc = kQuantiserDc[qp % 6];
        const int context = kFlagContext[kChromaDc] + flag_of(quality.around->left, 17 + p, intra) +
                            2 * flag_of(quality.around->above, 17 + p, intra);
        const Quantised levels_dc =
            quantise(rate_quantiser<kChromaDc>(quality, context, qp), transformed, q_dc.multiplier,
                     q_dc.energy, c.mb.chroma_dc[p]);
        coded_dc[p] = levels_dc.coded;
        c.chroma_bits += levels_dc.bits;
        if (levels_dc) c.mb.coded |= 1u << (17 + p);
        for (int b = 0; b < 4; ++b) {
            const int first = 19 + 4 * p;
            const int left = b & 1 ? (c.mb.coded >> (first + b - 1)) & 1
                                   : flag_of(quality.around->left, first + b + 1, intra);
            const int above = b & 2 ? (c.mb.coded >> (first + b - 2)) & 1
                                    : flag_of(quality.around->above, first + b + 2, intra);
            const int flag_context = kFlagContext[kChromaAc] + left + 2 * above;
            const auto rate = rate_quantiser<kChromaAc>(quality, flag_context, qp);
            const Quantised block = quantise(rate, coefficients[p][b], q.multiplier, q.energy,
                                             c.mb.chroma_ac[p][b] + 1);
            coded[p][b] = block.coded;
            c.chroma_bits += block.bits;
            if (block) c.mb.coded |= 1u << (first + b);
        }
    }
    c.mb.cbp_chroma = c.mb.coded >> 19 ? 2 : c.mb.coded >> 17 ? 1 : 0;
    for (int p = 0; p < 2; ++p) {
        if (c.mb.cbp_chroma == 0) {
            __builtin_memcpy(c.chroma[p], prediction[p], 64);
            continue;
        }
        const int16_t none[4] = {};
        const int16_t* l = coded_dc[p] ? c.mb.chroma_dc[p] : none;
        const int32_t s0 = l[0] + l[1], s1 = l[0] - l[1], s2 = l[2] + l[3], s3 = l[2] - l[3];
        const int32_t f[4] = {s0 + s2, s1 + s3, s0 - s2, s1 - s3};
        for (int b = 0; b < 4; ++b) {
            const int at = 32 * (b >> 1) + 4 * (b & 1);
            dequantise4<kChromaAc>(c.mb.chroma_ac[p][b] + 1, coded[p][b], qp, coefficients[p][b]);
            coefficients[p][b][0] = ((f[b] * 16 * q.norm[0]) * (1 << (qp / 6))) >> 5;
            inverse4(coefficients[p][b], prediction[p] + at, 8, c.chroma[p] + at, 8);
        }
    }
    c.chroma_error = squared_error<8>(source[0].at, source[0].stride, c.chroma[0], 8) +
                     squared_error<8>(source[1].at, source[1].stride, c.chroma[1], 8);
}

}  // namespace

// The syntax of a macroblock in slice_data (7.3.4, 7.3.5) with the contexts of 9.3.3.1.
#pragma once

#include "h264/cabac.h"
#include "h264/types.h"
#include "simd/inline.h"

namespace {

using namespace rfcore::h264;

inline bool operator==(Mv a, Mv b) { return a.x == b.x && a.y == b.y; }

// 8.5.6: scan position -> raster position in a block.
constexpr uint8_t kZigzag4[16] = {0, 1, 4, 8, 5, 2, 3, 6, 9, 12, 13, 10, 7, 11, 14, 15};
constexpr uint8_t kZigzag8[64] = {
    0,  1,  8,  16, 9,  2,  3,  10, 17, 24, 32, 25, 18, 11, 4,  5,  12, 19, 26, 33, 40, 48,
    41, 34, 27, 20, 13, 6,  7,  14, 21, 28, 35, 42, 49, 56, 57, 50, 43, 36, 29, 22, 15, 23,
    30, 37, 44, 51, 58, 59, 52, 45, 38, 31, 39, 46, 53, 60, 61, 54, 47, 55, 62, 63};
// 6.4.3: luma4x4BlkIdx -> raster index.
constexpr uint8_t kRasterOfBlk[16] = {0, 1, 4, 5, 2, 3, 6, 7, 8, 9, 12, 13, 10, 11, 14, 15};

// Table 9-43 for frame macroblocks.
constexpr uint8_t kSignificant8[63] = {
    0,  1, 2,  3,  4,  5,  5, 4, 4, 3, 3, 4, 4, 4, 5, 5, 4,  4,  4,  4,  3,
    3,  6, 7,  7,  7,  8,  9, 10, 9, 8, 7, 7, 6, 11, 12, 13, 11, 6, 7, 8,  9,
    14, 10, 9, 8,  6,  11, 12, 13, 11, 6, 9, 14, 10, 9, 11, 12, 13, 11, 14, 10, 12};
constexpr uint8_t kLast8[63] = {0, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 2, 2, 2, 2, 2,
                                2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 3, 3, 3, 3, 3, 3, 3, 3, 4, 4,
                                4, 4, 4, 4, 4, 4, 5, 5, 5, 5, 6, 6, 6, 6, 7, 7, 7, 7, 8, 8, 8};

// ctxBlockCat (Table 9-42).
enum Category { kLumaDc, kLumaAc, kLuma4, kChromaDc, kChromaAc, kLuma8 };
constexpr int kFlagContext[5] = {85, 89, 93, 97, 101};
constexpr int kSignificantContext[6] = {105, 120, 134, 149, 152, 402};
constexpr int kLastContext[6] = {166, 181, 195, 210, 213, 417};
constexpr int kLevelContext[6] = {227, 237, 247, 257, 266, 426};
constexpr int kCoefficients[6] = {16, 15, 16, 4, 15, 64};

inline int significant_context(Category category, int position) {
    const int increment = category == kLuma8 ? kSignificant8[position]
                          : category == kChromaDc && position > 2 ? 2 : position;
    return kSignificantContext[category] + increment;
}

inline int last_context(Category category, int position) {
    const int increment = category == kLuma8 ? kLast8[position]
                          : category == kChromaDc && position > 2 ? 2 : position;
    return kLastContext[category] + increment;
}

// A macroblock as it will be written.
struct Coded {
    Kind kind;
    bool transform8;
    uint8_t shape;  // inter: 0 16x16, 1 16x8, 2 8x16, 3 8x8
    uint8_t cbp_luma, cbp_chroma;
    uint8_t intra16_mode, chroma_mode;
    int8_t qp;
    int8_t reference[4];
    Mv mv[4];   // of 8x8 blocks
    Mv mvd[4];  // of partitions, at the place of their first 8x8 block
    int8_t intra_mode[16];       // by raster index
    int8_t predicted_mode[16];   // what 8.3.1.1 predicts for it
    uint32_t coded;              // as in Neighbour
    int16_t luma[256];           // by blk, each in scan order: 16 x 16, or 4 x 64
    int16_t luma_dc[16];
    int16_t chroma_dc[2][4];
    int16_t chroma_ac[2][4][16];  // positions 1..15
};

// The macroblocks around the one being coded; null for those outside.
struct Around {
    const Neighbour* left;
    const Neighbour* above;
    const Neighbour* above_right;
    const Neighbour* above_left;
    bool previous_delta_qp;  // of the macroblock before in decoding order
    int previous_qp;
};

// residual_block_cabac (7.3.5.3.3) without coded_block_flag; `levels` in scan order from the first
// coefficient of the category, at least one of them not 0.
template <class Sink>
void write_levels(Sink& sink, Category category, const int16_t* levels) {
    const int count = kCoefficients[category];
    int last = count - 1;
    while (levels[last] == 0) --last;
    for (int i = 0; i < count - 1; ++i) {
        const bool significant = levels[i] != 0;
        sink.bin(significant_context(category, i), significant);
        if (significant) {
            sink.bin(last_context(category, i), i == last);
            if (i == last) break;
        }
    }
    int ones = 0, more = 0;
    for (int i = last; i >= 0; --i) {
        if (levels[i] == 0) continue;
        const uint32_t magnitude = static_cast<uint32_t>(levels[i] < 0 ? -levels[i] : levels[i]);
        const int base = kLevelContext[category];
        const int first = base + (more ? 0 : ones < 3 ? 1 + ones : 4);
        sink.bin(first, magnitude > 1);
        if (magnitude > 1) {
            const int most = 4 - (category == kChromaDc);
            const int rest = base + 5 + (more < most ? more : most);
            for (uint32_t k = 2; k < magnitude && k < 15; ++k) sink.bin(rest, 1);
            if (magnitude < 15) {
                sink.bin(rest, 0);
            } else {  // UEG0 suffix (9.3.2.3)
                uint32_t value = magnitude - 15;
                int k = 0;
                while (value >= (1u << k)) {
                    sink.bypass(1);
                    value -= 1u << k++;
                }
                sink.bypass(0);
                sink.bypass_bits(value, k);
            }
            ++more;
        } else {
            ++ones;
        }
        sink.bypass(levels[i] < 0);
    }
}

inline void write_levels(CabacCounter&, Category, const int16_t*) {}

inline bool coded_bit(const Neighbour* mb, int bit) { return (mb->coded >> bit) & 1; }

// coded_block_flag of a neighbouring block: of this macroblock, or of `other` (9.3.3.1.1.9).
inline int flag_of(const Neighbour* other, int bit, bool intra) {
    return other == nullptr ? intra : coded_bit(other, bit);
}

inline int luma_flag_context(const Coded& mb, const Around& around, int raster, uint32_t coded) {
    const bool intra = mb.kind >= Kind::kIntra16;
    const int x = raster & 3, y = raster >> 2;
    const int a = x ? (coded >> (raster - 1)) & 1 : flag_of(around.left, raster + 3, intra);
    const int b = y ? (coded >> (raster - 4)) & 1 : flag_of(around.above, raster + 12, intra);
    return a + 2 * b;
}

template <class Sink>
void write_luma(Sink& sink, const Coded& mb, const Around& around) {
    const bool intra16 = mb.kind == Kind::kIntra16;
    if (intra16) {
        const int a = flag_of(around.left, 16, true), b = flag_of(around.above, 16, true);
        const bool coded = (mb.coded >> 16) & 1;
        sink.bin(kFlagContext[kLumaDc] + a + 2 * b, coded);
        if (coded) write_levels(sink, kLumaDc, mb.luma_dc);
    }
    if (mb.transform8) {
        for (int block = 0; block < 4; ++block) {
            if ((mb.cbp_luma >> block) & 1) write_levels(sink, kLuma8, mb.luma + 64 * block);
        }
        return;
    }
    const Category category = intra16 ? kLumaAc : kLuma4;
    for (int blk = 0; blk < 16; ++blk) {
        if (!((mb.cbp_luma >> (blk >> 2)) & 1)) continue;
        const int raster = kRasterOfBlk[blk];
        const bool coded = (mb.coded >> raster) & 1;
        sink.bin(kFlagContext[category] + luma_flag_context(mb, around, raster, mb.coded), coded);
        if (coded) write_levels(sink, category, mb.luma + 16 * blk + intra16);
    }
}

template <class Sink>
void write_chroma(Sink& sink, const Coded& mb, const Around& around) {
    const bool intra = mb.kind >= Kind::kIntra16;
    if (mb.cbp_chroma == 0) return;
    for (int c = 0; c < 2; ++c) {
        const int a = flag_of(around.left, 17 + c, intra);
        const int b = flag_of(around.above, 17 + c, intra);
        const bool coded = (mb.coded >> (17 + c)) & 1;
        sink.bin(kFlagContext[kChromaDc] + a + 2 * b, coded);
        if (coded) write_levels(sink, kChromaDc, mb.chroma_dc[c]);
    }
    if (mb.cbp_chroma == 1) return;
    for (int c = 0; c < 2; ++c) {
        for (int block = 0; block < 4; ++block) {
            const int first = 19 + 4 * c;
            const int a = block & 1 ? (mb.coded >> (first + block - 1)) & 1
                                    : flag_of(around.left, first + block + 1, intra);
            const int b = block & 2 ? (mb.coded >> (first + block - 2)) & 1
                                    : flag_of(around.above, first + block + 2, intra);
            const bool coded = (mb.coded >> (first + block)) & 1;
            sink.bin(kFlagContext[kChromaAc] + a + 2 * b, coded);
            if (coded) write_levels(sink, kChromaAc, mb.chroma_ac[c][block] + 1);
        }
    }
}

template <class Sink>
void write_coded_block_pattern(Sink& sink, const Coded& mb, const Around& around) {
    for (int block = 0; block < 4; ++block) {
        const int x = block & 1, y = block >> 1;
        const int a = x ? !((mb.cbp_luma >> (block - 1)) & 1)
                        : around.left && !((around.left->cbp_luma >> (block + 1)) & 1);
        const int b = y ? !((mb.cbp_luma >> (block - 2)) & 1)
                        : around.above && !((around.above->cbp_luma >> (block + 2)) & 1);
        sink.bin(73 + a + 2 * b, (mb.cbp_luma >> block) & 1);
    }
    const int left = around.left ? around.left->cbp_chroma : 0;
    const int above = around.above ? around.above->cbp_chroma : 0;
    sink.bin(77 + (left != 0) + 2 * (above != 0), mb.cbp_chroma != 0);
    if (mb.cbp_chroma) sink.bin(81 + (left == 2) + 2 * (above == 2), mb.cbp_chroma == 2);
}

// 9.3.2.7: the mapped value 2|d| - (d > 0), unary.
template <class Sink>
void write_qp_delta(Sink& sink, const Coded& mb, const Around& around) {
    int delta = mb.qp - around.previous_qp;
    if (delta > 25) delta -= 52;
    if (delta < -26) delta += 52;
    int value = delta > 0 ? 2 * delta - 1 : -2 * delta;
    int context = 60 + around.previous_delta_qp;
    while (value-- > 0) {
        sink.bin(context, 1);
        context = context < 62 ? 62 : 63;
    }
    sink.bin(context, 0);
}

// UEG3 with signedValFlag 1 and uCoff 9 (9.3.2.3). `around_sum`: |mvd| of A plus that of B.
template <class Sink>
void write_mvd(Sink& sink, int base, int around_sum, int value) {
    const uint32_t magnitude = static_cast<uint32_t>(value < 0 ? -value : value);
    sink.bin(base + (around_sum < 3 ? 0 : around_sum > 32 ? 2 : 1), magnitude != 0);
    if (magnitude == 0) return;
    int increment = 3;
    for (uint32_t k = 1; k < magnitude && k < 9; ++k) {
        sink.bin(base + increment, 1);
        if (increment < 6) ++increment;
    }
    if (magnitude < 9) {
        sink.bin(base + increment, 0);
    } else {
        uint32_t rest = magnitude - 9;
        int k = 3;
        while (rest >= (1u << k)) {
            sink.bypass(1);
            rest -= 1u << k++;
        }
        sink.bypass(0);
        sink.bypass_bits(rest, k);
    }
    sink.bypass(value < 0);
}

struct Partition {
    uint8_t block;          // first 8x8 block
    uint8_t width, height;  // in 4x4 blocks
    uint8_t blocks;         // a bit for each 8x8 block it covers
    bool covers(int b) const { return (blocks >> b) & 1; }
};

constexpr int kPartitionCount[4] = {1, 2, 2, 4};
constexpr Partition kPartitions[4][4] = {
    {{0, 4, 4, 15}, {}, {}, {}},
    {{0, 4, 2, 3}, {2, 4, 2, 12}, {}, {}},
    {{0, 2, 4, 5}, {1, 2, 4, 10}, {}, {}},
    {{0, 2, 2, 1}, {1, 2, 2, 2}, {2, 2, 2, 4}, {3, 2, 2, 8}},
};

template <class Sink>
void write_references(Sink& sink, const Coded& mb, const Around& around, int reference_count) {
    int8_t known[4] = {};
    for (int p = 0; p < kPartitionCount[mb.shape]; ++p) {
        const Partition& part = kPartitions[mb.shape][p];
        const int block = part.block;
        const int left = block & 1 ? known[block - 1]
                                   : around.left ? around.left->reference[block + 1] : 0;
        const int above = block & 2 ? known[block - 2]
                                    : around.above ? around.above->reference[block + 2] : 0;
        int value = mb.reference[block];
        for (int b = block; b < 4; ++b) known[b] = mb.reference[b];
        if (reference_count < 2) continue;
        int context = 54 + (left > 0) + 2 * (above > 0);
        while (value-- > 0) {
            sink.bin(context, 1);
            context = context < 58 ? 58 : 59;
        }
        sink.bin(context, 0);
    }
}

template <class Sink>
void write_motion(Sink& sink, const Coded& mb, const Around& around) {
    uint8_t own[16][2] = {};
    for (int p = 0; p < kPartitionCount[mb.shape]; ++p) {
        const Partition& part = kPartitions[mb.shape][p];
        const int x = 2 * (part.block & 1), y = 2 * (part.block >> 1), at = 4 * y + x;
        const int value[2] = {mb.mvd[part.block].x, mb.mvd[part.block].y};
        uint8_t magnitude[2];
        for (int c = 0; c < 2; ++c) {
            const int left = x ? own[at - 1][c] : around.left ? around.left->mvd[at + 3][c] : 0;
            const int above = y ? own[at - 4][c] : around.above ? around.above->mvd[at + 12][c] : 0;
            write_mvd(sink, c ? 47 : 40, left + above, value[c]);
            const int size = value[c] < 0 ? -value[c] : value[c];
            magnitude[c] = static_cast<uint8_t>(size > 255 ? 255 : size);
        }
        for (int i = 0; i < 16; ++i) {
            if (!part.covers(2 * (i >> 3) + ((i >> 1) & 1))) continue;
            own[i][0] = magnitude[0];
            own[i][1] = magnitude[1];
        }
    }
}

template <class Sink>
void write_intra_modes(Sink& sink, const Coded& mb, const Around& around) {
    if (mb.kind != Kind::kIntra16) {
        const int step = mb.kind == Kind::kIntra8 ? 4 : 1;
        for (int blk = 0; blk < 16; blk += step) {
            const int raster = kRasterOfBlk[blk];
            const int mode = mb.intra_mode[raster], predicted = mb.predicted_mode[raster];
            sink.bin(68, mode == predicted);
            if (mode == predicted) continue;
            const int rest = mode - (mode > predicted);
            for (int bit = 0; bit < 3; ++bit) sink.bin(69, (rest >> bit) & 1);
        }
    }
    const int a = around.left && around.left->chroma_mode != 0;
    const int b = around.above && around.above->chroma_mode != 0;
    sink.bin(64 + a + b, mb.chroma_mode != 0);
    if (mb.chroma_mode == 0) return;
    sink.bin(67, mb.chroma_mode > 1);
    if (mb.chroma_mode > 1) sink.bin(67, mb.chroma_mode > 2);
}

inline bool not_nxn(const Neighbour* mb) {
    return mb != nullptr && mb->kind != Kind::kIntra4 && mb->kind != Kind::kIntra8;
}

// mb_type of an intra macroblock (Table 9-36); in P slices after the prefix.
template <class Sink>
void write_intra_type(Sink& sink, const Coded& mb, const Around& around, bool p_slice) {
    const int base = p_slice ? 17 : 3;
    const int first = p_slice ? 0 : not_nxn(around.left) + not_nxn(around.above);
    const bool intra16 = mb.kind == Kind::kIntra16;
    sink.bin(base + first, intra16);
    if (!intra16) return;
    sink.terminate(0);
    const int luma = p_slice ? 1 : 3, chroma = p_slice ? 2 : 4, more = p_slice ? 2 : 5;
    const int mode_high = p_slice ? 3 : 6, mode_low = p_slice ? 3 : 7;
    sink.bin(base + luma, mb.cbp_luma != 0);
    sink.bin(base + chroma, mb.cbp_chroma != 0);
    if (mb.cbp_chroma) sink.bin(base + more, mb.cbp_chroma == 2);
    sink.bin(base + mode_high, mb.intra16_mode >> 1);
    sink.bin(base + mode_low, mb.intra16_mode & 1);
}

template <class Sink>
void write_skip_flag(Sink& sink, const Around& around, bool skipped) {
    const int a = around.left && around.left->kind != Kind::kSkip;
    const int b = around.above && around.above->kind != Kind::kSkip;
    sink.bin(11 + a + b, skipped);
}

// mb_type I_PCM, whose samples follow, with the skip flag before it.
template <class Sink>
void write_pcm_type(Sink& sink, const Around& around, bool p_slice) {
    if (p_slice) {
        write_skip_flag(sink, around, false);
        sink.bin(14, 1);
    }
    sink.bin(p_slice ? 17 : 3 + not_nxn(around.left) + not_nxn(around.above), 1);
    sink.terminate(1);
}

template <class Sink>
void write_type(Sink& sink, const Coded& mb, const Around& around, bool p_slice) {
    const bool intra = mb.kind >= Kind::kIntra16;
    if (p_slice) sink.bin(14, intra);
    if (intra) return write_intra_type(sink, mb, around, p_slice);
    const bool halves = mb.shape == 1 || mb.shape == 2;
    sink.bin(15, halves);
    if (halves) {
        sink.bin(17, mb.shape == 1);
    } else {
        sink.bin(16, mb.shape == 3);
    }
}

inline int transform8_context(const Around& around) {
    return 399 + (around.left && around.left->transform8) +
           (around.above && around.above->transform8);
}

// macroblock_layer (7.3.5), in P slices with the skip flag before it; not end_of_slice_flag.
template <class Sink>
void write_macroblock(Sink& sink, const Coded& mb, const Around& around, int reference_count) {
    const bool p_slice = reference_count > 0;
    if (p_slice) write_skip_flag(sink, around, mb.kind == Kind::kSkip);
    if (mb.kind == Kind::kSkip) return;
    write_type(sink, mb, around, p_slice);
    const bool nxn = mb.kind == Kind::kIntra4 || mb.kind == Kind::kIntra8;
    if (mb.kind == Kind::kInter) {
        for (int b = 0; mb.shape == 3 && b < 4; ++b) sink.bin(21, 1);  // sub_mb_type P_L0_8x8
        write_references(sink, mb, around, reference_count);
        write_motion(sink, mb, around);
    } else {
        if (nxn) sink.bin(transform8_context(around), mb.transform8);
        write_intra_modes(sink, mb, around);
    }
    if (mb.kind != Kind::kIntra16) write_coded_block_pattern(sink, mb, around);
    if (mb.kind == Kind::kInter && mb.cbp_luma) {
        sink.bin(transform8_context(around), mb.transform8);
    }
    if (mb.cbp_luma || mb.cbp_chroma || mb.kind == Kind::kIntra16) {
        write_qp_delta(sink, mb, around);
        write_luma(sink, mb, around);
        write_chroma(sink, mb, around);
    }
}

}  // namespace

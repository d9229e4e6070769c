// What a slice is made from, and what is kept of every macroblock while it is coded.
//
// Clause numbers are those of ITU-T H.264 (08/2021). Positions inside a macroblock: 4x4 blocks by
// raster index 4 * y + x unless a name says `blk` (the order of 6.4.3); 8x8 blocks 0..3 row by row.
#pragma once

#include <cstddef>
#include <cstdint>

namespace rfcore::h264 {

constexpr int kMaxReferences = 4;
constexpr int kBorder = 32;  // samples around a reference's luma plane; half of it for chroma
constexpr int kMaxSide = 8192;  // of a picture (rfcore/codec/h264/config.py checks it)

struct Plane {
    const uint8_t* at;  // sample (0, 0)
    ptrdiff_t stride;
};

struct Reference {
    // 8.4.2.2.1: integer samples G, half samples b (right of G), h (below G) and j (both).
    Plane luma[4];
    Plane chroma[2];
};

struct Mv {
    int16_t x, y;  // quarters of a luma sample
};

enum class Kind : uint8_t { kSkip, kInter, kIntra16, kIntra8, kIntra4, kPcm };

// What a macroblock is coded as: kinds, and the partitions of kInter.
enum Mode : int8_t {
    kModeSkip, kMode16x16, kMode16x8, kMode8x16, kMode8x8, kModeIntra16, kModeIntra8, kModeIntra4,
    kModePcm, kModes
};
constexpr int8_t kAnyMode = -1;
constexpr Mode kModeOfKind[6] = {kModeSkip,   kMode16x16,  kModeIntra16,
                                 kModeIntra8, kModeIntra4, kModePcm};

constexpr int8_t kNoReference = -1;  // an intra macroblock
constexpr int8_t kUnavailable = -2;

// Of a coded macroblock, what its neighbours' predictions and contexts depend on.
struct Neighbour {
    Kind kind;
    Mode mode;
    bool transform8;
    uint8_t cbp_luma;    // a bit for each 8x8 block
    uint8_t cbp_chroma;  // 0, 1 DC, 2 DC and AC
    uint8_t chroma_mode;
    bool delta_qp;  // mb_qp_delta was coded and not 0
    int8_t qp;
    // coded_block_flag: bits 0..15 luma, 16 luma DC, 17 + c chroma DC, 19 + 4 c + b chroma AC
    uint32_t coded;
    int8_t reference[4];
    Mv mv[16];
    uint8_t mvd[16][2];  // |mvd_l0|, at most 255
    int8_t intra_mode[16];
};

// How much is tried; more costs time and saves bits.
struct Effort {
    int search_steps;      // of the integer motion search
    int subsample_steps;   // of the half- and quarter-sample search
    int references_reach;  // partitions' vectors are refined in the references where they cost at
                           // most this many percent of the best before; 0: in all; 100: in the
                           // best alone (of 16x16: the best two), and those of halves not at all
    int intra_reach;       // intra modes are tried where the transformed difference of 16x16
                           // ones is at most this many quarters of inter prediction's; 0: always
    int halves_reach;      // halves are tried where 8x8 blocks cost at most this many percent of
                           // the whole; 0: always
    int shapes_reach;      // partitions are coded, too, that cost at most this many percent of the
                           // cheapest; at least 100
    int whole_trials;      // 16x16 is coded with the predicted vector, too (1), and with the
                           // second best reference (2)
    int cost_rounds;       // in which vectors are moved by a quarter sample, each time coding the
                           // macroblock
};

struct SliceJob {
    int width_mb, height_mb;
    int reference_count;  // 0: an I slice
    Reference references[kMaxReferences];
    Plane frame[3];  // whole macroblocks
    uint8_t* reconstruction[3];
    ptrdiff_t reconstruction_stride[3];
    int slice_qp;
    const int8_t* qp;            // QP_Y wanted for each macroblock
    int8_t* forced;              // Mode of each macroblock, kAnyMode where the coder decides
    int vertical_reach;          // of vectors, in quarter samples (A.3.1, MaxVmvR)
    const uint32_t* lambda_q8;   // [52] squared error a bit is worth, in 1/256
    const uint32_t* motion_q8;   // [52] absolute transformed difference a bit is worth, in 1/256
    Effort effort;
    Neighbour* macroblocks;  // width_mb * height_mb
    void* coded;             // as many of Kernels::coded_bytes: macroblocks as they are written
    void* contexts;          // height_mb of Kernels::contexts_bytes: states that a row hands on
    void* progress;          // for the two calls below (threads/wavefront.h)
    void (*reached)(void* progress, int row, int columns);
    void (*await)(void* progress, int row, int columns);
    uint8_t* out;
    size_t capacity;
};

// Most bits of macroblock_layer (A.3.1): 128 more than the samples of an I_PCM macroblock.
constexpr size_t kMaxMacroblockBits = 3200;
// Room that is kept for one: 384 levels of at most 47 bits, before it is found to be too large.
constexpr size_t kMaxMacroblockBytes = 3072;

}  // namespace rfcore::h264

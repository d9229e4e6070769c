// What the kernels of every instruction set and the code around them share: plain data only.
//
// Gaussians are held in blocks of 16: every quantity is a plane of 16 floats, the planes of one
// block follow each other (array of structures of arrays), so one vector load reads one quantity
// of 16 Gaussians. Lane i of block b is Gaussian 16 b + i.
#pragma once

#include <cstddef>
#include <cstdint>

namespace rfcore::raster {

constexpr int kLanes = 16;
constexpr int kTileSide = 16;
constexpr int kBlockSide = 4;
constexpr int kBlocksPerTile = 16;
constexpr int kTilesPerGroupSide = 4;
constexpr int kTilesPerGroup = 16;
constexpr int kGroupSide = kTilesPerGroupSide * kTileSide;
constexpr int kMaxDegree = 3;
constexpr float kSkyM = 1e4f;  // centres beyond this depth are sky

constexpr int coefficients_of(int degree) { return (degree + 1) * (degree + 1); }

// Planes of a block of parameters; the 3 K planes of spherical harmonics follow, k-th coefficient,
// channel c at kShPlane + 3 k + c.
enum ParameterPlane { kMeanPlane = 0, kScalePlane = 3, kQuaternionPlane = 6, kLogitPlane = 10 };
constexpr int kShPlane = 11;
constexpr int parameter_planes(int degree) { return kShPlane + 3 * coefficients_of(degree); }

// Planes of a block of geometry, what rendering needs instead of scales, quaternion and logit:
// mean, the root R S of the covariance (row-major), log2 of the opacity.
enum GeometryPlane { kRootPlane = 3, kLog2OpacityPlane = 12 };
constexpr int kGeometryPlanes = 13;

struct Camera {
    float rotation[9];        // cam_from_world, row-major
    float position[3];        // of the camera in the world, m
    float position_rest[3];   // what rounding took off it, m
    float fx, fy, cx, cy;     // px
    int width, height;        // px

    int groups_x() const { return (width + kGroupSide - 1) / kGroupSide; }
    int groups_y() const { return (height + kGroupSide - 1) / kGroupSide; }
    int groups() const { return groups_x() * groups_y(); }
};

// One projected Gaussian. With d = pixel - centre, u = a dx + b dy and v = c dy, its alpha is
// 2^(power - 8 - u^2 - v^2): the Cholesky factor of the conic, scaled by sqrt(log2(e) / 2).
struct alignas(64) Splat {
    float a, b, c;
    float power;  // log2(256 opacity)
    float red, green, blue;
    float depth;               // z in the camera, m; 0 of the sky
    float centre_x, centre_y;  // px
    float half_x, half_y;      // half sides of the box outside which alpha < 1/255, px
    float cutoff;              // u^2 + v^2 above this means alpha < 1/255, with a margin
    float y_per_x;             // where alpha is largest on a vertical line: dy = y_per_x dx
    float x_per_y;             // and on a horizontal one: dx = x_per_y dy
    float surface;             // 1, or 0 of the sky
};
static_assert(sizeof(Splat) == 64, "one cache line");

// A visible splat on its way through the depth sort.
struct SortItem {
    uint32_t depth_bits;
    uint32_t splat;
};

// Tiles are binned in groups of 4x4. A set of tiles of a group is 4 bytes, one per row of tiles,
// whose low 4 bits are the columns.
constexpr uint32_t kLeftTiles = 0x0f0f0f0fu;
constexpr uint32_t tile_bit(int column, int row) { return 1u << (8 * row + column); }

// The tiles of a splat that fits in 2x2 groups of tiles: a byte per row, a bit per column.
struct alignas(16) Footprint {
    uint16_t column, row;  // of the upper left group; column kLargeFootprint where it does not fit
    uint32_t upper, lower;  // rows of tiles 0..3 and 4..7
};
constexpr uint16_t kLargeFootprint = 0xffff;

// A splat in one group of tiles.
struct GroupEntry {
    uint32_t group, splat, tiles;
};

// Visible splats of one block: neighbours in the order of their lanes.
struct BlockSplats {
    uint32_t first;
    uint32_t lanes;  // as a bit set
};

struct Projected {
    int count;
    float nearest, farthest;  // of the visible splats, m; anything when there are none
};

struct ProjectJob {
    const Camera* camera;
    const float* geometry;    // rendering: [blocks][kGeometryPlanes][16]
    const float* harmonics;   // rendering: [blocks][3 K][16]
    const float* parameters;  // training: [blocks][11 + 3 K][16]; the two above are unused then
    int stored_degree;        // K = coefficients_of(stored_degree)
    int degree;               // of the bands to use, at most stored_degree
    bool antialiased;         // opacities make up for the dilation
    // Results: the visible of blocks begin..end lie one after the other from 16 begin on.
    Splat* splats;              // [16 blocks]
    Footprint* footprints;      // [16 blocks]
    SortItem* items;            // [16 blocks]
    BlockSplats* block_splats;  // [blocks], null when not wanted
};

// The depth-ordered splats of every group of tiles.
struct GroupLists {
    const uint32_t* splats;
    const uint32_t* tiles;    // which tiles of the group each of them touches; readable 16 behind
    const uint32_t* offsets;  // [groups + 1]
};

struct BlendCounts {
    uint64_t useful;      // (pixel, splat) pairs that changed the picture
    uint64_t evaluated;   // lanes evaluated for them
    uint64_t tile_entries;  // (tile, splat) pairs looked at
};

struct BlendJob {
    const Camera* camera;
    const Splat* splats;
    GroupLists lists;
    float* colour;        // [H, W, 3]
    float* depth;         // [H, W], null when not wanted
    float* opacity;       // [H, W], null when not wanted
    BlendCounts* counts;  // null when not wanted
};

// Gradients of one (group, splat) entry, or their sum over the entries of a splat. s is dL/d(ln
// alpha) of a pixel, (u, v) its place in the splat as in Splat: never beyond 4 where it counts,
// while pixels along a needle are hundreds from its centre and their squares would cancel.
struct alignas(64) EntryGradient {
    float s, su, sv, suu, suv, svv;  // sums of s, s u, s v, s u^2, s u v, s v^2
    float red, green, blue;          // sums of dL/dcolour times the weight of the splat
    float unused[7];
};
static_assert(sizeof(EntryGradient) == 64, "one cache line");

struct BlendBackwardJob {
    const Camera* camera;
    const Splat* splats;
    GroupLists lists;
    const float* colour;             // [H, W, 3], as blended
    const float* d_colour;           // [3, H, W]
    EntryGradient* entry_gradients;  // [entries], all of them written
};

// Where the entries of one splat are in the list of positions.
struct EntryRange {
    uint32_t begin, end;
};

// Adam (Kingma and Ba 2015): one rate per plane, bias corrections 1 / (1 - beta^t) included.
struct AdamStep {
    float rate[parameter_planes(kMaxDegree)];  // times the correction of the first moment
    float beta1, beta2, epsilon;
    float second_correction;
    float* first_moments;   // as the parameters
    float* second_moments;
    // Regularisation: added to the loss, opacity_pull times the opacity and scale_pull times each
    // scale of every visible Gaussian.
    float opacity_pull, scale_pull;
};

// What density control knows about a Gaussian, summed over the views since the last time.
enum ScorePlane { kGradientPlane = 0, kVisitsPlane = 1 };  // |dL/dcentre|, 1/px; views
constexpr int kScorePlanes = 2;

struct ProjectBackwardJob {
    const Camera* camera;
    float* parameters;  // [blocks][planes][16]
    int stored_degree;
    const BlockSplats* block_splats;  // [blocks]
    const EntryRange* ranges;         // of the splats
    const uint32_t* positions;        // into entry_gradients
    const EntryGradient* entry_gradients;
    float* gradients;      // as the parameters, or null
    const AdamStep* adam;  // or null
    float* scores;         // [blocks][kScorePlanes][16], or null
};

// One strip of rows of one channel of the training loss.
struct LossJob {
    int width, height;
    const float* colour;  // [H, W, 3]
    const float* target;  // [H, W, 3]
    float dssim_weight;
    float* d_colour;      // [3, H, W]
    double* l1_of_row;    // [3, H] sums of |colour - target|
    double* dssim_of_row;  // [3, H] sums of 1 - SSIM
};
constexpr int kLossPad = 16;    // floats on either side of a row
constexpr int kLossRadius = 5;  // of the window
constexpr int kLossRing = 2 * kLossRadius + 1;
constexpr int kLossPlanes = 8;  // 5 blurred moments, 3 blurred derivatives
constexpr int kLossRows = kLossPlanes * kLossRing + 5;  // rows of scratch per strip
constexpr int loss_stride(int width) {
    return (width + kLanes - 1) / kLanes * kLanes + 2 * kLossPad;
}

}  // namespace rfcore::raster

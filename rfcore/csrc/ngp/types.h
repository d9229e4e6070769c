// What the kernels of every instruction set and the code around them share: plain data only.
//
// A field is a multiresolution hash grid (Mueller et al. 2022) with F = 2 features a level, a
// density network and a colour network. Samples are evaluated in chunks of 64, every quantity a
// row of 64 floats. Nothing depends on which samples share a chunk.
#pragma once

#include <cstddef>
#include <cstdint>

namespace rfcore::ngp {

constexpr int kLanes = 16;
constexpr int kChunk = 64;
constexpr int kFeatures = 2;    // F
constexpr int kMaxLevels = 16;  // L
constexpr int kMaxEncoded = kFeatures * kMaxLevels;
constexpr int kMaxHidden = 64;
constexpr int kGeometry = 16;   // outputs of the density network, the first is the log density
constexpr int kHarmonics = 16;  // of the direction, degree 3
constexpr int kColourInputs = kHarmonics + kGeometry;
constexpr int kMatrices = 5;  // two of the density network, three of the colour network
constexpr int kBlockRays = 256;
constexpr int kRoundSamples = 8;  // of a ray, before it is looked at again
constexpr int kMaxWindows = 512;  // of 16 steps: rfcore/ngp/shape.py takes 8192 steps at most
constexpr int kEdgePad = 32;      // readable floats behind the last edge
constexpr float kMinTransmittance = 1e-4f;
constexpr float kMaxLogDensity = 15.0f;
constexpr uint32_t kNoCell = 0xffffffffu;

struct Level {
    float cells[3];        // along x, y, z
    uint32_t factor[3];    // of the vertex numbers in the index
    uint32_t mask;         // T - 1 of a hashed level
    uint32_t entries;
    size_t first;          // entry of the table
    bool dense;
};

// Where the field is: u = 1/2 + x / 2 with x = (p - centre) / half, of a bounded field; of an
// unbounded one everything beyond |x| = 1 is contracted into 1..2 and u = 1/2 + x / 4.
struct Space {
    float centre[3], inverse_half[3];
    bool unbounded;
};

struct Occupancy {
    float cells[3];  // along x, y, z
    uint32_t factor[3];
    const uint32_t* bits;  // x fastest
};

struct Network {
    int levels, hidden;
    int encoded;            // inputs of the first matrix, a multiple of 16, >= F L
    const float* matrices[kMatrices];  // [outputs, inputs], row-major
};
constexpr int outputs_of(int matrix, int hidden) {
    return matrix == 1 ? kGeometry : matrix == 4 ? 3 : hidden;
}
constexpr int inputs_of(int matrix, int hidden, int encoded) {
    return matrix == 0 ? encoded : matrix == 2 ? kColourInputs : hidden;
}

struct Field {
    Level level[kMaxLevels];
    Space space;
    Occupancy occupancy;
    Network network;
    const float* table;  // [entries, 2]
    const float* edges;  // [steps + 1] metres along a ray, then padding
    int steps;
};

// Samples on their way through the field. Rows of 64; unused ones have ray -1.
struct alignas(64) Chunk {
    float position[3][kChunk];   // u, 0..1
    float direction[3][kChunk];  // of the ray, unit
    float distance[kChunk];      // along the ray, m
    float step[kChunk];          // what the sample stands for, m
    float density[kChunk];       // 1/m
    float alpha[kChunk];         // 1 - exp(-density step)
    float colour[3][kChunk];
    float raw_density[kChunk];   // before the exponential; in training its gradient
    float encoded[kMaxEncoded][kChunk];  // in training their gradient
    int32_t ray[kChunk];
    uint32_t cell[kChunk];       // of the occupancy grid; kNoCell for the sample at infinity
    int count;
};

// A block of rays and how far each has got.
struct alignas(64) Rays {
    float origin[3][kBlockRays];
    float direction[3][kBlockRays];  // unit
    float jitter[kBlockRays];        // where in its step a sample lies, 0..1
    float transmittance[kBlockRays];
    float colour[3][kBlockRays];
    float depth[kBlockRays];   // sum of weight times distance
    float weight[kBlockRays];  // sum of weights before infinity
    int32_t cursor[kBlockRays];  // the next step to look at
    int32_t left[kBlockRays];    // samples it may still take
    int32_t skip[kBlockRays];    // rendering at a budget: occupied steps merged into one sample
    bool done[kBlockRays];
    uint16_t* windows;  // [kBlockRays][kMaxWindows] occupied steps, 16 a word; null: not known yet
    int count;
};

struct Camera {
    float rotation[9];  // world_from_cam, row-major
    float position[3];  // in the world, m
    float fx, fy, cx, cy;
    int width, height;
};
constexpr int kTileSide = 16;

struct RenderJob {
    const Field* field;
    const Camera* camera;
    int samples_per_ray;  // 0: every occupied step
    float* colour;        // [H, W, 3]
    float* depth;         // [H, W], or null
    float* opacity;       // [H, W], or null
    uint64_t* samples;    // of every tile, or null
};
constexpr size_t kRenderChunks = kBlockRays * (kRoundSamples + 1) / kChunk + 1;

// One block of the rays of a training step.
struct TrainJob {
    const Field* field;
    const float* origins;     // [rays, 3]
    const float* directions;  // [rays, 3]
    const float* jitter;      // [rays]
    const float* targets;     // [rays, 3]
    int rays, rays_per_block;
    int samples_per_ray;      // at most
    Chunk* chunks;            // [blocks][chunks_per_block]
    int chunks_per_block;
    int* chunk_counts;        // [blocks]
    float* gradients;         // [blocks][weights] of the matrices
    size_t weights;
    double* losses;           // [blocks] sums of squared errors
};

// Adam (Kingma and Ba 2015); a parameter whose gradient is exactly 0 stays, with its moments.
struct AdamStep {
    float rate;  // times the correction of the first moment
    float beta1, beta2, epsilon;
    float second_correction;
    float decay;  // of the parameter, added to its gradient
};

struct TableJob {
    const Field* field;
    const Chunk* chunks;
    const int* chunk_counts;
    int chunks_per_block, blocks;
    float* gradients;  // as the table, zero before and after
    float* table;
    float* first_moments;
    float* second_moments;
    const AdamStep* adam;  // null: leave the gradients
};

}  // namespace rfcore::ngp

// The previous picture, or its error, carried to another pose by depth; and what predicting a block would cost.
//
// The definition (geometry, filters, rounding, siting) is in rfcore/native/warp.py.
#pragma once

#include <cstdint>

#include "picture/yuv.h"

namespace rfcore {

// Both poses belong to one pinhole camera. `rotation` (row-major) and `translation` map points of
// the present camera into the previous one's axes.
struct WarpGeometry {
    float rotation[9];
    float translation[3];
    float fx, fy, cx, cy;
};

struct WarpInputs {
    ConstI420Planes previous;
    const float* previous_depth;
    const float* depth;
    ConstI420Planes render;
    // What the previous picture was predicted to be, or null. With it, not the picture is carried
    // but what it differs by, less a quarter of that and at most `doubt` levels, and added to the
    // render.
    ConstI420Planes previous_render;
    std::int32_t doubt;
};

// Returns how many luma samples came from the previous picture; the others are the render's. The
// number of threads (1 or more) changes nothing else.
std::int64_t warp_i420(const WarpInputs& in, const WarpGeometry& geometry, PictureSize size,
                       I420Planes out, int threads = 1);

// The interpolation filter, [64][8]: Lanczos-3 at n / 64, six taps in 1/64 and two zeros. OpenCL
// devices take this very table.
constexpr int kWarpSteps = 64, kWarpLanes = 8;
const std::int16_t* warp_filter();

// For every whole 8x8 block: the sums of absolute Hadamard coefficients (DC included, divided by
// 8) and of squared differences between frame and reference.
void block_costs(const std::uint8_t* frame, const std::uint8_t* reference, PictureSize size,
                 std::int32_t* satd, std::int32_t* ssd);

}  // namespace rfcore

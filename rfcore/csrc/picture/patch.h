// A cut-out of one picture, upright at its own depth, drawn into another view.
//
// The definition (rays, sampling, rounding) is in rfcore/native/live_view.py.
#pragma once

#include <cstdint>

#include "picture/live_view.h"

namespace rfcore {

// `samples` [height, width, 4]: red, green, blue times the mask, and the mask. `left`, `top`: its
// first pixel in the picture of `camera`; `z_m`: its depth there.
struct Patch {
    const float* samples;
    PictureSize size;
    PinholeCamera camera;
    // Map points from the view's axes into the patch camera's; the rotation is row-major.
    float rotation[9], translation[3];
    float left, top, z_m, fade;
};

// What is drawn on. `nearest` is the depth up to which a thing is in front; it is moved there.
struct Canvas {
    std::uint8_t* rgb;
    float* depth;
    std::uint8_t* chosen;
    float* nearest;
    PictureSize size;
    PinholeCamera camera;
};

struct Box {
    int top, bottom, left, right;
};

// Draws the part of `patch` that is seen in `box`, which lies within the canvas.
void draw_patch(const Patch& patch, std::uint8_t source, float nearest_m, float least_mask, Box box,
                const Canvas& canvas);

}  // namespace rfcore

// What a live picture changes in a field, and several of those carried to another view of it.
//
// The definition (what is a change, who vouches for a pixel, rounding) is in rfcore/native/live_view.py.
#pragma once

#include <cstdint>

#include "picture/yuv.h"

namespace rfcore {

struct PinholeCamera {
    float fx, fy, cx, cy;
};

// A picture is `gain` times the field's colour plus `offset`, for red, green and blue.
struct Light {
    float gain[3], offset[3];
};

struct NoiseLimits {
    float noise_levels, change_levels, least_opacity;
};

// Writes the difference of `picture` [H, W, 3] from the field's `colour` (0..1), as far as it is more
// than noise, and what share of it that is.
void live_difference(const std::uint8_t* picture, const float* colour, const float* opacity,
                     PictureSize size, const Light& light, const NoiseLimits& limits,
                     float* difference, float* share);

struct LiveSource {
    const float* difference;
    const float* depth;
    PictureSize size;
    PinholeCamera camera;
    // Map points from the view's axes into the live camera's; the rotation is row-major.
    float rotation[9], translation[3];
    float weight, fade;
    // Sources of one owner share one weight at each pixel.
    int owner;
};

struct FieldPicture {
    const float* colour;
    const float* opacity;
    const float* depth;
    PictureSize size;
    PinholeCamera camera;
};

struct VouchLimits {
    float nearest_m, furthest_m, relative_depth, absolute_depth_m;
    float least_squared_cosine, least_resolution, least_opacity;
};

constexpr int kMostSources = 16;
constexpr std::uint8_t kNobody = 255;

// Writes the view with what the sources change, and which source vouches for a pixel (or kNobody).
void carry_to_view(const FieldPicture& view, const LiveSource* sources, int count,
                   const VouchLimits& limits, std::uint8_t* rgb, std::uint8_t* chosen);

}  // namespace rfcore

// RGB <-> I420 (8-bit YUV 4:2:0), BT.709, limited range, integers only: the same bytes everywhere.
//
// Pictures are dense and row-major: RGB is [H, W, 3], luma [H, W], chroma [(H+1)/2, (W+1)/2].
// The definition (constants, siting, rounding) is in rfcore/native/yuv.py.
#pragma once

#include <cstddef>
#include <cstdint>

namespace rfcore {

struct PictureSize {
    int width_px;
    int height_px;
};

struct I420Planes {
    std::uint8_t* y;
    std::uint8_t* u;
    std::uint8_t* v;
};

struct ConstI420Planes {
    const std::uint8_t* y;
    const std::uint8_t* u;
    const std::uint8_t* v;
};

void i420_from_rgb(const std::uint8_t* rgb, PictureSize size, I420Planes out);

// Clamps to [0, 1] and rounds half up to 8 bits first. Returns how many values were not finite;
// unless that is zero, the planes hold nothing of use.
std::size_t i420_from_colour(const float* colour, PictureSize size, I420Planes out);

void rgb_from_i420(ConstI420Planes in, PictureSize size, std::uint8_t* rgb);

}  // namespace rfcore

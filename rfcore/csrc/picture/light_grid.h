// A render under another light, by a bilateral grid in integers: learnt from an earlier frame, or
// sent.
//
// The definition (cells, bins, weights, rounding) is in rfcore/native/warp.py.
#pragma once

#include <cstdint>

#include "picture/yuv.h"

namespace rfcore {

// A light that is sent: by how much samples of each plane change at the middle of a bin, in levels /
// 2^8, [rows][columns][kLightBins][kLightPlanes], a row and a column for every 64 luma px begun.
constexpr int kLightBins = 8, kLightPlanes = 3, kLightCellPx = 64;

// Solves the light that maps `render` to `frame`.
void solve_light(ConstI420Planes frame, ConstI420Planes render, PictureSize size,
                 std::int32_t* changes);
// Maps `render` by changes within +-2^16. All pictures are of `size`, at least 1x1; `out` does not
// overlap `render`.
void apply_light(const std::int32_t* changes, ConstI420Planes render, PictureSize size,
                 I420Planes out);

// Maps `render` as the grid says that maps `seen_render` to `seen`, the earlier frame at the same
// pose as `seen_render`. All pictures are of `size`, at least 1x1; `out` overlaps none of them.
void relight_i420(ConstI420Planes seen, ConstI420Planes seen_render, ConstI420Planes render,
                  PictureSize size, I420Planes out);

}  // namespace rfcore

// A render under the light of an earlier frame, learnt by a bilateral grid in integers.
//
// The definition (cells, bins, weights, rounding) is in rfcore/native/warp.py.
#pragma once

#include "picture/yuv.h"

namespace rfcore {

// Maps `render` as the grid says that maps `seen_render` to `seen`, the earlier frame at the same
// pose as `seen_render`. All pictures are of `size`, at least 1x1; `out` overlaps none of them.
void relight_i420(ConstI420Planes seen, ConstI420Planes seen_render, ConstI420Planes render,
                  PictureSize size, I420Planes out);

}  // namespace rfcore

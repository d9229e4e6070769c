// One affine map of colours per picture: what a camera's exposure and white balance did to it.
#pragma once

#include <cstddef>

namespace rfcore::raster {

constexpr int kAffine = 12;  // [3, 4] row-major: out_i = sum_j a_ij in_j + a_i3

// `colour` and `out` are [pixels, 3].
void apply_affine(const float* affine, const float* colour, size_t pixels, float* out);

// From the gradient [3, pixels] of the mapped colours to that of `colour`, in place, and of the map.
void apply_affine_backward(const float* affine, const float* colour, size_t pixels, float* gradient,
                           double* d_affine);

}  // namespace rfcore::raster

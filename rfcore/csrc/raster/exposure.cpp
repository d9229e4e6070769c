#include "raster/exposure.h"

#include <algorithm>

namespace rfcore::raster {

void apply_affine(const float* affine, const float* colour, size_t pixels, float* out) {
    for (size_t n = 0; n < pixels; ++n) {
        const float *c = colour + 3 * n, *a = affine;
        for (int i = 0; i < 3; ++i, a += 4) {
            out[3 * n + static_cast<size_t>(i)] = a[0] * c[0] + a[1] * c[1] + a[2] * c[2] + a[3];
        }
    }
}

void apply_affine_backward(const float* affine, const float* colour, size_t pixels, float* gradient,
                           double* d_affine) {
    std::fill_n(d_affine, kAffine, 0.0);
    for (size_t n = 0; n < pixels; ++n) {
        const float* c = colour + 3 * n;
        const float d[3] = {gradient[n], gradient[pixels + n], gradient[2 * pixels + n]};
        for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) {
                d_affine[4 * i + j] += static_cast<double>(d[i]) * static_cast<double>(c[j]);
            }
            d_affine[4 * i + 3] += static_cast<double>(d[i]);
        }
        for (size_t j = 0; j < 3; ++j) {
            gradient[j * pixels + n] =
                affine[j] * d[0] + affine[4 + j] * d[1] + affine[8 + j] * d[2];
        }
    }
}

}  // namespace rfcore::raster

// How a camera's float64 numbers become the float32 ones of the kernels: here, once.
#pragma once

#include "raster/types.h"

namespace rfcore::raster {

// `numbers`: cam_from_world rotation 9 (row-major), position in the world 3 (m), fx, fy, cx, cy.
constexpr int kCameraNumbers = 16;
Camera make_camera(const double* numbers, int width, int height);

}  // namespace rfcore::raster

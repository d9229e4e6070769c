#include "raster/camera.h"

namespace rfcore::raster {

Camera make_camera(const double* numbers, int width, int height) {
    Camera c{};
    for (int i = 0; i < 9; ++i) c.rotation[i] = static_cast<float>(numbers[i]);
    for (int i = 0; i < 3; ++i) {
        c.position[i] = static_cast<float>(numbers[9 + i]);
        c.position_rest[i] =
            static_cast<float>(numbers[9 + i] - static_cast<double>(c.position[i]));
    }
    c.fx = static_cast<float>(numbers[12]);
    c.fy = static_cast<float>(numbers[13]);
    c.cx = static_cast<float>(numbers[14]);
    c.cy = static_cast<float>(numbers[15]);
    c.width = width;
    c.height = height;
    return c;
}

}  // namespace rfcore::raster

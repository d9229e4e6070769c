#include "picture/patch.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

namespace rfcore {
namespace {

constexpr float kLeastAlong = 1e-6f;

// To the nearest whole number, halves to even, for values of 0 to 255.
inline float level(float value) {
    constexpr float kWhole = 8388608.0f;
    return (std::min(std::max(value, 0.0f), 255.0f) + kWhole) - kWhole;
}

// The four channels of `patch` at sample centre (u, v), bilinearly; zeros outside the patch.
bool sample(const Patch& patch, float u, float v, float* found) {
    const int width = patch.size.width_px, height = patch.size.height_px;
    if (!(u > -1.0f && u < static_cast<float>(width) && v > -1.0f && v < static_cast<float>(height))) return false;
    const float left = std::floor(u), top = std::floor(v), across = u - left, down = v - top;
    const int column = static_cast<int>(left), row = static_cast<int>(top);
    std::fill_n(found, 4, 0.0f);
    for (int below = 0; below < 2; ++below) {
        for (int right = 0; right < 2; ++right) {
            const int x = column + right, y = row + below;
            if (x < 0 || x >= width || y < 0 || y >= height) continue;
            const float weight = (below ? down : 1.0f - down) * (right ? across : 1.0f - across);
            const float* at = patch.samples + 4 * (static_cast<std::size_t>(y) * width + x);
            for (int channel = 0; channel < 4; ++channel) found[channel] += weight * at[channel];
        }
    }
    return true;
}

}  // namespace

void draw_patch(const Patch& patch, std::uint8_t source, float nearest_m, float least_mask, Box box,
                const Canvas& canvas) {
    const float *r = patch.rotation, *t = patch.translation;
    const float ahead_m = patch.z_m - t[2];
    for (int row = box.top; row < box.bottom; ++row) {
        const float ray_y = (static_cast<float>(row) + 0.5f - canvas.camera.cy) / canvas.camera.fy;
        for (int column = box.left; column < box.right; ++column) {
            const float ray_x = (static_cast<float>(column) + 0.5f - canvas.camera.cx) / canvas.camera.fx;
            const float along = r[6] * ray_x + (r[7] * ray_y + r[8]);
            const std::size_t i = static_cast<std::size_t>(row) * canvas.size.width_px + column;
            if (!(along > kLeastAlong)) continue;
            const float z = ahead_m / along;
            if (!(z > nearest_m && z < canvas.nearest[i])) continue;
            const float x_m = z * (r[0] * ray_x + (r[1] * ray_y + r[2])) + t[0];
            const float y_m = z * (r[3] * ray_x + (r[4] * ray_y + r[5])) + t[1];
            const float u = x_m / patch.z_m * patch.camera.fx + (patch.camera.cx - 0.5f) - patch.left;
            const float v = y_m / patch.z_m * patch.camera.fy + (patch.camera.cy - 0.5f) - patch.top;
            float found[4];
            if (!sample(patch, u, v, found) || !(found[3] > least_mask)) continue;
            std::uint8_t* rgb = canvas.rgb + 3 * i;
            for (int channel = 0; channel < 3; ++channel) {
                const float behind = static_cast<float>(rgb[channel]);
                const float seen = found[channel] / found[3];
                rgb[channel] = static_cast<std::uint8_t>(level(behind + patch.fade * (seen - behind)));
            }
            canvas.depth[i] = z;
            canvas.nearest[i] = z;
            canvas.chosen[i] = source;
        }
    }
}

}  // namespace rfcore

#include "picture/live_view.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

#include "picture/per_isa.h"

namespace rfcore {
namespace {

constexpr int kHalf = 3, kWindow = 2 * kHalf + 1;

// To the nearest whole number, halves to even, for values of 0 to 255: adding 2^23 leaves no fraction.
inline float rounded(float value) {
    constexpr float kWhole = 8388608.0f;
    return (value + kWhole) - kWhole;
}

inline float level(float value) { return rounded(std::min(std::max(value, 0.0f), 255.0f)); }

RFCORE_PER_ISA
void difference_row(const std::uint8_t* __restrict picture, const float* __restrict colour, int count,
                    const float* __restrict gain, const float* __restrict offset, float* __restrict out) {
    for (int i = 0; i < count; ++i) {
        out[i] = (static_cast<float>(picture[i]) - offset[i]) / gain[i] - level(colour[i] * 255.0f);
    }
}

RFCORE_PER_ISA
void add_row(const float* __restrict row, int count, float* __restrict sum) {
    for (int i = 0; i < count; ++i) sum[i] += row[i];
}

// Sums of a row's windows: `columns` has kHalf pixels of the edge repeated on both sides.
RFCORE_PER_ISA
void window_row(const float* __restrict columns, int count, float* __restrict sum) {
    for (int i = 0; i < count; ++i) {
        float total = columns[i];
        for (int j = 1; j < kWindow; ++j) total += columns[i + 3 * j];
        sum[i] = total;
    }
}

RFCORE_PER_ISA
void share_row(const float* __restrict sums, const float* __restrict opacity, int width,
               NoiseLimits limits, float* __restrict share) {
    constexpr float kPixels = kWindow * kWindow;
    const float span = limits.change_levels - limits.noise_levels;
    for (int x = 0; x < width; ++x) {
        const float red = std::abs(sums[3 * x]), green = std::abs(sums[3 * x + 1]);
        const float change = std::max(std::max(red, green), std::abs(sums[3 * x + 2])) / kPixels;
        const float part = std::min(std::max((change - limits.noise_levels) / span, 0.0f), 1.0f);
        share[x] = opacity[x] > limits.least_opacity ? part : 0.0f;
    }
}

void repeat_edge(float* columns, int width) {
    float* first = columns + 3 * kHalf;
    for (int i = 0; i < 3 * kHalf; ++i) {
        columns[i] = first[i % 3];
        first[3 * width + i] = first[3 * (width - 1) + i % 3];
    }
}

// Every value three times as often: [gain, gain, ...] for each pixel of a row.
std::vector<float> repeated(const float* rgb, int width) {
    std::vector<float> row(static_cast<std::size_t>(3) * width);
    for (std::size_t i = 0; i < row.size(); ++i) row[i] = rgb[i % 3];
    return row;
}

// Where a row of the view lies in a source, what it weighs there, and what it changes.
struct Carried {
    explicit Carried(int width)
        : u(width), v(width), z(width), weight(width), mean(width), change(3 * static_cast<std::size_t>(width)) {}
    std::vector<float> u, v, z, weight, mean, change;
};

struct RayColumns {
    RayColumns(const LiveSource& s, const FieldPicture& view) : x(view.size.width_px), y(x), z(x) {
        for (int column = 0; column < view.size.width_px; ++column) {
            const float ray_x = (static_cast<float>(column) + 0.5f - view.camera.cx) / view.camera.fx;
            x[column] = s.rotation[0] * ray_x;
            y[column] = s.rotation[3] * ray_x;
            z[column] = s.rotation[6] * ray_x;
        }
    }
    std::vector<float> x, y, z;
};

RFCORE_PER_ISA
void locate_row(const FieldPicture& view, const LiveSource& s, const RayColumns& columns,
                const VouchLimits& limits, int y, float* __restrict u, float* __restrict v,
                float* __restrict z, float* __restrict weight) {
    const std::size_t start = static_cast<std::size_t>(y) * view.size.width_px;
    const float *depth = view.depth + start, *opacity = view.opacity + start;
    const float *column_x = columns.x.data(), *column_y = columns.y.data(), *column_z = columns.z.data();
    const float ray_y = (static_cast<float>(y) + 0.5f - view.camera.cy) / view.camera.fy;
    const float row_x = s.rotation[1] * ray_y + s.rotation[2];
    const float row_y = s.rotation[4] * ray_y + s.rotation[5];
    const float row_z = s.rotation[7] * ray_y + s.rotation[8];
    const float t0 = s.translation[0], t1 = s.translation[1], t2 = s.translation[2];
    const float fx = s.camera.fx, fy = s.camera.fy, cx = s.camera.cx - 0.5f, cy = s.camera.cy - 0.5f;
    const float right = static_cast<float>(s.size.width_px - 1);
    const float bottom = static_cast<float>(s.size.height_px - 1);
    const float finer = s.camera.fx / view.camera.fx, all = s.weight;
    const VouchLimits l = limits;
    for (int x = 0; x < view.size.width_px; ++x) {
        const float far = depth[x];
        const float rx = column_x[x] + row_x, ry = column_y[x] + row_y, rz = column_z[x] + row_z;
        const float px = far * rx + t0, py = far * ry + t1, pz = far * rz + t2;
        const float at_x = px / pz * fx + cx, at_y = py / pz * fy + cy;
        const float along = px * rx + py * ry + pz * rz;
        const float squared = along * along / ((px * px + py * py + pz * pz) * (rx * rx + ry * ry + rz * rz));
        const float resolution = finer * far / pz;
        const float worth = squared * squared * std::min(resolution, 1.0f) * (1.0f - pz / l.furthest_m) * all;
        const bool vouches = (opacity[x] > l.least_opacity) & (far > 0.0f) & (pz > l.nearest_m) &
                             (pz < l.furthest_m) & (at_x >= 0.0f) & (at_x <= right) & (at_y >= 0.0f) &
                             (at_y <= bottom) & (along > 0.0f) & (squared > l.least_squared_cosine) &
                             (resolution > l.least_resolution);
        u[x] = vouches ? at_x : 0.0f;
        v[x] = vouches ? at_y : 0.0f;
        z[x] = pz;
        weight[x] = vouches ? worth : 0.0f;
    }
}

// Samples one channel of a difference bilinearly: at (left, top), (left + right, top), ...
struct Corners {
    Corners(const LiveSource& s, float u, float v) {
        const int left = std::min(static_cast<int>(u), std::max(s.size.width_px - 2, 0));
        const int top = std::min(static_cast<int>(v), std::max(s.size.height_px - 2, 0));
        across = u - static_cast<float>(left);
        down = v - static_cast<float>(top);
        first = s.difference + (static_cast<std::size_t>(top) * s.size.width_px + left) * 3;
        right = s.size.width_px > 1 ? 3 : 0;
        below = s.size.height_px > 1 ? static_cast<std::size_t>(s.size.width_px) * 3 : 0;
    }
    float sample(int channel) const {
        const float* at = first + channel;
        const float upper = at[0] * (1.0f - across) + at[right] * across;
        const float lower = at[below] * (1.0f - across) + at[below + right] * across;
        return upper * (1.0f - down) + lower * down;
    }
    const float* first;
    std::size_t right, below;
    float across, down;
};

void sample_row(const LiveSource& s, const VouchLimits& limits, int width, Carried& row) {
    for (int x = 0; x < width; ++x) {
        if (!(row.weight[x] > 0.0f)) continue;
        const int column = static_cast<int>(row.u[x] + 0.5f), line = static_cast<int>(row.v[x] + 0.5f);
        const float seen = s.depth[static_cast<std::size_t>(line) * s.size.width_px + column];
        const float tolerance = limits.relative_depth * row.z[x] + limits.absolute_depth_m;
        if (!(seen > 0.0f) || !(std::abs(seen - row.z[x]) < tolerance)) {
            row.weight[x] = 0.0f;
            continue;
        }
        const Corners corners(s, row.u[x], row.v[x]);
        float* change = row.change.data() + 3 * static_cast<std::size_t>(x);
        for (int channel = 0; channel < 3; ++channel) change[channel] = corners.sample(channel) * s.fade;
        row.mean[x] = change[0] + change[1] + change[2];
    }
}

// Divides what a source weighs at a pixel among those of its owner that weigh anything there.
void share_weights(const LiveSource* sources, std::vector<Carried>& rows, int width) {
    const int count = static_cast<int>(rows.size());
    for (int s = 0; s < count; ++s) {
        int first = 0;
        while (sources[first].owner != sources[s].owner) ++first;
        if (first < s) continue;
        for (int x = 0; x < width; ++x) {
            float vouching = 0.0f;
            for (int other = s; other < count; ++other) {
                vouching += sources[other].owner == sources[s].owner && rows[other].weight[x] > 0.0f;
            }
            if (!(vouching > 1.0f)) continue;
            for (int other = s; other < count; ++other) {
                if (sources[other].owner == sources[s].owner) rows[other].weight[x] /= vouching;
            }
        }
    }
}

bool share_owners(const LiveSource* sources, int count) {
    for (int s = 1; s < count; ++s) {
        for (int other = 0; other < s; ++other) {
            if (sources[other].owner == sources[s].owner) return true;
        }
    }
    return false;
}

// Which of the sources that weigh anything at x is the weighted median by mean change.
std::uint8_t median_at(const std::vector<Carried>& rows, int x) {
    int order[kMostSources], found = 0;
    float total = 0.0f;
    for (int s = 0; s < static_cast<int>(rows.size()); ++s) {
        if (!(rows[s].weight[x] > 0.0f)) continue;
        int at = found++;
        for (; at > 0 && rows[order[at - 1]].mean[x] > rows[s].mean[x]; --at) order[at] = order[at - 1];
        order[at] = s;
        total += rows[s].weight[x];
    }
    float reached = 0.0f;
    for (int i = 0; i < found; ++i) {
        reached += rows[order[i]].weight[x];
        if (reached >= total / 2 || i == found - 1) return static_cast<std::uint8_t>(order[i]);
    }
    return kNobody;
}

RFCORE_PER_ISA
void level_row(const float* __restrict colour, const float* __restrict change, int count,
               std::uint8_t* __restrict out) {
    for (int i = 0; i < count; ++i) {
        out[i] = static_cast<std::uint8_t>(level(level(colour[i] * 255.0f) + change[i]));
    }
}

}  // namespace

void live_difference(const std::uint8_t* picture, const float* colour, const float* opacity,
                     PictureSize size, const Light& light, const NoiseLimits& limits,
                     float* difference, float* share) {
    const int width = size.width_px, height = size.height_px, count = 3 * width;
    const std::vector<float> gain = repeated(light.gain, width), offset = repeated(light.offset, width);
    for (int y = 0; y < height; ++y) {
        const std::size_t at = static_cast<std::size_t>(y) * count;
        difference_row(picture + at, colour + at, count, gain.data(), offset.data(), difference + at);
    }
    std::vector<float> columns(static_cast<std::size_t>(count) + 6 * kHalf), sums(count);
    for (int y = 0; y < height; ++y) {
        float* middle = columns.data() + 3 * kHalf;
        std::fill_n(middle, count, 0.0f);
        for (int near = y - kHalf; near <= y + kHalf; ++near) {
            add_row(difference + static_cast<std::size_t>(std::clamp(near, 0, height - 1)) * count, count, middle);
        }
        repeat_edge(columns.data(), width);
        window_row(columns.data(), count, sums.data());
        const std::size_t start = static_cast<std::size_t>(y) * width;
        share_row(sums.data(), opacity + start, width, limits, share + start);
    }
    for (std::size_t i = 0; i < static_cast<std::size_t>(width) * height; ++i) {
        for (int channel = 0; channel < 3; ++channel) difference[3 * i + channel] *= share[i];
    }
}

void carry_to_view(const FieldPicture& view, const LiveSource* sources, int count,
                   const VouchLimits& limits, std::uint8_t* rgb, std::uint8_t* chosen) {
    const int width = view.size.width_px;
    std::vector<RayColumns> columns;
    for (int s = 0; s < count; ++s) columns.emplace_back(sources[s], view);
    std::vector<Carried> rows(count, Carried(width));
    const bool shared = share_owners(sources, count);
    std::vector<float> change(3 * static_cast<std::size_t>(width));
    for (int y = 0; y < view.size.height_px; ++y) {
        for (int s = 0; s < count; ++s) {
            Carried& row = rows[s];
            locate_row(view, sources[s], columns[s], limits, y, row.u.data(), row.v.data(), row.z.data(),
                       row.weight.data());
            sample_row(sources[s], limits, width, row);
        }
        if (shared) share_weights(sources, rows, width);
        const std::size_t start = static_cast<std::size_t>(y) * width;
        for (int x = 0; x < width; ++x) {
            const std::uint8_t source = median_at(rows, x);
            chosen[start + x] = source;
            for (int channel = 0; channel < 3; ++channel) {
                change[3 * x + channel] = source == kNobody ? 0.0f : rows[source].change[3 * x + channel];
            }
        }
        level_row(view.colour + 3 * start, change.data(), 3 * width, rgb + 3 * start);
    }
}

}  // namespace rfcore

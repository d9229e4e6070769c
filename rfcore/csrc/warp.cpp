#include "warp.h"

#include <algorithm>
#include <cstddef>
#include <cstdlib>
#include <cstring>
#include <vector>

// Separate multiplications and additions in float32 (no contraction, see CMakeLists.txt) and
// integers: every instruction set gives the same bytes, so the compiler may use AVX2.
#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__)
#define RFCORE_PER_ISA __attribute__((target_clones("avx2", "default")))
#else
#define RFCORE_PER_ISA
#endif

namespace rfcore {
namespace {

constexpr int kSteps = 64;  // positions per sample
constexpr int kTaps = 6, kLanes = 8;
constexpr std::int32_t kNowhere = INT32_MIN;
constexpr float kNearest = 0.1f;
constexpr float kRelative = 0.08f, kAbsolute = 0.1f;

// Lanczos-3 at n / 64, rounded to 1/64 so that every row sums to 64 (rfcore/native/warp.py makes
// this table again, tests/native/test_warp.py compares).
constexpr std::int16_t kFilter[kSteps][kLanes] = {
#include "warp_filter.inc"
};

struct Row {
    explicit Row(int width) : u(width), v(width), z(width) {}
    std::vector<std::int32_t> u, v;
    std::vector<float> z;
};

// Where row y of the present picture lies in the previous one, in 1/64 sample; kNowhere outside.
RFCORE_PER_ISA
void locate_row(const float* __restrict depth, const WarpGeometry& g, PictureSize size, int y,
                std::int32_t* __restrict u, std::int32_t* __restrict v, float* __restrict z) {
    const float ray_y = (static_cast<float>(y) + 0.5f - g.cy) / g.fy;
    const float row_x = g.rotation[1] * ray_y + g.rotation[2];
    const float row_y = g.rotation[4] * ray_y + g.rotation[5];
    const float row_z = g.rotation[7] * ray_y + g.rotation[8];
    const float r0 = g.rotation[0], r3 = g.rotation[3], r6 = g.rotation[6];
    const float t0 = g.translation[0], t1 = g.translation[1], t2 = g.translation[2];
    const float fx = g.fx, fy = g.fy, cx = g.cx, cy = g.cy;
    const float right = static_cast<float>(size.width_px - 1);
    const float bottom = static_cast<float>(size.height_px - 1);
    for (int x = 0; x < size.width_px; ++x) {
        const float ray_x = (static_cast<float>(x) + 0.5f - cx) / fx;
        const float far = depth[x];
        const float px = far * (r0 * ray_x + row_x) + t0;
        const float py = far * (r3 * ray_x + row_y) + t1;
        const float pz = far * (r6 * ray_x + row_z) + t2;
        const float at_x = fx * (px / pz) + cx - 0.5f;
        const float at_y = fy * (py / pz) + cy - 0.5f;
        const bool inside = (far > 0.0f) & (pz > kNearest) & (at_x >= 0.0f) & (at_x <= right) &
                            (at_y >= 0.0f) & (at_y <= bottom);
        const float safe_x = inside ? at_x : 0.0f, safe_y = inside ? at_y : 0.0f;
        u[x] = inside ? static_cast<std::int32_t>(safe_x * kSteps + 0.5f) : kNowhere;
        v[x] = static_cast<std::int32_t>(safe_y * kSteps + 0.5f);
        z[x] = pz;
    }
}

// Marks kNowhere what another surface hid in the previous picture.
void drop_hidden(const float* previous_depth, int width_px, Row& row) {
    for (int x = 0; x < width_px; ++x) {
        if (row.u[x] == kNowhere) continue;
        const int column = (row.u[x] + kSteps / 2) / kSteps;
        const int line = (row.v[x] + kSteps / 2) / kSteps;
        const float seen = previous_depth[static_cast<std::size_t>(line) * width_px + column];
        if (!(std::abs(seen - row.z[x]) < kRelative * row.z[x] + kAbsolute)) row.u[x] = kNowhere;
    }
}

// A vector in the compilers' own notation (GCC, Clang), for any instruction set. Taps are 6 bits
// so that a column's sum fits: no row of the filter has absolute values of more than 100 in all.
using Lanes = std::int16_t __attribute__((vector_size(2 * kLanes)));

// A plane, or the difference of two, with its edge repeated, as 16-bit numbers (GCC 12 widens eight
// bytes one by one).
class Plane {
public:
    Plane(const std::uint8_t* samples, const std::uint8_t* minus, int width, int height)
        : is_difference_(minus != nullptr), pitch_(width + kBefore + kAfter),
          samples_(pitch_ * (height + kBefore + kAfter)) {
        for (int y = -kBefore; y < height + kAfter; ++y) {
            const std::size_t from = static_cast<std::size_t>(std::clamp(y, 0, height - 1)) * width;
            std::int16_t* to = samples_.data() + (y + kBefore) * pitch_ + kBefore;
            std::copy_n(samples + from, width, to);
            for (int x = 0; minus != nullptr && x < width; ++x) to[x] -= minus[from + x];
            std::fill_n(to - kBefore, kBefore, to[0]);
            std::fill_n(to + width, kAfter, to[width - 1]);
        }
    }
    std::size_t pitch() const { return pitch_; }
    bool is_difference() const { return is_difference_; }
    // The first sample under the filter for positions from (x, y) to (x + 1, y + 1); x, y >= -1.
    const std::int16_t* under(int x, int y) const { return samples_.data() + (y + 1) * pitch_ + x + 1; }

private:
    static constexpr int kBefore = 3, kAfter = 6;
    bool is_difference_;
    std::size_t pitch_;
    std::vector<std::int16_t> samples_;
};

// Writes the plane's value at each known (u, v), in 1/64 sample, on top of the render if the plane is
// a difference, and the render elsewhere. Eight columns are summed although six have taps, so that a
// row of them is one vector.
RFCORE_PER_ISA
void interpolate_row(const Plane& plane, const Row& at, int count, std::int32_t doubt,
                     const std::uint8_t* render, std::uint8_t* out) {
    const std::int32_t *u = at.u.data(), *v = at.v.data();
    const std::int32_t with_render = plane.is_difference() ? 1 : 0;
    for (int n = 0; n < count; ++n) {
        if (u[n] == kNowhere) {
            out[n] = std::max<std::uint8_t>(render[n], 1);
            continue;
        }
        const std::int16_t* line = plane.under(u[n] >> 6, v[n] >> 6);
        const std::int16_t* across = kFilter[u[n] & (kSteps - 1)];
        const std::int16_t* down = kFilter[v[n] & (kSteps - 1)];
        Lanes columns{}, row;
        for (int j = 0; j < kTaps; ++j, line += plane.pitch()) {
            std::memcpy(&row, line, sizeof row);
            columns += row * down[j];
        }
        std::int32_t sum = 0;
        for (int i = 0; i < kTaps; ++i) sum += columns[i] * across[i];
        sum -= std::min(std::max(sum >> 2, -(doubt << 12)), doubt << 12);
        const std::int32_t value = ((sum + (1 << 11)) >> 12) + with_render * render[n];
        out[n] = static_cast<std::uint8_t>(std::min(std::max(value, 1), 255));
    }
}

class Warp {
public:
    Warp(const WarpInputs& in, const WarpGeometry& geometry, PictureSize size, I420Planes out)
        : in_(in), geometry_(geometry), size_(size), out_(out), half_width_((size.width_px + 1) / 2),
          y_(in.previous.y, in.previous_render.y, size.width_px, size.height_px),
          u_(in.previous.u, in.previous_render.u, half_width_, (size.height_px + 1) / 2),
          v_(in.previous.v, in.previous_render.v, half_width_, (size.height_px + 1) / 2),
          rows_{Row(size.width_px), Row(size.width_px)}, middle_(half_width_) {}

    std::int64_t run() {
        std::int64_t taken = 0;
        for (int y = 0; y < size_.height_px; y += 2) {
            const int count = std::min(2, size_.height_px - y);
            for (int r = 0; r < count; ++r) taken += luma(y + r, rows_[r]);
            chroma(y / 2, rows_[0], rows_[count - 1]);
        }
        return taken;
    }

private:
    std::int64_t luma(int y, Row& row) {
        const std::size_t start = static_cast<std::size_t>(y) * size_.width_px;
        locate_row(in_.depth + start, geometry_, size_, y, row.u.data(), row.v.data(),
                   row.z.data());
        drop_hidden(in_.previous_depth, size_.width_px, row);
        interpolate_row(y_, row, size_.width_px, in_.doubt, in_.render.y + start, out_.y + start);
        return size_.width_px - std::count(row.u.begin(), row.u.end(), kNowhere);
    }

    void chroma(int line, const Row& top, const Row& bottom) {
        const auto known = [](const Row& row, int x) { return row.u[x] != kNowhere; };
        for (int c = 0; c < half_width_; ++c) {
            const int a = 2 * c, b = std::min(2 * c + 1, size_.width_px - 1);
            const bool all = known(top, a) && known(top, b) && known(bottom, a) && known(bottom, b);
            const std::int32_t u = top.u[a] + top.u[b] + bottom.u[a] + bottom.u[b];
            const std::int32_t v = top.v[a] + top.v[b] + bottom.v[a] + bottom.v[b];
            middle_.u[c] = all ? centre(u, a != b) : kNowhere;
            middle_.v[c] = all ? centre(v, &top != &bottom) : 0;
        }
        const std::size_t start = static_cast<std::size_t>(line) * half_width_;
        interpolate_row(u_, middle_, half_width_, in_.doubt, in_.render.u + start, out_.u + start);
        interpolate_row(v_, middle_, half_width_, in_.doubt, in_.render.v + start, out_.v + start);
    }

    // Four luma positions to the chroma sample in their middle: (mean - 1/2) / 2 between a pair,
    // mean / 2 on the last of an odd number, which stands for both.
    static std::int32_t centre(std::int32_t sum, bool pair) {
        return (sum - (pair ? 2 * kSteps : 0) + 4) >> 3;
    }

    const WarpInputs& in_;
    const WarpGeometry& geometry_;
    PictureSize size_;
    I420Planes out_;
    int half_width_;
    Plane y_, u_, v_;
    Row rows_[2];
    Row middle_;
};

// One 8-point Hadamard transform over eight values `stride` apart.
inline void hadamard8(std::int32_t* d, int stride) {
    for (int half = 4; half >= 1; half /= 2) {
        for (int i = 0; i < 8; ++i) {
            if ((i & half) != 0) continue;
            const std::int32_t a = d[i * stride], b = d[(i + half) * stride];
            d[i * stride] = a + b;
            d[(i + half) * stride] = a - b;
        }
    }
}

RFCORE_PER_ISA
void costs_of_block(const std::uint8_t* frame, const std::uint8_t* reference, int stride,
                    std::int32_t* satd, std::int32_t* ssd) {
    std::int32_t d[64];
    std::int32_t squares = 0, sum = 0;
    for (int j = 0; j < 8; ++j) {
        for (int i = 0; i < 8; ++i) {
            const std::int32_t difference = frame[j * stride + i] - reference[j * stride + i];
            d[8 * j + i] = difference;
            squares += difference * difference;
        }
    }
    for (int half = 4; half >= 1; half /= 2) {  // down the columns, eight at a time
        for (int j = 0; j < 8; ++j) {
            if ((j & half) != 0) continue;
            for (int i = 0; i < 8; ++i) {
                const std::int32_t a = d[8 * j + i], b = d[8 * (j + half) + i];
                d[8 * j + i] = a + b;
                d[8 * (j + half) + i] = a - b;
            }
        }
    }
    for (int j = 0; j < 8; ++j) hadamard8(d + 8 * j, 1);
    for (int i = 0; i < 64; ++i) sum += std::abs(d[i]);
    *satd = (sum + 4) / 8;
    *ssd = squares;
}

}  // namespace

std::int64_t warp_i420(const WarpInputs& in, const WarpGeometry& geometry, PictureSize size,
                       I420Planes out) {
    return Warp(in, geometry, size, out).run();
}

void block_costs(const std::uint8_t* frame, const std::uint8_t* reference, PictureSize size,
                 std::int32_t* satd, std::int32_t* ssd) {
    const int columns = size.width_px / 8, rows = size.height_px / 8;
    for (int j = 0; j < rows; ++j) {
        for (int i = 0; i < columns; ++i) {
            const std::size_t start = static_cast<std::size_t>(8 * j) * size.width_px + 8 * i;
            const std::size_t block = static_cast<std::size_t>(j) * columns + i;
            costs_of_block(frame + start, reference + start, size.width_px, satd + block,
                           ssd + block);
        }
    }
}

}  // namespace rfcore

#include "picture/warp.h"

#include <algorithm>
#include <cstddef>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <numeric>
#include <vector>

#include "picture/per_isa.h"
#include "threads/thread_pool.h"

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

namespace rfcore {
namespace {

constexpr int kSteps = kWarpSteps;  // positions per sample
constexpr int kTaps = 6, kLanes = kWarpLanes;
constexpr std::int32_t kNowhere = INT32_MIN;
constexpr float kNearest = 0.1f;
constexpr float kRelative = 0.08f, kAbsolute = 0.1f;

// Lanczos-3 at n / 64, rounded to 1/64 so that every row sums to 64 (rfcore/native/warp.py makes
// this table again, tests/native/test_warp.py compares).
constexpr std::int16_t kFilter[kSteps][kLanes] = {
#include "picture/warp_filter.inc"
};

// A vector in the compilers' own notation (GCC, Clang), for any instruction set. Taps are 6 bits
// so that a column's sum fits: no row of the filter has absolute values of more than 100 in all.
using Lanes = std::int16_t __attribute__((vector_size(2 * kLanes)));
using TwoRows = std::int16_t __attribute__((vector_size(4 * kLanes)));
using Sums = std::int32_t __attribute__((vector_size(2 * kLanes)));

inline Lanes lanes_at(const std::int16_t* from) {
    Lanes lanes;
    std::memcpy(&lanes, from, sizeof lanes);
    return lanes;
}

// Four sums of products that add up to the product of two vectors; which four depends on the machine.
inline Sums products(Lanes a, Lanes b) {
#if defined(__SSE2__)
    return reinterpret_cast<Sums>(
        _mm_madd_epi16(reinterpret_cast<__m128i>(a), reinterpret_cast<__m128i>(b)));
#else
    Sums sums{};
    for (int i = 0; i < kLanes; ++i) sums[i / 2] += a[i] * b[i];
    return sums;
#endif
}

// Eight samples as 16-bit numbers.
inline Lanes widened(const std::uint8_t* from) {
    using Bytes = std::uint8_t __attribute__((vector_size(kLanes)));
    Bytes bytes;
    std::memcpy(&bytes, from, sizeof bytes);
    return __builtin_convertvector(bytes, Lanes);
}

inline std::int32_t total(Sums sums) {
    sums += __builtin_shufflevector(sums, sums, 2, 3, 0, 1);
    return sums[0] + sums[1];
}

// Every tap of the filter in all lanes.
struct Taps {
    Taps() {
        for (int at = 0; at < kSteps; ++at) {
            for (int j = 0; j < kTaps; ++j) each[at][j] = Lanes{} + kFilter[at][j];
        }
    }
    Lanes each[kSteps][kTaps];
};
const Taps kDown;

// Positions of a row's samples and how far they are.
struct Row {
    explicit Row(int width) : u(width), v(width), z(width) {}
    std::vector<std::int32_t> u, v;
    std::vector<float> z;
};

// What the rays of a column have in common: each entry of the rotation's first column times ray_x.
struct Columns {
    Columns(const WarpGeometry& g, int width) : x(width), y(width), z(width) {
        for (int column = 0; column < width; ++column) {
            const float ray_x = (static_cast<float>(column) + 0.5f - g.cx) / g.fx;
            x[column] = g.rotation[0] * ray_x;
            y[column] = g.rotation[3] * ray_x;
            z[column] = g.rotation[6] * ray_x;
        }
    }
    std::vector<float> x, y, z;
};

// Where row y of the present picture lies in the previous one, in 1/64 sample; kNowhere outside.
RFCORE_PER_ISA
void locate_row(const float* __restrict depth, const WarpGeometry& g, const Columns& columns,
                PictureSize size, int y, std::int32_t* __restrict u, std::int32_t* __restrict v,
                float* __restrict z) {
    const float ray_y = (static_cast<float>(y) + 0.5f - g.cy) / g.fy;
    const float row_x = g.rotation[1] * ray_y + g.rotation[2];
    const float row_y = g.rotation[4] * ray_y + g.rotation[5];
    const float row_z = g.rotation[7] * ray_y + g.rotation[8];
    const float *column_x = columns.x.data(), *column_y = columns.y.data();
    const float* column_z = columns.z.data();
    const float t0 = g.translation[0], t1 = g.translation[1], t2 = g.translation[2];
    const float fx = g.fx, fy = g.fy, cx = g.cx, cy = g.cy;
    const float right = static_cast<float>(size.width_px - 1);
    const float bottom = static_cast<float>(size.height_px - 1);
    for (int x = 0; x < size.width_px; ++x) {
        const float far = depth[x];
        const float px = far * (column_x[x] + row_x) + t0;
        const float py = far * (column_y[x] + row_y) + t1;
        const float pz = far * (column_z[x] + row_z) + t2;
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

// Marks the samples that another surface hid in the previous picture as kNowhere.
RFCORE_PER_ISA
void drop_hidden(const float* __restrict previous_depth, int width_px, std::int32_t* __restrict u,
                 const std::int32_t* __restrict v, const float* __restrict z) {
    for (int x = 0; x < width_px; ++x) {
        const std::int32_t column = (std::max(u[x], 0) + kSteps / 2) >> 6;
        const std::int32_t line = (v[x] + kSteps / 2) >> 6;
        const float seen = previous_depth[line * width_px + column];
        const bool same = std::abs(seen - z[x]) < kRelative * z[x] + kAbsolute;
        u[x] = same ? u[x] : kNowhere;
    }
}

// A plane, or the difference of two, with its edge repeated, as 16-bit numbers (GCC 12 widens eight
// bytes one by one).
class Plane {
public:
    Plane(const std::uint8_t* samples, const std::uint8_t* minus, int width, int height)
        : is_difference_(minus != nullptr), pitch_(width + kBefore + kAfter),
          samples_(new std::int16_t[pitch_ * (height + kBefore + kAfter)]) {
        for (int y = -kBefore; y < height + kAfter; ++y) {
            const std::size_t from = static_cast<std::size_t>(std::clamp(y, 0, height - 1)) * width;
            std::int16_t* to = samples_.get() + (y + kBefore) * pitch_ + kBefore;
            std::copy_n(samples + from, width, to);
            for (int x = 0; minus != nullptr && x < width; ++x) to[x] -= minus[from + x];
            std::fill_n(to - kBefore, kBefore, to[0]);
            std::fill_n(to + width, kAfter, to[width - 1]);
        }
    }
    std::size_t pitch() const { return pitch_; }
    bool is_difference() const { return is_difference_; }
    // What Reach::begin counts from. Positions from (x, y) to (x + 1, y + 1) begin at
    // (y + 1) * pitch + x + 1; x, y >= -1.
    const std::int16_t* samples() const { return samples_.get(); }

private:
    static constexpr int kBefore = 3, kAfter = 6;
    bool is_difference_;
    std::size_t pitch_;
    std::unique_ptr<std::int16_t[]> samples_;  // not filled with zeros first
};

// What a row of positions asks of planes of one pitch: where the filter begins (below 0: nowhere), and
// which rows of the filter are taken in both directions.
struct Reach {
    explicit Reach(int width) : begin(width), across(width), down(width) {}
    std::vector<std::int32_t> begin, across, down;
};

RFCORE_PER_ISA
void reach_row(const std::int32_t* __restrict u, const std::int32_t* __restrict v, int count,
               std::int32_t pitch, std::int32_t* __restrict begin, std::int32_t* __restrict across,
               std::int32_t* __restrict down) {
    for (int n = 0; n < count; ++n) {
        begin[n] = u[n] == kNowhere ? -1 : ((v[n] >> 6) + 1) * pitch + (u[n] >> 6) + 1;
        across[n] = u[n] & (kSteps - 1);
        down[n] = v[n] & (kSteps - 1);
    }
}

// Interpolates at each known position: four sums a sample, which add up to 2^12 samples. Eight columns
// are summed although six have taps, so that a row of them is one vector.
RFCORE_PER_ISA
void filter_row(const std::int16_t* samples, std::size_t pitch, const Reach& reach, int count,
                Sums* sums) {
    const std::int32_t *begin = reach.begin.data(), *across = reach.across.data();
    const std::int32_t* down = reach.down.data();
    for (int n = 0; n < count; ++n) {
        if (begin[n] < 0) continue;
        const std::int16_t* line = samples + begin[n];
        const Lanes* taps = kDown.each[down[n]];
        TwoRows rows{};
        for (int j = 0; j < kTaps; j += 2) {
            TwoRows two_taps;
            std::memcpy(&two_taps, taps + j, sizeof two_taps);
            rows += __builtin_shufflevector(lanes_at(line + j * pitch), lanes_at(line + (j + 1) * pitch),
                                            0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15) *
                    two_taps;
        }
        const Lanes columns = __builtin_shufflevector(rows, rows, 0, 1, 2, 3, 4, 5, 6, 7) +
                              __builtin_shufflevector(rows, rows, 8, 9, 10, 11, 12, 13, 14, 15);
        sums[n] = products(columns, lanes_at(kFilter[across[n]]));
    }
}

// Adds up the four sums of each sample, for four samples at a time: [count, 4] -> [count], both up to
// the next multiple of four.
RFCORE_PER_ISA
void total_row(const Sums* sums, int count, std::int32_t* totals) {
    for (int n = 0; n < count; n += 4) {
        const Sums a = sums[n], b = sums[n + 1], c = sums[n + 2], d = sums[n + 3];
        const Sums ab = __builtin_shufflevector(a, b, 0, 4, 1, 5) + __builtin_shufflevector(a, b, 2, 6, 3, 7);
        const Sums cd = __builtin_shufflevector(c, d, 0, 4, 1, 5) + __builtin_shufflevector(c, d, 2, 6, 3, 7);
        const Sums all = __builtin_shufflevector(ab, cd, 0, 1, 4, 5) + __builtin_shufflevector(ab, cd, 2, 3, 6, 7);
        std::memcpy(totals + n, &all, sizeof all);
    }
}

// Rounds sums to samples, on top of the render if they are differences; unknown ones are the render's.
RFCORE_PER_ISA
void round_row(const std::int32_t* __restrict sums, const std::int32_t* __restrict u, int count,
               bool on_top, std::int32_t doubt, const std::uint8_t* __restrict render,
               std::uint8_t* __restrict out) {
    const std::int32_t most = doubt << 12, with_render = on_top ? -1 : 0;
    for (int n = 0; n < count; ++n) {
        const std::int32_t sum = sums[n] - std::min(std::max(sums[n] >> 2, -most), most);
        const std::int32_t carried = ((sum + (1 << 11)) >> 12) + (render[n] & with_render);
        const std::int32_t value = u[n] == kNowhere ? render[n] : carried;
        out[n] = static_cast<std::uint8_t>(std::min(std::max(value, 1), 255));
    }
}

// Four luma positions to the chroma sample in their middle: (mean - 1/2) / 2 where they are two apart
// (`pair` is 2 * kSteps), mean / 2 on the last of an odd number, which stands for both (`pair` is 0).
inline std::int32_t centre(std::int32_t sum, int pair) { return (sum - pair + 4) >> 3; }

// Where the chroma samples lie between two rows of luma, those that are known in all four; the
// second row may be the first again.
RFCORE_PER_ISA
void centre_row(const std::int32_t* top_u, const std::int32_t* bottom_u, const std::int32_t* top_v,
                const std::int32_t* bottom_v, int pairs, int tall, std::int32_t* __restrict u,
                std::int32_t* __restrict v) {
    for (int c = 0; c < pairs; ++c) {
        const int a = 2 * c, b = a + 1;
        const bool known = (top_u[a] != kNowhere) & (top_u[b] != kNowhere) &
                           (bottom_u[a] != kNowhere) & (bottom_u[b] != kNowhere);
        // Unsigned, because kNowhere added to itself would overflow.
        const auto sum = static_cast<std::uint32_t>(top_u[a]) + static_cast<std::uint32_t>(top_u[b]) +
                         static_cast<std::uint32_t>(bottom_u[a]) +
                         static_cast<std::uint32_t>(bottom_u[b]);
        u[c] = known ? centre(static_cast<std::int32_t>(sum), 2 * kSteps) : kNowhere;
        v[c] = centre(top_v[a] + top_v[b] + bottom_v[a] + bottom_v[b], tall);
    }
}

// What all rows of one warp share.
struct Job {
    Job(const WarpInputs& in, const WarpGeometry& geometry, PictureSize size, I420Planes out)
        : in(in), geometry(geometry), columns(geometry, size.width_px), size(size), out(out),
          half_width((size.width_px + 1) / 2),
          y(in.previous.y, in.previous_render.y, size.width_px, size.height_px),
          u(in.previous.u, in.previous_render.u, half_width, (size.height_px + 1) / 2),
          v(in.previous.v, in.previous_render.v, half_width, (size.height_px + 1) / 2) {}

    const WarpInputs& in;
    const WarpGeometry& geometry;
    Columns columns;
    PictureSize size;
    I420Planes out;
    int half_width;
    Plane y, u, v;
};

// Carries neighbouring rows, two of luma and one of chroma at a time.
class Band {
public:
    explicit Band(const Job& job)
        : job_(job), size_(job.size), rows_{Row(size_.width_px), Row(size_.width_px)},
          middle_(job.half_width), reach_(size_.width_px), sums_(size_.width_px + 3),
          totals_(size_.width_px + 3) {}

    // Rows of chroma; those of luma are twice as many. Returns how many luma samples were known.
    std::int64_t run(int begin, int end) {
        std::int64_t taken = 0;
        for (int y = 2 * begin; y < std::min(2 * end, size_.height_px); y += 2) {
            const int count = std::min(2, size_.height_px - y);
            for (int r = 0; r < count; ++r) taken += luma(y + r, rows_[r]);
            chroma(y / 2, rows_[0], rows_[count - 1]);
        }
        return taken;
    }

private:
    std::int64_t luma(int y, Row& row) {
        const WarpInputs& in = job_.in;
        const std::size_t start = static_cast<std::size_t>(y) * size_.width_px;
        locate_row(in.depth + start, job_.geometry, job_.columns, size_, y, row.u.data(), row.v.data(), row.z.data());
        drop_hidden(in.previous_depth, size_.width_px, row.u.data(), row.v.data(), row.z.data());
        reach(job_.y, row, size_.width_px);
        interpolate(job_.y, row, size_.width_px, in.render.y + start, job_.out.y + start);
        return size_.width_px - std::count(row.u.begin(), row.u.end(), kNowhere);
    }

    void chroma(int line, const Row& top, const Row& bottom) {
        const int pairs = size_.width_px / 2, tall = &top == &bottom ? 0 : 2 * kSteps;
        centre_row(top.u.data(), bottom.u.data(), top.v.data(), bottom.v.data(), pairs, tall,
                   middle_.u.data(), middle_.v.data());
        const int count = job_.half_width;
        if (pairs < count) centre_last(top, bottom, tall);
        const std::size_t start = static_cast<std::size_t>(line) * count;
        const ConstI420Planes& render = job_.in.render;
        reach(job_.u, middle_, count);
        interpolate(job_.u, middle_, count, render.u + start, job_.out.u + start);
        interpolate(job_.v, middle_, count, render.v + start, job_.out.v + start);
    }

    // The last of an odd number of columns stands for two.
    void centre_last(const Row& top, const Row& bottom, int tall) {
        const int x = size_.width_px - 1, c = job_.half_width - 1;
        const bool known = top.u[x] != kNowhere && bottom.u[x] != kNowhere;
        middle_.u[c] = known ? centre(2 * (top.u[x] + bottom.u[x]), 0) : kNowhere;
        middle_.v[c] = centre(2 * (top.v[x] + bottom.v[x]), tall);
    }

    void reach(const Plane& plane, const Row& at, int count) {
        reach_row(at.u.data(), at.v.data(), count, static_cast<std::int32_t>(plane.pitch()),
                  reach_.begin.data(), reach_.across.data(), reach_.down.data());
    }

    void interpolate(const Plane& plane, const Row& at, int count, const std::uint8_t* render,
                     std::uint8_t* out) {
        filter_row(plane.samples(), plane.pitch(), reach_, count, sums_.data());
        total_row(sums_.data(), count, totals_.data());
        round_row(totals_.data(), at.u.data(), count, plane.is_difference(), job_.in.doubt, render, out);
    }

    const Job& job_;
    PictureSize size_;
    Row rows_[2];
    Row middle_;
    Reach reach_;
    std::vector<Sums> sums_;
    std::vector<std::int32_t> totals_;
};

// Eight rows of differences, transformed in the direction across the vectors.
inline void hadamard_down(Lanes* d) {
    for (int half = 4; half >= 1; half /= 2) {
        for (int j = 0; j < 8; ++j) {
            if ((j & half) != 0) continue;
            const Lanes a = d[j], b = d[j + half];
            d[j] = a + b;
            d[j + half] = a - b;
        }
    }
}

// Three rounds of interleaving rows that are four apart.
inline void transpose(Lanes* d) {
    for (int round = 0; round < 3; ++round) {
        Lanes mixed[8];
        for (int j = 0; j < 4; ++j) {
            const Lanes a = d[j], b = d[j + 4];
            mixed[2 * j] = __builtin_shufflevector(a, b, 0, 8, 1, 9, 2, 10, 3, 11);
            mixed[2 * j + 1] = __builtin_shufflevector(a, b, 4, 12, 5, 13, 6, 14, 7, 15);
        }
        std::copy_n(mixed, 8, d);
    }
}

// A coefficient is at most 64 * 255, so 16 bits hold it.
inline void costs_of_block(const std::uint8_t* frame, const std::uint8_t* reference,
                           std::size_t stride, std::int32_t* satd, std::int32_t* ssd) {
    constexpr Lanes one{1, 1, 1, 1, 1, 1, 1, 1};
    Lanes d[8];
    Sums squares{}, sum{};
    for (int j = 0; j < 8; ++j) {
        d[j] = widened(frame + j * stride) - widened(reference + j * stride);
        squares += products(d[j], d[j]);
    }
    hadamard_down(d);
    transpose(d);
    hadamard_down(d);
    for (int j = 0; j < 8; ++j) sum += products(d[j] < 0 ? -d[j] : d[j], one);
    *satd = (total(sum) + 4) / 8;
    *ssd = total(squares);
}

RFCORE_PER_ISA
void costs_of_row(const std::uint8_t* frame, const std::uint8_t* reference, int columns,
                  std::size_t stride, std::int32_t* satd, std::int32_t* ssd) {
    for (int i = 0; i < columns; ++i) {
        costs_of_block(frame + 8 * i, reference + 8 * i, stride, satd + i, ssd + i);
    }
}

}  // namespace

std::int64_t warp_i420(const WarpInputs& in, const WarpGeometry& geometry, PictureSize size,
                       I420Planes out, int threads) {
    const Job job(in, geometry, size, out);
    const int rows = (size.height_px + 1) / 2;
    std::vector<std::int64_t> taken(threads);
    ThreadPool(threads).run(threads, [&](int i) {
        taken[i] = Band(job).run(share_begin(rows, i, threads), share_begin(rows, i + 1, threads));
    });
    return std::accumulate(taken.begin(), taken.end(), std::int64_t{0});
}

const std::int16_t* warp_filter() { return kFilter[0]; }

void block_costs(const std::uint8_t* frame, const std::uint8_t* reference, PictureSize size,
                 std::int32_t* satd, std::int32_t* ssd) {
    const int columns = size.width_px / 8, rows = size.height_px / 8;
    const std::size_t stride = size.width_px;
    for (int j = 0; j < rows; ++j) {
        const std::size_t start = 8 * j * stride, block = static_cast<std::size_t>(j) * columns;
        costs_of_row(frame + start, reference + start, columns, stride, satd + block, ssd + block);
    }
}

}  // namespace rfcore

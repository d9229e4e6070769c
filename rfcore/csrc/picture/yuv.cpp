#include "picture/yuv.h"

#include <cstring>
#include <vector>

#include "picture/per_isa.h"

namespace rfcore {
namespace {

constexpr int kRound16 = 1 << 15;
constexpr int kRound18 = 1 << 17;

// Two rows of a picture with the channels apart and an even width (an odd one repeats its last
// column), so that all further arithmetic runs on unit strides.
struct SplitRows {
    explicit SplitRows(int width_px) : width((width_px + 1) / 2 * 2), channels(6 * width) {}
    std::int16_t* channel(int row, int c) { return channels.data() + (3 * row + c) * width; }
    std::size_t width;
    std::vector<std::int16_t> channels;
};

RFCORE_PER_ISA
void split_row(const std::uint8_t* __restrict rgb, int width_px, std::int16_t* __restrict r,
               std::int16_t* __restrict g, std::int16_t* __restrict b) {
    for (int x = 0; x < width_px; ++x) {
        r[x] = rgb[3 * x];
        g[x] = rgb[3 * x + 1];
        b[x] = rgb[3 * x + 2];
    }
    if (width_px % 2 != 0) {
        r[width_px] = r[width_px - 1];
        g[width_px] = g[width_px - 1];
        b[width_px] = b[width_px - 1];
    }
}

void split(const std::uint8_t* rgb, int width_px, int row, SplitRows& rows) {
    split_row(rgb, width_px, rows.channel(row, 0), rows.channel(row, 1), rows.channel(row, 2));
}

RFCORE_PER_ISA
void luma_row(const std::int16_t* __restrict r, const std::int16_t* __restrict g,
              const std::int16_t* __restrict b, int width_px, std::uint8_t* __restrict y) {
    for (int x = 0; x < width_px; ++x) {
        const int sum = 11966 * r[x] + 40254 * g[x] + 4064 * b[x];
        y[x] = static_cast<std::uint8_t>((sum + (16 << 16) + kRound16) >> 16);
    }
}

// Adds 2x2 blocks of one channel: [2, 2 n] -> [n].
RFCORE_PER_ISA
void block_sums(const std::int16_t* __restrict top, const std::int16_t* __restrict bottom, int n,
                std::int16_t* __restrict sums) {
    for (int x = 0; x < n; ++x) {
        sums[x] = static_cast<std::int16_t>(top[2 * x] + top[2 * x + 1] + bottom[2 * x] +
                                            bottom[2 * x + 1]);
    }
}

// Eighteen bits of fraction absorb the division of the sums by four.
RFCORE_PER_ISA
void chroma_row(const std::int16_t* __restrict r, const std::int16_t* __restrict g,
                const std::int16_t* __restrict b, int n, std::uint8_t* __restrict u,
                std::uint8_t* __restrict v) {
    constexpr int offset = (128 << 18) + kRound18;
    for (int x = 0; x < n; ++x) {
        u[x] = static_cast<std::uint8_t>(
            (-6596 * r[x] - 22188 * g[x] + 28784 * b[x] + offset) >> 18);
        v[x] = static_cast<std::uint8_t>(
            (28784 * r[x] - 26145 * g[x] - 2639 * b[x] + offset) >> 18);
    }
}

class ForwardRows {
public:
    ForwardRows(PictureSize size, I420Planes out)
        : size_(size), half_((size.width_px + 1) / 2), out_(out), rows_(size.width_px),
          sums_(3 * half_) {}

    // Writes rows 2 * pair and 2 * pair + 1; bottom == top says that the picture ends at the first.
    void convert(const std::uint8_t* top, const std::uint8_t* bottom, int pair) {
        split(top, size_.width_px, 0, rows_);
        split(bottom, size_.width_px, 1, rows_);
        luma(0, 2 * pair);
        if (bottom != top) luma(1, 2 * pair + 1);
        const int n = static_cast<int>(half_);
        for (int c = 0; c < 3; ++c) {
            block_sums(rows_.channel(0, c), rows_.channel(1, c), n, sums_.data() + c * half_);
        }
        chroma_row(sums_.data(), sums_.data() + half_, sums_.data() + 2 * half_, n,
                   out_.u + pair * half_, out_.v + pair * half_);
    }

private:
    void luma(int row, int y) {
        luma_row(rows_.channel(row, 0), rows_.channel(row, 1), rows_.channel(row, 2),
                 size_.width_px, out_.y + static_cast<std::size_t>(y) * size_.width_px);
    }

    PictureSize size_;
    std::size_t half_;
    I420Planes out_;
    SplitRows rows_;
    std::vector<std::int16_t> sums_;
};

// The bits of |value|: ordered like the values, NaN above infinity above everything finite.
inline std::int32_t magnitude_bits(float value) {
    std::int32_t bits;
    std::memcpy(&bits, &value, sizeof bits);
    return bits & 0x7fffffff;
}

constexpr std::int32_t kInfinityBits = 0x7f800000;

// Returns the largest magnitude_bits of the row.
RFCORE_PER_ISA
std::int32_t quantise_row(const float* __restrict colour, int values,
                          std::uint8_t* __restrict out) {
    std::int32_t largest = 0;
    for (int i = 0; i < values; ++i) {
        const float value = colour[i];
        const std::int32_t bits = magnitude_bits(value);
        largest = bits > largest ? bits : largest;
        const float low = value > 0.0f ? value : 0.0f;
        const float clamped = low < 1.0f ? low : 1.0f;
        out[i] = static_cast<std::uint8_t>(static_cast<std::int32_t>(clamped * 255.0f + 0.5f));
    }
    return largest;
}

std::size_t count_not_finite(const float* colour, std::size_t values) {
    std::size_t count = 0;
    for (std::size_t i = 0; i < values; ++i) count += magnitude_bits(colour[i]) >= kInfinityBits;
    return count;
}

inline std::int32_t clamp8(std::int32_t value) {
    const std::int32_t low = value < 0 ? 0 : value;
    return low > 255 ? 255 : low;
}

// What chroma adds to each channel, once per pair of columns and rows.
struct ChromaTerms {
    explicit ChromaTerms(int width_px) : r(width_px + 1), g(width_px + 1), b(width_px + 1) {}
    std::vector<std::int32_t> r, g, b;
};

RFCORE_PER_ISA
void chroma_terms(const std::uint8_t* __restrict u, const std::uint8_t* __restrict v, int n,
                  std::int32_t* __restrict r, std::int32_t* __restrict g,
                  std::int32_t* __restrict b) {
    for (int x = 0; x < n; ++x) {
        const int cb = u[x] - 128, cr = v[x] - 128;
        r[2 * x] = r[2 * x + 1] = 117489 * cr;
        g[2 * x] = g[2 * x + 1] = -13975 * cb - 34925 * cr;
        b[2 * x] = b[2 * x + 1] = 138438 * cb;
    }
}

RFCORE_PER_ISA
void rgb_row(const std::uint8_t* __restrict y, const std::int32_t* __restrict r,
             const std::int32_t* __restrict g, const std::int32_t* __restrict b, int width_px,
             std::uint8_t* __restrict rgb) {
    for (int x = 0; x < width_px; ++x) {
        const int luma = 76309 * (y[x] - 16) + kRound16;
        rgb[3 * x] = static_cast<std::uint8_t>(clamp8((luma + r[x]) >> 16));
        rgb[3 * x + 1] = static_cast<std::uint8_t>(clamp8((luma + g[x]) >> 16));
        rgb[3 * x + 2] = static_cast<std::uint8_t>(clamp8((luma + b[x]) >> 16));
    }
}

}  // namespace

void i420_from_rgb(const std::uint8_t* rgb, PictureSize size, I420Planes out) {
    const std::size_t stride = 3 * static_cast<std::size_t>(size.width_px);
    ForwardRows forward(size, out);
    for (int pair = 0; 2 * pair < size.height_px; ++pair) {
        const std::uint8_t* top = rgb + 2 * pair * stride;
        const bool last_alone = 2 * pair + 1 == size.height_px;
        forward.convert(top, last_alone ? top : top + stride, pair);
    }
}

std::size_t i420_from_colour(const float* colour, PictureSize size, I420Planes out) {
    const int values = 3 * size.width_px;
    const std::size_t stride = static_cast<std::size_t>(values);
    std::vector<std::uint8_t> rows(2 * stride);
    ForwardRows forward(size, out);
    for (int row = 0; row < size.height_px; row += 2) {
        const int count = row + 1 < size.height_px ? 2 : 1;
        const float* top = colour + row * stride;
        if (quantise_row(top, count * values, rows.data()) >= kInfinityBits) {
            return count_not_finite(colour, size.height_px * stride);
        }
        forward.convert(rows.data(), rows.data() + (count - 1) * stride, row / 2);
    }
    return 0;
}

void rgb_from_i420(ConstI420Planes in, PictureSize size, std::uint8_t* rgb) {
    const std::size_t width = size.width_px, half = (width + 1) / 2;
    ChromaTerms terms(size.width_px);
    for (int row = 0; row < size.height_px; ++row) {
        const std::size_t chroma = (row / 2) * half;
        if (row % 2 == 0) {
            chroma_terms(in.u + chroma, in.v + chroma, static_cast<int>(half), terms.r.data(),
                         terms.g.data(), terms.b.data());
        }
        rgb_row(in.y + row * width, terms.r.data(), terms.g.data(), terms.b.data(), size.width_px,
                rgb + 3 * row * width);
    }
}

}  // namespace rfcore

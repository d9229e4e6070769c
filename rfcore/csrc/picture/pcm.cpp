#include "picture/pcm.h"

#include <algorithm>
#include <cstring>

namespace rfcore {
namespace {

constexpr int kLumaSide = 16, kChromaSide = 8;
constexpr std::uint8_t kHeader[] = {0x0D, 0x00};
constexpr std::size_t kMacroblockBytes = sizeof kHeader + 256 + 64 + 64;

struct Plane {
    const std::uint8_t* samples;
    int width, height;
};

// Rows of blocks in the compilers' own notation for vectors (GCC, Clang).
using Row16 = std::uint8_t __attribute__((vector_size(16)));
using Row8 = std::uint8_t __attribute__((vector_size(8)));

template <typename Row>
void copy_row(const std::uint8_t* from, std::uint8_t* to) {
    Row row;
    std::memcpy(&row, from, sizeof row);
    row |= (row == 0) & 1;
    std::memcpy(to, &row, sizeof row);
}

// Copies row `y` of the blocks from `row` on to their places from `out` on: along the picture's rows,
// for a macroblock at a time reads from too many of them for the processor to foresee.
template <typename Row>
void copy_across(const Plane& plane, int row, int y, int columns, std::uint8_t* out) {
    constexpr int side = sizeof(Row);
    const int line = std::min(row * side + y, plane.height - 1);
    const std::uint8_t* from = plane.samples + static_cast<std::size_t>(line) * plane.width;
    const int whole = plane.width / side;
    for (int column = 0; column < whole; ++column) {
        copy_row<Row>(from + column * side, out + column * kMacroblockBytes);
    }
    for (int column = whole; column < columns; ++column) {
        std::uint8_t padded[side];
        for (int x = 0; x < side; ++x) padded[x] = from[std::min(column * side + x, plane.width - 1)];
        copy_row<Row>(padded, out + column * kMacroblockBytes);
    }
}

}  // namespace

std::size_t pcm_bytes(PictureSize size) {
    const std::size_t columns = (size.width_px + kLumaSide - 1) / kLumaSide;
    const std::size_t rows = (size.height_px + kLumaSide - 1) / kLumaSide;
    return columns * rows * kMacroblockBytes - sizeof kHeader;
}

void pcm_macroblocks(ConstI420Planes in, PictureSize size, std::uint8_t* out) {
    const int half_width = (size.width_px + 1) / 2, half_height = (size.height_px + 1) / 2;
    const Plane y{in.y, size.width_px, size.height_px};
    const Plane u{in.u, half_width, half_height}, v{in.v, half_width, half_height};
    const int columns = (size.width_px + kLumaSide - 1) / kLumaSide;
    const int rows = (size.height_px + kLumaSide - 1) / kLumaSide;
    std::uint8_t* luma = out;
    for (int row = 0; row < rows; ++row, luma += columns * kMacroblockBytes) {
        for (int column = row == 0 ? 1 : 0; column < columns; ++column) {
            std::copy_n(kHeader, sizeof kHeader, luma + column * kMacroblockBytes - sizeof kHeader);
        }
        for (int line = 0; line < kLumaSide; ++line) {
            copy_across<Row16>(y, row, line, columns, luma + line * kLumaSide);
        }
        std::uint8_t* chroma = luma + kLumaSide * kLumaSide;
        for (int line = 0; line < kChromaSide; ++line, chroma += kChromaSide) {
            copy_across<Row8>(u, row, line, columns, chroma);
            copy_across<Row8>(v, row, line, columns, chroma + kChromaSide * kChromaSide);
        }
    }
}

}  // namespace rfcore

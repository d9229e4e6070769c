// Which 16x16 tiles a splat touches: the exact extent of its ellipse in every row of tiles.
#pragma once

#include "simd/math.h"
#include "raster/types.h"

namespace {

using namespace rfcore::raster;

constexpr int kRowsAtOnce = 8;  // their left ends in the lower half of a vector, right ends above
constexpr int kWindowSide = kRowsAtOnce * kTileSide;  // of 2x2 groups, px

// Per lane: which end of a row it holds, as a sign; the top of the row below the first of the
// eight, px; and what keeps the centre of a pixel inside, with a thousandth of a pixel of margin.
alignas(64) const float kSide[16] = {-1, -1, -1, -1, -1, -1, -1, -1, 1, 1, 1, 1, 1, 1, 1, 1};
alignas(64) const float kTileTop[16] = {0, 16, 32, 48, 64, 80, 96, 112,
                                        0, 16, 32, 48, 64, 80, 96, 112};
alignas(64) const float kToCentre[16] = {0.501f, 0.501f, 0.501f, 0.501f, 0.501f, 0.501f,
                                         0.501f, 0.501f, 0.499f, 0.499f, 0.499f, 0.499f,
                                         0.499f, 0.499f, 0.499f, 0.499f};
alignas(64) const float kLeastPixel[16] = {0,  0,  0,  0,  0,  0,  0,  0,
                                           -1, -1, -1, -1, -1, -1, -1, -1};

// First and last column of pixels of a splat in eight rows of tiles from `top` on, relative to
// `left` and within `width` columns of it; first > last where a row is empty.
RF_INLINE Lanes ellipse_rows(const Splat& s, float left, float top, float width) {
    const Lanes side = load(kSide), least = load(kLeastPixel);
    const float inverse_a = 1.0f / s.a;
    const Lanes half_y = splat(s.half_y), from_centre = load(kTileTop) + splat(top - s.centre_y);
    const Lanes low = max(from_centre + splat(0.5f), negate(half_y));
    const Lanes high = min(from_centre + splat(15.5f), half_y);
    // The axis of a row is x = centre - b/a dy; the outermost points of the ellipse may lie in it.
    const Lanes dy = clamp(splat(s.half_x * s.y_per_x) * side, low, high);
    const Lanes v = splat(s.c) * dy;
    const Lanes reach = sqrt(max(fnma(v, v, splat(s.cutoff)), zero()));
    const Lanes axis = fnma(splat(s.b * inverse_a), dy, splat(s.centre_x - left));
    const Lanes edge = fma(reach, splat(inverse_a) * side, axis);
    // Round inwards: the right end down, the left end up.
    const Lanes outwards = side * clamp(edge - load(kToCentre), least, splat(width) + least);
    return side * (outwards - above_floor(outwards));
}

// The tiles of the 2x2 groups at (`left`, `top`) px that the ellipse touches, a byte per row.
RF_INLINE uint64_t ellipse_tiles(const Camera& camera, const Splat& s, int left, int top) {
    const int columns = camera.width - left < kWindowSide ? camera.width - left : kWindowSide;
    return tiles_of_rows(ellipse_rows(s, static_cast<float>(left), static_cast<float>(top),
                                      static_cast<float>(columns)));
}

// Append the entries of four rows of tiles, columns begin[i]..end[i] each, in one row of groups.
RF_INLINE int place_rows(const Lanes& pixel, int first_lane, int rows, uint32_t first_group,
                         uint32_t id, GroupEntry* out) {
    alignas(64) float ends[16];
    store(ends, pixel);
    int begin[4], end[4], leftmost = 1 << 20, rightmost = -1;
    for (int i = 0; i < rows; ++i) {
        begin[i] = static_cast<int>(ends[first_lane + i]);
        end[i] = static_cast<int>(ends[first_lane + kRowsAtOnce + i]);
        if (end[i] < begin[i]) continue;
        leftmost = begin[i] < leftmost ? begin[i] : leftmost;
        rightmost = end[i] > rightmost ? end[i] : rightmost;
    }
    int count = 0;
    constexpr int kGroupsAtOnce = 16;  // as many as a word has room for
    for (int left = leftmost / kGroupSide; left * kGroupSide <= rightmost; left += kGroupsAtOnce) {
        uint64_t columns[4] = {};
        for (int i = 0; i < rows; ++i) {
            if (end[i] < begin[i]) continue;
            const int low = begin[i] / kTileSide - left * 4, high = end[i] / kTileSide - left * 4;
            if (low > 63 || high < 0) continue;
            columns[i] = (~uint64_t{0} >> (high > 63 ? 0 : 63 - high)) &
                         (~uint64_t{0} << (low < 0 ? 0 : low));
        }
        for (int i = 0; i < kGroupsAtOnce && (left + i) * kGroupSide <= rightmost; ++i) {
            uint32_t tiles = 0;
            for (int row = 0; row < 4; ++row) {
                tiles |= static_cast<uint32_t>(columns[row] >> (4 * i) & 15) << (8 * row);
            }
            out[count] = {first_group + static_cast<uint32_t>(left + i), id, tiles};
            count += tiles != 0;
        }
    }
    return count;
}

// Append the entries of a splat of any size; return how many. There is room for every group.
static int place_large(const Camera& camera, const Splat* splats, uint32_t id, GroupEntry* out) {
    const Splat& s = splats[id];
    const float reach = s.half_y + 1.0f, last_y = static_cast<float>(camera.height - 1);
    const float low = s.centre_y - reach, high = s.centre_y + reach;
    const int first = low > 0.0f ? static_cast<int>(low) / kGroupSide : 0;
    const int last = static_cast<int>(high < last_y ? high : last_y) / kGroupSide;
    const uint32_t groups_x = static_cast<uint32_t>(camera.groups_x());
    int count = 0;
    for (int row = first; row <= last; row += 2) {
        const Lanes pixel = ellipse_rows(s, 0.0f, static_cast<float>(row * kGroupSide),
                                         static_cast<float>(camera.width));
        const int tile_rows = (camera.height - row * kGroupSide + kTileSide - 1) / kTileSide;
        const uint32_t group = static_cast<uint32_t>(row) * groups_x;
        count += place_rows(pixel, 0, tile_rows < 4 ? tile_rows : 4, group, id, out + count);
        if (tile_rows <= 4) break;
        count += place_rows(pixel, 4, tile_rows < 8 ? tile_rows - 4 : 4, group + groups_x, id,
                            out + count);
    }
    return count;
}

}  // namespace

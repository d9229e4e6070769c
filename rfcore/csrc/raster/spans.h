// Which 16x16 tiles a splat touches: the exact extent of its ellipse in every row of tiles.
#pragma once

#include "raster/math.h"
#include "raster/types.h"

namespace {

using namespace rfcore::raster;

constexpr int kRowsAtOnce = 8;  // their left ends in the lower half of a vector, right ends above

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

// Spans of one splat over the tile rows of its box.
RF_INLINE size_t ellipse_spans(const SpanJob& job, const SortItem& item, uint32_t* out) {
    const Splat& s = job.splats[item.id];
    const Lanes side = load(kSide), tile_top = load(kTileTop), to_centre = load(kToCentre);
    const Lanes least = load(kLeastPixel);
    const Lanes most = splat(static_cast<float>(job.camera->width)) + least;
    const float inverse_a = 1.0f / s.a;
    const Lanes to_edge = splat(inverse_a) * side;
    const Lanes shear = splat(s.b * inverse_a);  // the axis of a row: x = centre - shear dy
    const Lanes cc = splat(s.c * s.c);
    const Lanes cutoff = splat(s.cutoff), half_y = splat(s.half_y), centre_x = splat(s.centre_x);
    const Lanes outermost = splat(s.half_x * s.y_per_x) * side;  // dy of the outermost points
    size_t used = 0;
    for (int first = item.tile_y0; first <= item.tile_y1; first += kRowsAtOnce) {
        const Lanes top =
            tile_top + splat(static_cast<float>(first * kTileSide)) - splat(s.centre_y);
        const Lanes low = max(top + splat(0.5f), negate(half_y));
        const Lanes high = min(top + splat(15.5f), half_y);
        const Lanes dy = clamp(outermost, low, high);
        const Lanes reach = sqrt(max(fnma(cc, dy * dy, cutoff), zero()));
        const Lanes edge = fma(reach, to_edge, fnma(shear, dy, centre_x));
        // Round inwards: the right end down, the left end up.
        const Lanes outwards = side * clamp(edge - to_centre, least, most);
        alignas(64) float pixel[16];
        store(pixel, side * (outwards - above_floor(outwards)));
        const int rows = item.tile_y1 - first + 1;
        for (int i = 0; i < (rows < kRowsAtOnce ? rows : kRowsAtOnce); ++i) {
            const float begin = pixel[i], end = pixel[kRowsAtOnce + i];
            const uint32_t x0 = static_cast<uint32_t>(static_cast<int>(begin)) / kTileSide;
            const uint32_t x1 = static_cast<uint32_t>(static_cast<int>(end)) / kTileSide;
            out[used] = pack_span(static_cast<uint32_t>(first + i), x0, x1);
            used += end >= begin;
        }
    }
    return used;
}

// A box of at most 2x2 tiles, or of one row or column, is as good as the ellipse.
RF_INLINE bool is_small(const SortItem& item) {
    const int across = item.tile_x1 - item.tile_x0, down = item.tile_y1 - item.tile_y0;
    return across == 0 || down == 0 || (across == 1 && down == 1);
}

RF_INLINE void count_span(uint32_t* tile_steps, size_t stride, uint32_t span) {
    uint32_t* row = tile_steps + span_row(span) * stride;
    ++row[span_first(span)];
    --row[span_last(span) + 1];
}

static size_t find_spans(const SpanJob& job, const SortItem* items, int count, uint32_t* out) {
    constexpr int kAhead = 16;  // items; hides the latency of a random read of splats
    const size_t stride = static_cast<size_t>(job.camera->tiles_x()) + 1;
    size_t used = 0;
    for (int i = 0; i < count; ++i) {
        const SortItem& item = items[i];
        const int ahead = i + kAhead < count ? i + kAhead : count - 1;
        __builtin_prefetch(&job.splats[items[ahead].id]);
        uint32_t* header = out + used++;
        uint32_t* spans = out + used;
        size_t found = 0;
        if (is_small(item)) {
            for (uint32_t row = item.tile_y0; row <= item.tile_y1; ++row) {
                const uint32_t span = pack_span(row, item.tile_x0, item.tile_x1);
                spans[found++] = span;
                count_span(job.tile_steps, stride, span);
            }
        } else {
            found = ellipse_spans(job, item, spans);
            for (size_t k = 0; k < found; ++k) count_span(job.tile_steps, stride, spans[k]);
        }
        *header = static_cast<uint32_t>(found);
        used += found;
    }
    return used;
}

}  // namespace

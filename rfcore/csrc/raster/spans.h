// Which 16x16 tiles a splat touches: the exact extent of its ellipse in every row of tiles.
#pragma once

#include "raster/math.h"
#include "raster/types.h"

namespace {

using namespace rfcore::raster;

// Spans of one splat over the tile rows of its box; 16 rows of tiles at a time.
RF_INLINE size_t ellipse_spans(const SpanJob& job, const SortItem& item, uint32_t* out) {
    alignas(64) static const float kTileTop[16] = {0,   16,  32,  48,  64,  80,  96,  112,
                                                   128, 144, 160, 176, 192, 208, 224, 240};
    const Splat& s = job.splats[item.id];
    const float width = static_cast<float>(job.camera->width);
    const Lanes inverse_a = splat(1.0f) / splat(s.a);
    const Lanes shear = splat(s.b) * inverse_a;  // the axis of a row: x = centre - shear dy
    const Lanes cc = splat(s.c) * splat(s.c);
    const Lanes cutoff = splat(s.cutoff), half_y = splat(s.half_y), centre_x = splat(s.centre_x);
    const Lanes rightmost = splat(s.half_x) * splat(s.y_per_x);  // dy of the rightmost point
    size_t used = 0;
    for (int first = item.tile_y0; first <= item.tile_y1; first += kLanes) {
        const Lanes top = load(kTileTop) + splat(static_cast<float>(first * kTileSide)) -
                          splat(s.centre_y);
        const Lanes low = max(top + splat(0.5f), negate(half_y));
        const Lanes high = min(top + splat(15.5f), half_y);
        const Lanes right_dy = clamp(rightmost, low, high);
        const Lanes left_dy = clamp(negate(rightmost), low, high);
        const Lanes right_reach = sqrt(max(fnma(cc, right_dy * right_dy, cutoff), zero()));
        const Lanes left_reach = sqrt(max(fnma(cc, left_dy * left_dy, cutoff), zero()));
        const Lanes right = fma(right_reach, inverse_a, fnma(shear, right_dy, centre_x));
        const Lanes left = fnma(left_reach, inverse_a, fnma(shear, left_dy, centre_x));
        // Pixels whose centre is inside, with a thousandth of a pixel of margin; ceil and floor.
        Lanes begin = clamp(left - splat(0.501f), zero(), splat(width));
        Lanes end = clamp(right - splat(0.499f), splat(-1.0f), splat(width - 1.0f));
        begin = begin + above_floor(negate(begin));
        end = end - above_floor(end);
        const int rows = item.tile_y1 - first + 1;
        uint32_t inside = bits(ge(end, begin));
        if (rows < kLanes) inside &= (1u << rows) - 1;
        alignas(64) float begin_px[16], end_px[16];
        store(begin_px, begin);
        store(end_px, end);
        for (; inside != 0; inside &= inside - 1) {
            const int i = __builtin_ctz(inside);
            const uint32_t x0 = static_cast<uint32_t>(begin_px[i]) / kTileSide;
            const uint32_t x1 = static_cast<uint32_t>(end_px[i]) / kTileSide;
            out[used++] = pack_span(static_cast<uint32_t>(first + i), x0, x1);
        }
    }
    return used;
}

// A box of at most 2x2 tiles, or of one row or column, is as good as the ellipse.
RF_INLINE bool is_small(const SortItem& item) {
    const int across = item.tile_x1 - item.tile_x0, down = item.tile_y1 - item.tile_y0;
    return across == 0 || down == 0 || (across == 1 && down == 1);
}

static size_t find_spans(const SpanJob& job, const SortItem* items, int count, uint32_t* out) {
    constexpr int kAhead = 16;  // items; hides the latency of a random read of splats
    const size_t stride = static_cast<size_t>(job.camera->tiles_x()) + 1;
    size_t used = 0;
    for (int i = 0; i < count; ++i) {
        const SortItem& item = items[i];
        const int ahead = i + kAhead < count ? i + kAhead : count - 1;
        if (!is_small(items[ahead])) __builtin_prefetch(&job.splats[items[ahead].id]);
        uint32_t* header = out + used++;
        uint32_t* spans = out + used;
        size_t found = 0;
        if (is_small(item)) {
            for (uint32_t row = item.tile_y0; row <= item.tile_y1; ++row) {
                spans[found++] = pack_span(row, item.tile_x0, item.tile_x1);
            }
        } else {
            found = ellipse_spans(job, item, spans);
        }
        *header = static_cast<uint32_t>(found);
        used += found;
        for (size_t k = 0; k < found; ++k) {
            uint32_t* row = job.tile_steps + span_row(spans[k]) * stride;
            ++row[span_first(spans[k])];
            --row[span_last(spans[k]) + 1];
        }
    }
    return used;
}

}  // namespace

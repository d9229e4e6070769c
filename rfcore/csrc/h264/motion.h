// Motion vectors: their prediction (8.4.1) and their search.
#pragma once

#include "h264/residual.h"

namespace {

// References and vectors of the 4x4 blocks around and inside a macroblock: row 0 above, column 0
// left, rows and columns 1..4 its own, row 0 column 5 above to the right.
struct MotionField {
    int8_t reference[5][6];
    Mv mv[5][6];

    void clear() {
        for (int y = 0; y < 5; ++y) {
            for (int x = 0; x < 6; ++x) put(x, y, kUnavailable, {0, 0});
        }
    }

    void put(int x, int y, int8_t index, Mv vector) {
        reference[y][x] = index;
        mv[y][x] = vector;
    }

    void take(int x, int y, const Neighbour* from, int raster) {
        if (from != nullptr) {
            put(x, y, from->reference[2 * (raster >> 3) + ((raster >> 1) & 1)], from->mv[raster]);
        }
    }

    void begin(const Around& around) {
        clear();
        take(0, 0, around.above_left, 15);
        take(5, 0, around.above_right, 12);
        for (int i = 0; i < 4; ++i) {
            take(1 + i, 0, around.above, 12 + i);
            take(0, 1 + i, around.left, 4 * i + 3);
        }
    }

    // Marks the macroblock's own blocks as not yet known.
    void forget() {
        for (int y = 1; y < 5; ++y) {
            for (int x = 1; x < 5; ++x) put(x, y, kUnavailable, {0, 0});
        }
    }

    void fill(const Partition& part, int8_t index, Mv vector) {
        for (int i = 0; i < 16; ++i) {
            if (!part.covers(2 * (i >> 3) + ((i >> 1) & 1))) continue;
            put(1 + (i & 3), 1 + (i >> 2), index, vector);
        }
    }
};

inline int16_t median(int16_t a, int16_t b, int16_t c) {
    const int16_t low = a < b ? a : b, high = a < b ? b : a;
    return c < low ? low : c > high ? high : c;
}

// The median prediction (8.4.1.3), without the rules for halves.
inline Mv median_prediction(const MotionField& f, int index, int x, int y, int width) {
    const int row = y + 1, column = x + 1;
    int cx = column + width, cy = row - 1;
    if (f.reference[cy][cx] == kUnavailable) cx = column - 1;
    const int8_t a = f.reference[row][column - 1], b = f.reference[row - 1][column];
    const int8_t c = f.reference[cy][cx];
    const Mv mva = f.mv[row][column - 1], mvb = f.mv[row - 1][column], mvc = f.mv[cy][cx];
    if (b == kUnavailable && c == kUnavailable && a != kUnavailable) return mva;
    const int same = (a == index) + (b == index) + (c == index);
    if (same == 1) return a == index ? mva : b == index ? mvb : mvc;
    return {median(mva.x, mvb.x, mvc.x), median(mva.y, mvb.y, mvc.y)};
}

inline Mv predicted_vector(const MotionField& f, int shape, const Partition& part, int index) {
    const int x = 2 * (part.block & 1), y = 2 * (part.block >> 1);
    if (shape == 1 && y == 0 && f.reference[0][1] == index) return f.mv[0][1];
    if (shape == 1 && y == 2 && f.reference[3][0] == index) return f.mv[3][0];
    if (shape == 2 && x == 0 && f.reference[1][0] == index) return f.mv[1][0];
    if (shape == 2 && x == 2) {
        const int cx = f.reference[0][5] == kUnavailable ? 2 : 5;
        if (f.reference[0][cx] == index) return f.mv[0][cx];
    }
    return median_prediction(f, index, x, y, part.width);
}

// The vector of a skipped macroblock (8.4.1.1).
inline Mv skip_vector(const MotionField& f) {
    const int8_t a = f.reference[1][0], b = f.reference[0][1];
    if (a == kUnavailable || b == kUnavailable) return {0, 0};
    if (a == 0 && f.mv[1][0] == Mv{0, 0}) return {0, 0};
    if (b == 0 && f.mv[0][1] == Mv{0, 0}) return {0, 0};
    return median_prediction(f, 0, 0, 0, 4);
}

// About the bits of one component of mvd_l0, in 1/256: 180, or 700 and 512 for every doubling.
inline uint32_t vector_bits(int difference) {
    const uint32_t size = static_cast<uint32_t>(difference < 0 ? -difference : difference);
    const auto digits = static_cast<uint32_t>(31 - __builtin_clz(2 * size + 1));
    return 188 + 512 * digits - (size == 0 ? 8 : 0);
}

struct Range {
    int16_t low_x, high_x, low_y, high_y;  // of vectors, in quarter samples
    bool holds(Mv v) const {
        return v.x >= low_x && v.x <= high_x && v.y >= low_y && v.y <= high_y;
    }
    bool holds_around(Mv v, int distance) const {
        return v.x - distance >= low_x && v.x + distance <= high_x && v.y - distance >= low_y &&
               v.y + distance <= high_y;
    }
    Mv clamped(Mv v) const {
        return {v.x < low_x ? low_x : v.x > high_x ? high_x : v.x,
                v.y < low_y ? low_y : v.y > high_y ? high_y : v.y};
    }
};

struct Found {
    Mv mv;
    uint32_t cost;  // 256 times the difference, plus bits
};

// Searches one block in one reference.
struct Search {
    const QuarterPlanes& planes;
    const uint8_t* source;
    ptrdiff_t source_stride;
    const Short16* transformed;  // rows of a TransformedSource
    int x, y, width, height;  // of the block in the picture
    Mv predicted;
    uint32_t motion_q8;
    Range range;

    uint32_t cost_of_bits(uint32_t bits) const {
        return static_cast<uint32_t>((static_cast<uint64_t>(motion_q8) * bits) >> 8);
    }

    uint32_t vector_cost(Mv v) const {
        return cost_of_bits(vector_bits(v.x - predicted.x) + vector_bits(v.y - predicted.y));
    }

    uint32_t whole(Mv v) const {
        const uint8_t* at = planes.whole(x + (v.x >> 2), y + (v.y >> 2));
        const uint32_t sum =
            width == 16 ? absolute_difference<16>(source, source_stride, at, planes.stride, height)
                        : absolute_difference<8>(source, source_stride, at, planes.stride, height);
        return 256 * sum + vector_cost(v);
    }

    // 256 times the transformed difference.
    uint32_t exact_difference(Mv v) const {
        const QuarterSamples at = planes.at(x, y, v);
        const uint32_t sum = width == 16 ? transformed_difference<16>(transformed, at, height)
                                         : transformed_difference<8>(transformed, at, height);
        return 256 * sum;
    }

    uint32_t exact(Mv v) const { return exact_difference(v) + vector_cost(v); }

    using Costs = uint32_t[4];
    static constexpr uint32_t kOutside = UINT32_MAX;

    // Costs of the bits of the four vectors around `centre`; kOutside for those out of range.
    void vector_costs_around(Mv centre, int distance, Costs& costs) const {
        const int dx = centre.x - predicted.x, dy = centre.y - predicted.y;
        const uint32_t x = vector_bits(dx), y = vector_bits(dy);
        costs[0] = cost_of_bits(vector_bits(dx + distance) + y);
        costs[1] = cost_of_bits(vector_bits(dx - distance) + y);
        costs[2] = cost_of_bits(x + vector_bits(dy + distance));
        costs[3] = cost_of_bits(x + vector_bits(dy - distance));
        if (range.holds_around(centre, distance)) return;
        for (int i = 0; i < 4; ++i) {
            if (!range.holds(neighbour(centre, distance, i))) costs[i] = kOutside;
        }
    }

    // Costs of the four vectors a sample around `centre`.
    void whole_around(Mv centre, Costs& costs) const {
        Costs sums;
        const uint8_t* at = planes.whole(x + (centre.x >> 2), y + (centre.y >> 2));
        if (width == 16) {
            absolute_differences_around<16>(source, source_stride, at, planes.stride, height, sums);
        } else {
            absolute_differences_around<8>(source, source_stride, at, planes.stride, height, sums);
        }
        vector_costs_around(centre, 4, costs);
        for (int i = 0; i < 4; ++i) {
            costs[i] = costs[i] == kOutside ? kOutside : costs[i] + 256 * sums[i];
        }
    }

    void exact_around(Mv centre, int distance, int left_out, Costs& costs) const {
        vector_costs_around(centre, distance, costs);
        for (int i = 0; i < 4; ++i) {
            if (i == left_out || costs[i] == kOutside) {
                costs[i] = kOutside;
            } else {
                costs[i] += exact_difference(neighbour(centre, distance, i));
            }
        }
    }

    // Right, left, below, above.
    static Mv neighbour(Mv centre, int distance, int i) {
        static constexpr int8_t kDirections[4][2] = {{1, 0}, {-1, 0}, {0, 1}, {0, -1}};
        return {static_cast<int16_t>(centre.x + distance * kDirections[i][0]),
                static_cast<int16_t>(centre.y + distance * kDirections[i][1])};
    }

    // At most `steps` steps, each to the best of the four neighbours at `distance`, until none is
    // better. `measure(centre, left_out, costs)` need not measure the neighbour left out: the last
    // step came from there, so it costs more.
    template <class Measure>
    static void walk(Found& best, int distance, int steps, Measure measure) {
        int back = -1;
        while (steps-- > 0) {
            Costs costs;
            measure(best.mv, back, costs);
            int taken = -1;
            uint32_t least = best.cost;
            for (int i = 0; i < 4; ++i) {
                taken = costs[i] < least ? i : taken;
                least = costs[i] < least ? costs[i] : least;
            }
            if (taken < 0) return;
            best = {neighbour(best.mv, distance, taken), least};
            back = taken ^ 1;
        }
    }

    // Whether starts[i] is one of those before it.
    static bool known(const Mv* starts, int i) {
        for (int j = 0; j < i; ++j) {
            if (starts[j] == starts[i]) return true;
        }
        return false;
    }

    // The best of `starts`: those between samples as they are, and the nearest whole one.
    Found first_of(const Mv* starts, int count) const {
        Found best = {{0, 0}, UINT32_MAX};
        for (int i = 0; i < count; ++i) {
            Mv v = range.clamped(starts[i]);
            v = {static_cast<int16_t>((v.x + 2) & ~3), static_cast<int16_t>((v.y + 2) & ~3)};
            if (known(starts, i) || !range.holds(v) || (i > 0 && v == best.mv)) continue;
            const uint32_t cost = whole(v);
            if (cost < best.cost) best = {v, cost};
        }
        best.cost = exact(best.mv);
        for (int i = 0; i < count; ++i) {
            const Mv v = starts[i];
            if (((v.x | v.y) & 3) == 0 || known(starts, i) || !range.holds(v)) continue;
            const uint32_t cost = exact(v);
            if (cost < best.cost) best = {v, cost};
        }
        return best;
    }

    // Walks from `start` by whole samples, then by halves and quarters.
    Found refined(const Found& start, const Effort& effort) const {
        const Mv rounded = {static_cast<int16_t>((start.mv.x + 2) & ~3),
                            static_cast<int16_t>((start.mv.y + 2) & ~3)};
        Found best = start;
        if (range.holds(rounded)) {
            Found other = {rounded, whole(rounded)};
            walk(other, 4, effort.search_steps,
                 [&](Mv centre, int, Costs& costs) { whole_around(centre, costs); });
            if (!(other.mv == rounded)) {
                other.cost = exact(other.mv);
                if (other.cost < best.cost) best = other;
            }
        }
        for (int distance = 2; distance > 0; --distance) {
            walk(best, distance, effort.subsample_steps,
                 [&](Mv centre, int left_out, Costs& costs) {
                     exact_around(centre, distance, left_out, costs);
                 });
        }
        return best;
    }
};

}  // namespace

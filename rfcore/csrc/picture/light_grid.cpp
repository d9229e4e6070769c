#include "picture/light_grid.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <vector>

#include "picture/per_isa.h"

namespace rfcore {
namespace {

constexpr int kBins = kLightBins, kBinLevels = 32, kBinUnits = 16;
constexpr int kCellSamples = 8;                     // a side of a cell, in chroma samples
constexpr int kPlaces = 32;                         // positions from one vertex to the next
constexpr std::int64_t kOffsetWeight = 160, kGainWeight = 16000;
constexpr int kOffsetBits = 8, kGainBits = 15, kMeanBits = 11, kTableBits = 5;
constexpr std::int64_t kMostOffset = 1 << 16, kMostGain = 1 << 16;
constexpr std::array<int, 3> kLevels = {16, 4, 1};  // cells a side, coarse to fine
constexpr int kSentLevel = 4;
static_assert(kSentLevel * 2 * kCellSamples == kLightCellPx);
constexpr int kLuma = 256;

// Of a vertex: weight, x, x^2; then of each plane d and x d. x is the render's luma - 128, d what
// the frame's plane differs by.
constexpr int kPlanes = kLightPlanes, kSums = 3 + 2 * kPlanes;
using Sums = std::array<std::int64_t, kSums>;

// What a vertex adds to a plane at luma x + 128: offset / 2^8 + x gain / 2^15.
constexpr int kNumbers = 2 * kPlanes;
using Vertex = std::array<std::int32_t, kNumbers>;

struct GridSize {
    int rows, columns;
    std::size_t vertices() const { return static_cast<std::size_t>(rows) * columns * kBins; }
    std::size_t at(int row, int column, int bin) const {
        return (static_cast<std::size_t>(row) * columns + column) * kBins + bin;
    }
};

int ceil_div(int a, int b) { return (a + b - 1) / b; }

std::int64_t rounded_div(std::int64_t a, std::int64_t b) {  // half up; b > 0
    const std::int64_t n = a + b / 2, q = n / b;
    return n % b < 0 ? q - 1 : q;
}

PictureSize half_of(PictureSize size) {
    return {(size.width_px + 1) / 2, (size.height_px + 1) / 2};
}

GridSize grid_of(PictureSize size) {
    const PictureSize half = half_of(size);
    return {ceil_div(half.height_px, kCellSamples), ceil_div(half.width_px, kCellSamples)};
}

// Means of 2x2 luma samples, rounded half up; a last odd row or column counts twice.
void halve_row(const std::uint8_t* luma, PictureSize size, int row, std::uint8_t* means) {
    const std::uint8_t* top = luma + static_cast<std::size_t>(2 * row) * size.width_px;
    const std::uint8_t* bottom = 2 * row + 1 < size.height_px ? top + size.width_px : top;
    const int pairs = size.width_px / 2;
    for (int x = 0; x < pairs; ++x) {
        means[x] = static_cast<std::uint8_t>(
            (top[2 * x] + top[2 * x + 1] + bottom[2 * x] + bottom[2 * x + 1] + 2) >> 2);
    }
    if (size.width_px % 2 != 0) {
        means[pairs] = static_cast<std::uint8_t>((top[2 * pairs] + bottom[2 * pairs] + 1) >> 1);
    }
}

std::vector<std::uint8_t> halved(const std::uint8_t* luma, PictureSize size) {
    const PictureSize half = half_of(size);
    std::vector<std::uint8_t> means(static_cast<std::size_t>(half.width_px) * half.height_px);
    for (int row = 0; row < half.height_px; ++row) {
        halve_row(luma, size, row, means.data() + static_cast<std::size_t>(row) * half.width_px);
    }
    return means;
}

struct BinAt {
    int low, fraction;  // of kBinUnits
};

BinAt bin_at(int luma) {
    const int place =
        std::clamp(luma * kBinUnits / kBinLevels - kBinUnits / 2, 0, kBinUnits * (kBins - 1));
    const int low = std::min(place / kBinUnits, kBins - 2);
    return {low, place - low * kBinUnits};
}

std::array<BinAt, kLuma> all_bins() {
    std::array<BinAt, kLuma> bins;
    for (int luma = 0; luma < kLuma; ++luma) bins[luma] = bin_at(luma);
    return bins;
}

std::vector<Sums> accumulated(ConstI420Planes seen, ConstI420Planes render, PictureSize size,
                              GridSize grid) {
    const PictureSize half = half_of(size);
    const auto from = halved(render.y, size), to = halved(seen.y, size);
    const auto bins = all_bins();
    std::vector<Sums> sums(grid.vertices(), Sums{});
    std::size_t i = 0;
    for (int row = 0; row < half.height_px; ++row) {
        for (int column = 0; column < half.width_px; ++column, ++i) {
            const BinAt bin = bins[from[i]];
            const int x = from[i] - 128;
            const int d[kPlanes] = {to[i] - from[i], seen.u[i] - render.u[i],
                                    seen.v[i] - render.v[i]};
            const int terms[kSums] = {1, x, x * x, d[0], x * d[0], d[1], x * d[1], d[2], x * d[2]};
            Sums* vertex = &sums[grid.at(row / kCellSamples, column / kCellSamples, bin.low)];
            for (int k = 0; k < kSums; ++k) {
                vertex[0][k] += (kBinUnits - bin.fraction) * terms[k];
                vertex[1][k] += bin.fraction * terms[k];
            }
        }
    }
    return sums;
}

// Filters [outer, n, inner] along its middle axis by (1, 2, 1), the ends repeated.
template <typename T>
void smooth(T* data, std::size_t outer, std::size_t n, std::size_t inner) {
    std::vector<T> before(inner);
    for (std::size_t o = 0; o < outer; ++o) {
        T* rows = data + o * n * inner;
        std::copy(rows, rows + inner, before.begin());
        for (std::size_t i = 0; i < n; ++i) {
            T* row = rows + i * inner;
            const T* next = i + 1 < n ? row + inner : row;
            for (std::size_t k = 0; k < inner; ++k) {
                const T own = row[k];
                row[k] = before[k] + 2 * own + next[k];
                before[k] = own;
            }
        }
    }
}

void smooth_sums(std::vector<Sums>& sums, GridSize grid) {
    std::int64_t* data = sums.front().data();
    const std::size_t rows = grid.rows, columns = grid.columns;
    smooth(data, 1, rows, columns * kBins * kSums);
    smooth(data, rows, columns, kBins * kSums);
    smooth(data, rows * columns, kBins, kSums);
}

void smooth_vertices(std::vector<Vertex>& vertices, GridSize grid) {
    std::int32_t* data = vertices.front().data();
    const std::size_t rows = grid.rows, columns = grid.columns, n = vertices.size() * kNumbers;
    smooth(data, 1, rows, columns * kBins * kNumbers);
    for (std::size_t i = 0; i < n; ++i) data[i] = (data[i] + 2) >> 2;
    smooth(data, rows, columns, kBins * kNumbers);
    for (std::size_t i = 0; i < n; ++i) data[i] = (data[i] + 2) >> 2;
}

// Ridge regression of each plane's d on (1, x), towards `prior`.
Vertex solved(const Sums& sums, const Vertex& prior) {
    const std::int64_t n = sums[0], sx = sums[1], sxx = sums[2], weight = n + kOffsetWeight;
    const std::int64_t mean = rounded_div(sx * (1 << kMeanBits), weight);
    const std::int64_t spread =
        std::max<std::int64_t>(sxx - ((sx * mean) >> kMeanBits), 0) + kGainWeight;
    Vertex found;
    for (int p = 0; p < kPlanes; ++p) {
        const std::int64_t offset = prior[2 * p], gain = prior[2 * p + 1];
        const auto rest = [&](std::int64_t d, std::int64_t ones, std::int64_t xs) {
            return d * (1 << kOffsetBits) - offset * ones - ((gain * xs) >> (kGainBits - kOffsetBits));
        };
        const std::int64_t r = rest(sums[3 + 2 * p], n, sx), xr = rest(sums[4 + 2 * p], sx, sxx);
        const std::int64_t slope = rounded_div(
            (xr - ((r * mean) >> kMeanBits)) * (1 << (kGainBits - kOffsetBits)), spread);
        const std::int64_t more_gain = std::clamp(gain + slope, -kMostGain, kMostGain) - gain;
        const std::int64_t level =
            rounded_div(r - ((more_gain * sx) >> (kGainBits - kOffsetBits)), weight);
        found[2 * p] =
            static_cast<std::int32_t>(std::clamp(offset + level, -kMostOffset, kMostOffset));
        found[2 * p + 1] = static_cast<std::int32_t>(gain + more_gain);
    }
    return found;
}

void add(Sums& to, const Sums& from) {
    for (int k = 0; k < kSums; ++k) to[k] += from[k];
}

// The whole picture's numbers, bin by bin: what the coarsest level tends to.
std::array<Vertex, kBins> solved_whole(const std::vector<Sums>& sums) {
    std::array<Sums, kBins> bins{};
    for (std::size_t i = 0; i < sums.size(); ++i) add(bins[i % kBins], sums[i]);
    Sums all{};
    for (const Sums& bin : bins) add(all, bin);
    const Vertex whole = solved(all, Vertex{});
    std::array<Vertex, kBins> found;
    for (int bin = 0; bin < kBins; ++bin) found[bin] = solved(bins[bin], whole);
    return found;
}

std::vector<Sums> coarser(const std::vector<Sums>& sums, GridSize grid, int level, GridSize to) {
    std::vector<Sums> added(to.vertices(), Sums{});
    for (int row = 0; row < grid.rows; ++row) {
        for (int column = 0; column < grid.columns; ++column) {
            for (int bin = 0; bin < kBins; ++bin) {
                add(added[to.at(row / level, column / level, bin)],
                    sums[grid.at(row, column, bin)]);
            }
        }
    }
    return added;
}

// Vertices of a level four times finer: repeated, then smoothed over rows and columns.
std::vector<Vertex> finer(const std::vector<Vertex>& vertices, GridSize grid, GridSize to) {
    std::vector<Vertex> repeated(to.vertices());
    for (int row = 0; row < to.rows; ++row) {
        for (int column = 0; column < to.columns; ++column) {
            const Vertex* from = &vertices[grid.at(row / 4, column / 4, 0)];
            std::copy(from, from + kBins, &repeated[to.at(row, column, 0)]);
        }
    }
    smooth_vertices(repeated, to);
    return repeated;
}

GridSize size_at(GridSize grid, int level) {
    return {ceil_div(grid.rows, level), ceil_div(grid.columns, level)};
}

// The vertices of the level whose cells have `last` cells of `grid` a side.
std::vector<Vertex> solved_grid(const std::vector<Sums>& sums, GridSize grid, int last) {
    const auto whole = solved_whole(sums);
    std::vector<Vertex> vertices;
    GridSize before{0, 0};
    for (const int level : kLevels) {
        if (level < last) break;
        const GridSize size = size_at(grid, level);
        auto level_sums = coarser(sums, grid, level, size);
        smooth_sums(level_sums, size);
        if (before.rows != 0) {
            vertices = finer(vertices, before, size);
        } else {
            vertices.resize(size.vertices());
            for (std::size_t i = 0; i < vertices.size(); ++i) vertices[i] = whole[i % kBins];
        }
        for (std::size_t i = 0; i < vertices.size(); ++i) {
            vertices[i] = solved(level_sums[i], vertices[i]);
        }
        before = size;
    }
    return vertices;
}

using Table = std::array<std::int16_t, kLuma>;

// What a vertex adds to samples of plane p, in levels / 2^15.
inline std::int32_t added_by(const Vertex& vertex, int p, int luma) {
    return vertex[2 * p] * (1 << (kGainBits - kOffsetBits)) + vertex[2 * p + 1] * (luma - 128);
}

// What a vertex adds to samples of plane p in the middle of its bin, in levels / 2^8.
std::int32_t change_at_middle(const Vertex& vertex, int p, std::size_t bin) {
    const int luma = static_cast<int>(bin) * kBinLevels + kBinLevels / 2;
    constexpr int shift = kGainBits - kOffsetBits;
    const std::int32_t change = (added_by(vertex, p, luma) + (1 << (shift - 1))) >> shift;
    return std::clamp<std::int32_t>(change, -kMostOffset, kMostOffset);
}

// What a cell's centre adds to samples of plane p, by luma, in 1/32 levels.
RFCORE_PER_ISA
void fill_table(const Vertex* bins, int p, std::int16_t* table) {
    constexpr int shift = kGainBits + 4 - kTableBits;  // 4 bits of kBinUnits
    for (int luma = 0; luma < kLuma; ++luma) {
        const BinAt bin = bin_at(luma);
        const std::int32_t sum = (kBinUnits - bin.fraction) * added_by(bins[bin.low], p, luma) +
                                 bin.fraction * added_by(bins[bin.low + 1], p, luma);
        table[luma] = static_cast<std::int16_t>((sum + (1 << (shift - 1))) >> shift);
    }
}

std::vector<Table> tables_of(const std::vector<Vertex>& vertices, int p) {
    std::vector<Table> tables(vertices.size() / kBins);
    for (std::size_t i = 0; i < tables.size(); ++i) fill_table(&vertices[i * kBins], p, tables[i].data());
    return tables;
}

struct Place {
    int low, high, fraction;  // of kPlaces
};

// Where n samples stand between vertices that are `cell` samples apart, the first in mid-cell.
std::vector<Place> places_of(int n, int vertices, int cell) {
    std::vector<Place> places(n);
    for (int i = 0; i < n; ++i) {
        const int place = std::clamp((2 * i + 1 - cell) * (kPlaces / 2 / cell), 0,
                                     kPlaces * (vertices - 1));
        const int low = place / kPlaces;
        places[i] = {low, std::min(low + 1, vertices - 1), place % kPlaces};
    }
    return places;
}

struct Target {
    const std::uint8_t* luma;  // by which the table is read
    const std::uint8_t* plane;
    PictureSize size;
    int cell;  // a cell's side, in samples of the plane
    std::uint8_t* out;
};

RFCORE_PER_ISA
void relight_row(const std::uint8_t* luma, const std::uint8_t* plane, const Table* top,
                 const Table* bottom, int fraction, const Place* columns, int n,
                 std::uint8_t* out) {
    constexpr int shift = 10 + kTableBits;  // 10 bits of kPlaces squared
    for (int i = 0; i < n; ++i) {
        const Place at = columns[i];
        const int above = (kPlaces - at.fraction) * top[at.low][luma[i]] +
                          at.fraction * top[at.high][luma[i]];
        const int below = (kPlaces - at.fraction) * bottom[at.low][luma[i]] +
                          at.fraction * bottom[at.high][luma[i]];
        const int sum = (kPlaces - fraction) * above + fraction * below;
        const int value = plane[i] + ((sum + (1 << (shift - 1))) >> shift);
        out[i] = static_cast<std::uint8_t>(std::clamp(value, 1, 255));
    }
}

void relight_plane(const Target& target, const std::vector<Table>& tables, GridSize grid) {
    const int width = target.size.width_px;
    const auto rows = places_of(target.size.height_px, grid.rows, target.cell);
    const auto columns = places_of(width, grid.columns, target.cell);
    std::size_t i = 0;
    for (const Place& row : rows) {
        relight_row(target.luma + i, target.plane + i, &tables[row.low * grid.columns],
                    &tables[row.high * grid.columns], row.fraction, columns.data(), width,
                    target.out + i);
        i += width;
    }
}

void relight(const std::vector<Vertex>& vertices, GridSize grid, ConstI420Planes render,
             PictureSize size, I420Planes out) {
    const auto means = halved(render.y, size);
    const PictureSize half = half_of(size);
    const Target targets[kPlanes] = {{render.y, render.y, size, 2 * kCellSamples, out.y},
                                     {means.data(), render.u, half, kCellSamples, out.u},
                                     {means.data(), render.v, half, kCellSamples, out.v}};
    for (int p = 0; p < kPlanes; ++p) relight_plane(targets[p], tables_of(vertices, p), grid);
}

}  // namespace

void solve_light(ConstI420Planes frame, ConstI420Planes render, PictureSize size,
                 std::int32_t* changes) {
    const GridSize grid = grid_of(size);
    const auto found = solved_grid(accumulated(frame, render, size, grid), grid, kSentLevel);
    for (std::size_t i = 0; i < found.size(); ++i) {
        for (int p = 0; p < kPlanes; ++p) *changes++ = change_at_middle(found[i], p, i % kBins);
    }
}

void apply_light(const std::int32_t* changes, ConstI420Planes render, PictureSize size,
                 I420Planes out) {
    const GridSize grid = grid_of(size), sent = size_at(grid, kSentLevel);
    std::vector<Vertex> vertices(sent.vertices(), Vertex{});
    for (Vertex& vertex : vertices) {
        for (int p = 0; p < kPlanes; ++p) vertex[2 * p] = *changes++;
    }
    relight(finer(vertices, sent, grid), grid, render, size, out);
}

void relight_i420(ConstI420Planes seen, ConstI420Planes seen_render, ConstI420Planes render,
                  PictureSize size, I420Planes out) {
    const GridSize grid = grid_of(size);
    const auto sums = accumulated(seen, seen_render, size, grid);
    relight(solved_grid(sums, grid, 1), grid, render, size, out);
}

}  // namespace rfcore

// What blending a tile forwards and backwards share: splats gathered into the first-level cache,
// tested against the sixteen 4x4 blocks of the tile, and turned into alpha.
//
// Lanes of a block run down its columns: lane 4 x + y is pixel (x, y). What depends on the row of
// a pixel alone is computed once per splat and row, and read back four floats at a time.
#pragma once

#include "simd/math.h"
#include "raster/types.h"

namespace {

using namespace rfcore::raster;

constexpr float kMaxAlpha = 0.99f;
constexpr float kMinPower = 0.00564656f;  // log2(256 / 255): the least that counts
constexpr float kMinTransmittance = 1e-4f;
constexpr int kChunk = 128;  // splats gathered at a time
constexpr int kGroups = kChunk / kLanes;

alignas(64) const float kRowCentre[16] = {0.5f, 1.5f, 2.5f,  3.5f,  4.5f,  5.5f,  6.5f,  7.5f,
                                          8.5f, 9.5f, 10.5f, 11.5f, 12.5f, 13.5f, 14.5f, 15.5f};
alignas(64) const float kLaneX[16] = {0.5f, 0.5f, 0.5f, 0.5f, 1.5f, 1.5f, 1.5f, 1.5f,
                                      2.5f, 2.5f, 2.5f, 2.5f, 3.5f, 3.5f, 3.5f, 3.5f};

// One splat as the pixels of a tile need it: u = a x + u_of_row, 256 alpha = 2^(power_of_row - u^2).
struct alignas(64) TileEntry {
    Splat splat;
    float u_of_row[16];
    float power_of_row[16];
};

struct TileChunk {
    TileEntry entries[kChunk + 1];  // the one behind the last is transparent
    uint16_t touching[kBlocksPerTile][kGroups];
    uint16_t offsets[kChunk + 32];  // bytes from `entries` of the splats touching a block

    const TileEntry& at(int k) const {
        return *reinterpret_cast<const TileEntry*>(reinterpret_cast<const char*>(entries) +
                                                   offsets[k]);
    }
};

// Position of a tile in the picture; tiles are numbered group by group.
struct TilePlace {
    int group, column, row;  // column and row in tiles, of the picture
    uint32_t bit;            // of the tile in its group

    TilePlace(const Camera& camera, int tile) : group(tile / kTilesPerGroup) {
        const int inside = tile % kTilesPerGroup, per_side = kTilesPerGroupSide;
        column = group % camera.groups_x() * per_side + inside % per_side;
        row = group / camera.groups_x() * per_side + inside / per_side;
        bit = tile_bit(inside % per_side, inside / per_side);
    }
    bool is_inside(const Camera& camera) const {
        return column * kTileSide < camera.width && row * kTileSide < camera.height;
    }
    float left() const { return static_cast<float>(column * kTileSide); }
    float top() const { return static_cast<float>(row * kTileSide); }
};

// The entries of a group that touch one tile, front to back, a chunk at a time.
struct TileList {
    const GroupLists& lists;
    uint32_t bit, next, end;
    int found = 0;                           // how many of `positions` are filled
    int taken = 0;                           // and belong to chunks before
    uint32_t positions[kChunk + 2 * kLanes];  // in the lists

    TileList(const GroupLists& all, const TilePlace& tile)
        : lists(all), bit(tile.bit), next(all.offsets[tile.group]),
          end(all.offsets[tile.group + 1]) {}

    // Find up to kChunk more; return how many.
    int find_chunk() {
        const uint32_t* const tiles = lists.tiles;
        const uint32_t wanted = bit, last = end;
        int count = found - taken;
        for (int i = 0; i < count; ++i) positions[i] = positions[taken + i];
        uint32_t at = next;
        for (; count < kChunk && at < last; at += kLanes) {
            count += append_matching(positions + count, tiles + at, wanted, at, last - at);
        }
        next = at < last ? at : last;
        found = count;
        taken = count < kChunk ? count : kChunk;
        return taken;
    }
};

// T = 1 inside the picture and 0 outside; return the blocks wholly outside as a bit set.
RF_INLINE uint32_t start_transmittance(const Camera& camera, int tile_x, int tile_y,
                                       float (*transmittance)[16]) {
    uint32_t outside = 0;
    for (int b = 0; b < kBlocksPerTile; ++b) {
        const int left = tile_x * kTileSide + (b & 3) * kBlockSide;
        const int top = tile_y * kTileSide + (b >> 2) * kBlockSide;
        if (left + kBlockSide <= camera.width && top + kBlockSide <= camera.height) {
            store(transmittance[b], splat(1.0f));
            continue;
        }
        for (int lane = 0; lane < kLanes; ++lane) {
            const bool inside =
                left + (lane >> 2) < camera.width && top + (lane & 3) < camera.height;
            transmittance[b][lane] = inside ? 1.0f : 0.0f;
        }
        if (left >= camera.width || top >= camera.height) outside |= 1u << b;
    }
    return outside;
}

RF_INLINE void make_transparent(TileEntry* e) {
    store(reinterpret_cast<float*>(&e->splat), zero());
    store(e->u_of_row, zero());
    store(e->power_of_row, splat(-100.0f));
}

// Gather `count` splats; what lies behind them up to the next 16 can touch nothing.
RF_INLINE void gather(const Splat* splats, const TileList& list, int count, float left, float top,
                      TileChunk* chunk) {
    constexpr int kAhead = 24;
    const Lanes row_centre = load(kRowCentre) + splat(top);
    uint32_t ids[kChunk + kAhead];
    for (int i = 0; i < count; ++i) ids[i] = list.lists.splats[list.positions[i]];
    for (int i = 0; i < kAhead; ++i) ids[count + i] = ids[count - 1];
    for (int i = 0; i < count; ++i) {
        __builtin_prefetch(&splats[ids[i + kAhead]]);
        const Splat& s = splats[ids[i]];
        TileEntry& e = chunk->entries[i];
        store(reinterpret_cast<float*>(&e.splat), load(reinterpret_cast<const float*>(&s)));
        const Lanes dy = row_centre - splat(s.centre_y);
        const Lanes v = splat(s.c) * dy;
        store(e.power_of_row, fnma(v, v, splat(s.power)));
        store(e.u_of_row, fnma(splat(s.a), splat(s.centre_x - left), splat(s.b) * dy));
    }
    for (int i = count; i % kLanes != 0; ++i) {
        store(reinterpret_cast<float*>(&chunk->entries[i].splat), zero());
        chunk->entries[i].splat.cutoff = -1.0f;
    }
    make_transparent(&chunk->entries[kChunk]);
}

// Four strips of the tile along one axis, as seen from 16 splats.
struct Strips {
    Lanes low[4], high[4];  // offsets from the centre to the first and last pixel of the strip
    Lanes nearest[4];       // the offset in low..high closest to the centre
};

RF_INLINE void measure_strips(Lanes centre, float origin, Strips* s) {
    for (int i = 0; i < 4; ++i) {
        s->low[i] = splat(origin + static_cast<float>(kBlockSide * i) + 0.5f) - centre;
        s->high[i] = splat(origin + static_cast<float>(kBlockSide * i) + 3.5f) - centre;
        s->nearest[i] = clamp(zero(), s->low[i], s->high[i]);
    }
}

// Exact minimum of u^2 + v^2 over each block (it lies on the edge nearest to the centre, vertical
// or horizontal) against the cutoff, for the 16 splats at `first`.
RF_INLINE void find_touching_16(const TileChunk& chunk, int first, float left, float top,
                                uint16_t touching[kBlocksPerTile]) {
    alignas(64) float rows[256];
    Lanes field[16];
    for (int i = 0; i < kLanes; ++i) {
        store(rows + 16 * i, load(reinterpret_cast<const float*>(&chunk.entries[first + i].splat)));
    }
    transpose(rows, field);
    const Lanes a = field[0], b = field[1], c = field[2], cutoff = field[12];
    Strips x, y;
    measure_strips(field[8], left, &x);
    measure_strips(field[9], top, &y);
    Lanes best_y[4], u_part[4];
    for (int j = 0; j < 4; ++j) {
        best_y[j] = field[13] * x.nearest[j];
        u_part[j] = a * x.nearest[j];
    }
    for (int i = 0; i < 4; ++i) {
        const Lanes best_x = field[14] * y.nearest[i];
        const Lanes shift = b * y.nearest[i];
        const Lanes v = c * y.nearest[i];
        const Lanes vv = v * v;
        for (int j = 0; j < 4; ++j) {
            const Lanes edge_y = clamp(best_y[j], y.low[i], y.high[i]);
            const Lanes u1 = fma(b, edge_y, u_part[j]), v1 = c * edge_y;
            const Lanes u2 = fma(a, clamp(best_x, x.low[j], x.high[j]), shift);
            const Lanes least = min(fma(u1, u1, v1 * v1), fma(u2, u2, vv));
            touching[4 * i + j] = static_cast<uint16_t>(bits(ge(cutoff, least)));
        }
    }
}

RF_INLINE void find_touching(int count, float left, float top, TileChunk* chunk) {
    for (int g = 0; g * kLanes < count; ++g) {
        uint16_t touching[kBlocksPerTile];
        find_touching_16(*chunk, g * kLanes, left, top, touching);
        for (int b = 0; b < kBlocksPerTile; ++b) chunk->touching[b][g] = touching[b];
    }
}

// List the splats touching block `b`, then transparent ones up to a multiple of `unroll`.
RF_INLINE int list_block(TileChunk* chunk, int b, int count, int unroll) {
    constexpr int kStep = static_cast<int>(sizeof(TileEntry));
    int listed = 0;
    for (int g = 0; g * kLanes < count; ++g) {
        listed += append_offsets(chunk->offsets + listed, chunk->touching[b][g],
                                 g * kLanes * kStep, kStep);
    }
    for (int i = 0; i < unroll - 1; ++i) {
        chunk->offsets[listed + i] = static_cast<uint16_t>(kChunk * kStep);
    }
    return (listed + unroll - 1) / unroll * unroll;
}

// log2(256 alpha) before clamping, for the block in row `block_row` of the tile.
RF_INLINE Lanes power_at(const TileEntry& e, Lanes x, int block_row) {
    const Lanes u = fma(splat(e.splat.a), x, load_repeated(e.u_of_row + kBlockSide * block_row));
    return fnma(u, u, load_repeated(e.power_of_row + kBlockSide * block_row));
}

}  // namespace

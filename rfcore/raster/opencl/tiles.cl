// Which 16x16 tiles a splat touches, as rfcore/csrc/raster/footprint.h, one splat a work-item.
#define TILE_SIDE 16
#define ROWS_OF_A_WINDOW 8  // tiles

typedef struct {
    int left, top, width;  // px
} Window;

// First (side -1) or last (side 1) column of pixels, relative to the window, that the ellipse
// touches in its `row`-th row of tiles; first > last where it touches none.
inline int row_end(const Splat* s, Window window, int row, float side) {
    const float to_centre = side < 0.0f ? 0.501f : 0.499f, least = side < 0.0f ? 0.0f : -1.0f;
    const float inverse_a = divide(1.0f, s->a);
    const float from_centre = (float)(TILE_SIDE * row) + ((float)window.top - s->centre_y);
    const float low = most_of(from_centre + 0.5f, negate(s->half_y));
    const float high = least_of(from_centre + 15.5f, s->half_y);
    const float dy = within((s->half_x * s->y_per_x) * side, low, high);
    const float v = s->c * dy;
    const float reach = square_root(most_of(fnma(v, v, s->cutoff), 0.0f));
    const float axis = fnma(s->b * inverse_a, dy, s->centre_x - (float)window.left);
    const float edge = fma(reach, inverse_a * side, axis);
    const float outwards = side * within(edge - to_centre, least, (float)window.width + least);
    return (int)(side * (outwards - above_floor(outwards)));
}

// Rows of tiles in which a splat is looked for.
inline int2 rows_of(const Splat* s, Box box, constant Camera* camera) {
    if (box.search != IN_WHOLE_ROWS) return (int2)(box.first_row, box.last_row);
    const float reach = s->half_y + 1.0f, last_y = (float)(camera->height - 1);
    const float low = s->centre_y - reach, high = least_of(s->centre_y + reach, last_y);
    const int group_side = GROUP_SIDE * TILE_SIDE;
    const int first = low > 0.0f ? (int)low / group_side : 0, last = (int)high / group_side;
    const int end = GROUP_SIDE * (first + (last - first) / 2 * 2) + ROWS_OF_A_WINDOW;
    const int tile_rows = (camera->height + TILE_SIDE - 1) / TILE_SIDE;
    return (int2)(GROUP_SIDE * first, min(end, tile_rows) - 1);
}

// First and last column of tiles in a row of them; first > last where there is none.
inline int2 columns_of(const Splat* s, Box box, constant Camera* camera, int first_row, int row) {
    if (box.search == EVERY_TILE_OF_THE_BOX) return (int2)(box.first_column, box.last_column);
    Window window = {0, TILE_SIDE * (row - (row - first_row) % ROWS_OF_A_WINDOW), camera->width};
    if (box.search == IN_ONE_WINDOW) {
        window.left = TILE_SIDE * GROUP_SIDE * (box.first_column / GROUP_SIDE);
        window.top = TILE_SIDE * GROUP_SIDE * (box.first_row / GROUP_SIDE);
        window.width = min(camera->width - window.left, TILE_SIDE * ROWS_OF_A_WINDOW);
    }
    const int row_of_window = row - window.top / TILE_SIDE;
    const int begin = row_end(s, window, row_of_window, -1.0f);
    const int end = row_end(s, window, row_of_window, 1.0f);
    if (end < begin) return (int2)(0, -1);
    return (int2)((window.left + begin) / TILE_SIDE, (window.left + end) / TILE_SIDE);
}

// How many columns of groups have a tile in the four rows of one row of groups.
inline uint groups_of(const int2* columns) {
    int first = INT_MAX, last = -1;
    for (int i = 0; i < GROUP_SIDE; ++i) {
        if (columns[i].y < columns[i].x) continue;
        first = min(first, columns[i].x / GROUP_SIDE);
        last = max(last, columns[i].y / GROUP_SIDE);
    }
    uint groups = 0;
    for (int group = first; group <= last; ++group) {
        bool is_touched = false;
        for (int i = 0; i < GROUP_SIDE; ++i) {
            is_touched |= columns[i].x <= columns[i].y && columns[i].x / GROUP_SIDE <= group
                          && group <= columns[i].y / GROUP_SIDE;
        }
        groups += is_touched;
    }
    return groups;
}

// Of the splats in `order` [visible]: how many tiles and groups of tiles each touches.
kernel void count_tiles(uint visible, constant Camera* camera, global const Splat* splats,
                        global const Box* boxes, global const uint* order, global uint* tile_counts,
                        global uint* group_counts) {
    const uint position = get_global_id(0);
    if (position >= visible) return;
    const Splat s = splats[order[position]];
    const Box box = boxes[order[position]];
    const int2 rows = rows_of(&s, box, camera);
    uint tiles = 0, groups = 0;
    int2 columns[GROUP_SIDE];
    for (int i = 0; i < GROUP_SIDE; ++i) columns[i] = (int2)(0, -1);
    for (int row = rows.x; row <= rows.y; ++row) {
        const int2 here = columns_of(&s, box, camera, rows.x, row);
        tiles += (uint)max(here.y - here.x + 1, 0);
        columns[row % GROUP_SIDE] = here;
        if (row % GROUP_SIDE == GROUP_SIDE - 1 || row == rows.y) {
            groups += groups_of(columns);
            for (int i = 0; i < GROUP_SIDE; ++i) columns[i] = (int2)(0, -1);
        }
    }
    tile_counts[position] = tiles;
    group_counts[position] = groups;
}

// Write tile and splat of every overlap, those of a splat from starts[position] on.
kernel void place_tiles(uint visible, constant Camera* camera, global const Splat* splats,
                        global const Box* boxes, global const uint* order,
                        global const uint* starts, global uint* tiles, global uint* ids) {
    const uint position = get_global_id(0);
    if (position >= visible) return;
    const uint id = order[position];
    const Splat s = splats[id];
    const Box box = boxes[id];
    const int2 rows = rows_of(&s, box, camera);
    const int tiles_x = (camera->width + TILE_SIDE - 1) / TILE_SIDE;
    uint at = starts[position];
    for (int row = rows.x; row <= rows.y; ++row) {
        const int2 columns = columns_of(&s, box, camera, rows.x, row);
        for (int column = columns.x; column <= columns.y; ++column) {
            tiles[at] = (uint)(row * tiles_x + column);
            ids[at++] = id;
        }
    }
}

// starts[t] [tiles + 1]: the first entry of tile t or, where it has none, of the next that has.
kernel void find_starts(uint entries, uint tiles, global const uint* sorted_tiles,
                        global uint* starts) {
    const uint at = get_global_id(0);
    if (at > entries) return;
    const uint here = at == entries ? tiles : sorted_tiles[at];
    const uint before = at == 0 ? 0 : sorted_tiles[at - 1] + 1;
    for (uint tile = before; tile <= here; ++tile) starts[tile] = at;
}

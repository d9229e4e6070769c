// Front-to-back blending as rfcore/csrc/raster/tile.h and blend_forward.h: a work-group a tile, a
// work-item a pixel, splats gathered into local memory a batch at a time.
#define BATCH 256
#define MIN_POWER 0.00564656f
#define MAX_ALPHA 0.99f
#define MIN_TRANSMITTANCE 1e-4f

typedef struct {
    float low[4], high[4], nearest[4];  // offsets of strips of four pixels from the centre
} Strips;

inline Strips strips_of(float origin, float centre) {
    Strips s;
    for (int i = 0; i < 4; ++i) {
        s.low[i] = origin + (float)(4 * i) + 0.5f - centre;
        s.high[i] = origin + (float)(4 * i) + 3.5f - centre;
        s.nearest[i] = within(0.0f, s.low[i], s.high[i]);
    }
    return s;
}

// Bit 4 i + j: the splat may colour the 4x4 block in row i and column j of the tile. It only saves
// time: outside, alpha is below 1/255.
inline uint touched_blocks(const Splat* s, float left, float top) {
    const Strips x = strips_of(left, s->centre_x), y = strips_of(top, s->centre_y);
    uint blocks = 0;
    for (int i = 0; i < 4; ++i) {
        const float best_x = s->x_per_y * y.nearest[i], v = s->c * y.nearest[i];
        for (int j = 0; j < 4; ++j) {
            const float edge_y = within(s->y_per_x * x.nearest[j], y.low[i], y.high[i]);
            const float edge_u = fma(s->b, edge_y, s->a * x.nearest[j]), edge_v = s->c * edge_y;
            const float edge_x = within(best_x, x.low[j], x.high[j]);
            const float u = fma(s->a, edge_x, s->b * y.nearest[i]);
            const float least = least_of(fma(edge_u, edge_u, edge_v * edge_v), fma(u, u, v * v));
            blocks |= (uint)(s->cutoff >= least) << (4 * i + j);
        }
    }
    return blocks;
}

kernel __attribute__((reqd_work_group_size(TILE_SIDE, TILE_SIDE, 1)))
void blend(constant Camera* camera, global const Splat* splats, global const uint* starts,
           global const uint* ids, global float* colour, global float* depth,
           global float* opacity, uint zero) {
    local float4 shape[BATCH];   // a, b, c, power
    local float2 centre[BATCH];
    local float4 light[BATCH];   // red, green, blue, depth
    local float surface[BATCH];
    local uint touched[BATCH];
    local uint any_lit;
    const int column = get_local_id(0), row = get_local_id(1), me = TILE_SIDE * row + column;
    const int pixel_x = get_global_id(0), pixel_y = get_global_id(1);
    const float left = (float)(TILE_SIDE * (int)get_group_id(0));
    const float top = (float)(TILE_SIDE * (int)get_group_id(1));
    const uint tile = (uint)(get_group_id(1) * get_num_groups(0) + get_group_id(0));
    const uint end = starts[tile + 1], block = 1u << (4 * (row / 4) + column / 4);
    const bool is_inside = pixel_x < camera->width && pixel_y < camera->height;
    const float x = (float)column + 0.5f, y = ((float)row + 0.5f) + top;
    float transmittance = 1.0f;
    float4 sum = (float4)(0.0f);  // red, green, blue, depth
    float weights = 0.0f;
    bool is_lit = is_inside;
    for (uint first = starts[tile]; first < end; first += BATCH) {
        if (me == 0) any_lit = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (is_lit) any_lit = 1;
        if (first + me < end) {
            const Splat s = splats[ids[first + me]];
            shape[me] = (float4)(s.a, s.b, s.c, s.power);
            centre[me] = (float2)(s.centre_x, s.centre_y);
            light[me] = (float4)(s.red, s.green, s.blue, s.depth);
            surface[me] = s.surface;
            touched[me] = touched_blocks(&s, left, top);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        const int count = any_lit ? (int)min(end - first, (uint)BATCH) : 0;
        for (int k = 0; k < count && is_lit; ++k) {
            if (!(touched[k] & block)) continue;
            const float dy = y - centre[k].y, v = shape[k].z * dy;
            const float power_of_row = fnma(v, v, shape[k].w);
            const float u_of_row = fnma(shape[k].x, centre[k].x - left, shape[k].y * dy);
            const float u = fma(shape[k].x, x, u_of_row);
            const float power = fnma(u, u, power_of_row);
            if (!(power >= MIN_POWER)) continue;
            const float alpha = least_of(alpha_from_log2(power), MAX_ALPHA);
            const float after = fnma(transmittance, alpha, transmittance);
            is_lit = after > MIN_TRANSMITTANCE;
            if (!is_lit) {
                transmittance = 0.0f;
                continue;
            }
            const float weight = PRODUCT(alpha, transmittance);
            sum = fma((float4)(weight), light[k], sum);
            weights = fma(weight, surface[k], weights);
            transmittance = after;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (!is_inside) return;
    const size_t at = (size_t)pixel_y * camera->width + pixel_x;
    vstore3(sum.xyz, at, colour);
    const float sky = (1.0f - transmittance) - weights;
    const bool is_sky = sky > weights;
    const float mean = weights > 0.0f ? divide(sum.w, weights) : 0.0f;
    opacity[at] = is_sky ? sky : weights;
    depth[at] = is_sky ? SKY_M : mean;
}

// From Gaussians to splats, as rfcore/csrc/raster/project.h, one Gaussian a work-item.
#define NEAR_M 0.01f
#define FAR_M 1e9f
#define SKY_M 1e4f
#define MAX_VARIANCE 1e18f
#define MAX_COLOUR 1e18f
#define DILATION 0.3f
#define MIN_DET_RATIO 1e-6f
#define FRUSTUM_MARGIN 0.3f
#define LOG2_255 7.99435344f
#define HALF_LOG2_E_ROOT 0.849321800288f
#define TWO_LN2 1.386294361f
#define CUTOFF_SCALE 1.00002f
#define CUTOFF_OFFSET 1e-5f
#define INVISIBLE 0xffffffffu  // as depth bits: above those of every finite depth
#define GROUP_SIDE 4           // tiles

typedef struct {
    float rotation[9];  // cam_from_world, row-major
    float position[3], position_rest[3];
    float fx, fy, cx, cy;
    int width, height;
} Camera;

typedef struct {
    float a, b, c, power;
    float red, green, blue, depth;
    float centre_x, centre_y, half_x, half_y;
    float cutoff, y_per_x, x_per_y, surface;
} Splat;

// Where the tiles of a splat are looked for. The arithmetic of its rows depends on the window they
// are measured in, so the windows are those of the CPU: 2x2 groups of tiles, or for what is larger
// the whole width, two rows of groups at a time.
enum Search { EVERY_TILE_OF_THE_BOX, IN_ONE_WINDOW, IN_WHOLE_ROWS };
typedef struct {
    short first_column, last_column, first_row, last_row;  // of the box, in tiles
    int search;
} Box;

// Root R S of the covariance and log2 of the opacity: prepared [10][count].
kernel void prepare(int count, global const float* quaternions, global const float* log_scales,
                    global const float* logits, global float* prepared, uint zero) {
    const int n = get_global_id(0);
    if (n >= count) return;
    float4 q = vload4(n, quaternions);
    const float longest = most_of(most_of(absolute(q.x), absolute(q.y)),
                                  most_of(absolute(q.z), absolute(q.w)));
    q *= longest > 1e15f ? 0x1p-66f : 1.0f;  // its square would overflow
    const float norm = square_root(fma(q.x, q.x, fma(q.y, q.y, fma(q.z, q.z, q.w * q.w))));
    q *= divide(1.0f, most_of(norm, 1e-12f));
    if (!(norm > 1e-12f)) q = (float4)(1.0f, 0.0f, 0.0f, 0.0f);
    const float w = q.x, x = q.y, y = q.z, z = q.w;
    const float xx = PRODUCT(x, x), yy = PRODUCT(y, y), zz = PRODUCT(z, z);
    const float xy = PRODUCT(x, y), xz = PRODUCT(x, z), yz = PRODUCT(y, z);
    const float wx = PRODUCT(w, x), wy = PRODUCT(w, y), wz = PRODUCT(w, z);
    const float rotation[9] = {1.0f - 2.0f * (yy + zz), 2.0f * (xy - wz), 2.0f * (xz + wy),
                               2.0f * (xy + wz), 1.0f - 2.0f * (xx + zz), 2.0f * (yz - wx),
                               2.0f * (xz - wy), 2.0f * (yz + wx), 1.0f - 2.0f * (xx + yy)};
    for (int axis = 0; axis < 3; ++axis) {
        const float scale = exp2_accurate(log_scales[3 * n + axis] * LOG2_E);
        for (int row = 0; row < 3; ++row) {
            prepared[(3 * row + axis) * count + n] = rotation[3 * row + axis] * scale;
        }
    }
    prepared[9 * count + n] = log2_accurate(sigmoid(logits[n]));
}

inline float3 row_of(constant float* matrix, int row) { return vload3(row, matrix); }

// (x[0] y, x[1] y, x[2] y) fused to z.
inline float3 times_plus(float x, float3 y, float3 z) {
    return (float3)(fma(x, y.x, z.x), fma(x, y.y, z.y), fma(x, y.z, z.z));
}

inline float3 cross_product(float3 p, float3 q) {
    return (float3)(fnma(p.z, q.y, p.y * q.z), fnma(p.x, q.z, p.z * q.x),
                    fnma(p.y, q.x, p.x * q.y));
}

// A slope of the line of sight, kept within the field of view and 30 % of its half beside it.
inline float clamped_slope(float slope, float focal, float centre, int side, uint zero) {
    const float half_view = divide(0.5f * (float)side, focal);
    const float margin = PRODUCT(FRUSTUM_MARGIN, half_view);
    const float high = divide((float)side - centre, focal) + margin;
    const float low = -(divide(centre, focal) + margin);
    return within(slope, low, high);
}

// Real spherical harmonics of the unit vector d, up to `degree` (simd/math.h).
inline void sh_basis(int degree, float3 d, float* basis, uint zero) {
    basis[0] = 0.28209479177387814f;
    if (degree < 1) return;
    basis[1] = -0.4886025119029199f * d.y;
    basis[2] = 0.4886025119029199f * d.z;
    basis[3] = -0.4886025119029199f * d.x;
    if (degree < 2) return;
    const float xx = PRODUCT(d.x, d.x), yy = PRODUCT(d.y, d.y), zz = PRODUCT(d.z, d.z);
    const float xy = d.x * d.y;
    basis[4] = 1.0925484305920792f * xy;
    basis[5] = -1.0925484305920792f * (d.y * d.z);
    basis[6] = 0.31539156525252005f * (2.0f * zz - xx - yy);
    basis[7] = -1.0925484305920792f * (d.x * d.z);
    basis[8] = 0.5462742152960396f * (xx - yy);
    if (degree < 3) return;
    const float f = 4.0f * zz - xx - yy;
    basis[9] = -0.5900435899266435f * d.y * (PRODUCT(3.0f, xx) - yy);
    basis[10] = 2.890611442640554f * xy * d.z;
    basis[11] = -0.4570457994644658f * d.y * f;
    basis[12] = 0.3731763325901154f * d.z
                * (2.0f * zz - PRODUCT(3.0f, xx) - PRODUCT(3.0f, yy));
    basis[13] = -0.4570457994644658f * d.x * f;
    basis[14] = 1.445305721320277f * d.z * (xx - yy);
    basis[15] = -0.5900435899266435f * d.x * (xx - PRODUCT(3.0f, yy));
}

inline float3 colour_of(int degree, float3 direction, global const float* sh, uint zero) {
    float basis[16];
    sh_basis(degree, direction, basis, zero);
    float3 colour = (float3)(0.5f, 0.5f, 0.5f);
    for (int k = 0; k < (degree + 1) * (degree + 1); ++k) {
        colour = times_plus(basis[k], vload3(k, sh), colour);
    }
    return (float3)(least_of(most_of(colour.x, 0.0f), MAX_COLOUR),
                    least_of(most_of(colour.y, 0.0f), MAX_COLOUR),
                    least_of(most_of(colour.z, 0.0f), MAX_COLOUR));
}

// In whole numbers what find_tiles of project.h computes in floats.
inline Box box_of(float x0, float x1, float y0, float y1) {
    Box box;
    box.first_column = (short)((int)x0 / 16);
    box.last_column = (short)((int)x1 / 16);
    box.first_row = (short)((int)y0 / 16);
    box.last_row = (short)((int)y1 / 16);
    const int across = box.last_column - box.first_column, down = box.last_row - box.first_row;
    const int right = box.last_column - box.first_column / GROUP_SIDE * GROUP_SIDE;
    const int bottom = box.last_row - box.first_row / GROUP_SIDE * GROUP_SIDE;
    const bool is_full = (across <= 1 && down <= 1) || across <= 0 || down <= 0;
    box.search = right > 7 || bottom > 7 ? IN_WHOLE_ROWS
                                         : is_full ? EVERY_TILE_OF_THE_BOX : IN_ONE_WINDOW;
    return box;
}

// depth_bits[n] is INVISIBLE for a Gaussian that colours no pixel; its splat and box are unset.
kernel void project(int count, int degree, int stored_coefficients, int antialiased,
                    constant Camera* camera, global const float* means,
                    global const float* prepared, global const float* sh, global Splat* splats,
                    global Box* boxes, global uint* depth_bits, uint zero) {
    const int n = get_global_id(0);
    if (n >= count) return;
    depth_bits[n] = INVISIBLE;
    const float3 offset = vload3(n, means) - row_of(camera->position, 0)
                          - row_of(camera->position_rest, 0);
    const float3 right = row_of(camera->rotation, 0), down = row_of(camera->rotation, 1);
    const float3 ahead = row_of(camera->rotation, 2);
    const float depth = dot3(ahead, offset);
    if (!(depth > NEAR_M)) return;

    const float inverse_z = divide(1.0f, depth);
    const float x = dot3(right, offset) * inverse_z, y = dot3(down, offset) * inverse_z;
    const float slope_x = clamped_slope(x, camera->fx, camera->cx, camera->width, zero);
    const float slope_y = clamped_slope(y, camera->fy, camera->cy, camera->height, zero);
    const float j00 = camera->fx * inverse_z, j11 = camera->fy * inverse_z;
    const float3 world_row0 = times_plus(j00, right, negate(j00 * slope_x) * ahead);
    const float3 world_row1 = times_plus(j11, down, negate(j11 * slope_y) * ahead);
    float m[2][3];  // J W R S
    for (int k = 0; k < 3; ++k) {
        const float3 column = (float3)(prepared[k * count + n], prepared[(3 + k) * count + n],
                                       prepared[(6 + k) * count + n]);
        m[0][k] = dot3(world_row0, column);
        m[1][k] = dot3(world_row1, column);
    }
    const float3 m0 = vload3(0, m[0]), m1 = vload3(0, m[1]);
    const float3 minors = cross_product(m0, m1);
    const float xx = dot3(m0, m0), yy = dot3(m1, m1), sharp_det = dot3(minors, minors);
    const float c_xx = xx + DILATION, c_yy = yy + DILATION, c_xy = dot3(m0, m1);
    const float det = fma(DILATION, xx + c_yy, sharp_det);
    const float centre_x = fma(camera->fx, x, camera->cx);
    const float centre_y = fma(camera->fy, y, camera->cy);

    float log2_alpha = prepared[9 * count + n];
    if (antialiased) {
        const float ratio = most_of(divide(sharp_det, det), MIN_DET_RATIO);
        log2_alpha = log2_alpha + 0.5f * log2_accurate(ratio);
    }
    const float headroom = log2_alpha + LOG2_255;
    const float reach = (TWO_LN2 * CUTOFF_SCALE) * most_of(headroom, 0.0f);
    const float half_x = square_root(reach * c_xx), half_y = square_root(reach * c_yy);

    const float x0 = centre_x - half_x - 0.5f, x1 = centre_x + half_x - 0.5f;
    const float y0 = centre_y - half_y - 0.5f, y1 = centre_y + half_y - 0.5f;
    const float last_x = (float)(camera->width - 1), last_y = (float)(camera->height - 1);
    const float left = round_up(most_of(x0, 0.0f)), top = round_up(most_of(y0, 0.0f));
    const float end_x = round_down(least_of(x1, last_x)), end_y = round_down(least_of(y1, last_y));
    const bool is_drawable = FAR_M >= depth && headroom > 0.0f && MAX_VARIANCE >= c_xx
                             && MAX_VARIANCE >= c_yy;
    const bool is_inside = x1 >= 0.0f && last_x >= x0 && y1 >= 0.0f && last_y >= y0
                           && end_x >= left && end_y >= top;
    if (!(is_drawable && is_inside)) return;

    const float inverse_distance = divide(1.0f, square_root(dot3(offset, offset)));
    const float3 colour = colour_of(degree, offset * inverse_distance,
                                    sh + 3 * (size_t)n * stored_coefficients, zero);
    const float b_over_a = negate(divide(c_xy, c_yy));
    const bool is_surface = SKY_M >= depth;
    Splat s;
    s.a = HALF_LOG2_E_ROOT * square_root(divide(c_yy, det));
    s.b = s.a * b_over_a;
    s.c = divide(HALF_LOG2_E_ROOT, square_root(c_yy));
    s.power = log2_alpha + 8.0f;
    s.red = colour.x;
    s.green = colour.y;
    s.blue = colour.z;
    s.depth = is_surface ? depth : 0.0f;
    s.centre_x = centre_x;
    s.centre_y = centre_y;
    s.half_x = half_x;
    s.half_y = half_y;
    s.cutoff = fma(headroom, CUTOFF_SCALE, CUTOFF_OFFSET);
    s.y_per_x = divide(negate(s.a * s.b), fma(s.b, s.b, s.c * s.c));
    s.x_per_y = negate(b_over_a);
    s.surface = is_surface ? 1.0f : 0.0f;
    splats[n] = s;
    boxes[n] = box_of(left, end_x, top, end_y);
    depth_bits[n] = as_uint(depth);
}

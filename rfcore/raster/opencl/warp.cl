// Warp and correction as rfcore/csrc/picture/warp.cpp; rfcore/native/warp.py defines them. Pictures
// are their planes Y, U, V one after the other.
#define STEPS 64  // positions per sample
#define TAPS 6
#define FILTER_PITCH 8
#define NOWHERE INT_MIN
#define NEAREST_M 0.1f
#define RELATIVE 0.08f
#define ABSOLUTE_M 0.1f

typedef struct {
    float rotation[9];  // from the present camera's axes into the earlier one's, row-major
    float translation[3];
    float fx, fy, cx, cy;
    int width, height;
} Warp;

inline float in_earlier_axes(constant Warp* warp, int axis, float far, float2 ray, uint zero) {
    constant float* row = warp->rotation + 3 * axis;
    const float along = PRODUCT(row[0], ray.x) + (PRODUCT(row[1], ray.y) + row[2]);
    return PRODUCT(far, along) + warp->translation[axis];
}

// Where each luma sample lies in the earlier picture, in 1/64 sample; NOWHERE if it does not, or
// another surface hid it: places [height][width].
kernel void locate(constant Warp* warp, global const float* earlier_depth,
                   global const float* depth, global int2* places, uint zero) {
    const int width = warp->width, height = warp->height, n = get_global_id(0);
    if (n >= width * height) return;
    places[n] = (int2)(NOWHERE, 0);
    const float far = depth[n];
    float2 ray;
    ray.x = divide((float)(n % width) + 0.5f - warp->cx, warp->fx);
    ray.y = divide((float)(n / width) + 0.5f - warp->cy, warp->fy);
    const float px = in_earlier_axes(warp, 0, far, ray, zero);
    const float py = in_earlier_axes(warp, 1, far, ray, zero);
    const float pz = in_earlier_axes(warp, 2, far, ray, zero);
    const float at_x = PRODUCT(warp->fx, divide(px, pz)) + warp->cx - 0.5f;
    const float at_y = PRODUCT(warp->fy, divide(py, pz)) + warp->cy - 0.5f;
    const bool is_inside = as_int(far) > 0 && pz > NEAREST_M  // by its bits: some flush subnormals
                           && at_x >= 0.0f && at_x <= (float)(width - 1)
                           && at_y >= 0.0f && at_y <= (float)(height - 1);
    if (!is_inside) return;
    const int u = (int)(PRODUCT(at_x, (float)STEPS) + 0.5f);
    const int v = (int)(PRODUCT(at_y, (float)STEPS) + 0.5f);
    const int nearest = ((v + STEPS / 2) >> 6) * width + ((u + STEPS / 2) >> 6);
    const bool is_same = fabs(earlier_depth[nearest] - pz) < PRODUCT(RELATIVE, pz) + ABSOLUTE_M;
    if (is_same) places[n] = (int2)(u, v);
}

// The earlier plane, or what it differs by, at a place, in 1/4096 level; its edge is repeated.
inline int filtered(global const uchar* previous, global const uchar* minus, int is_difference,
                    int width, int height, int2 place, constant short* filter) {
    constant short* across = filter + FILTER_PITCH * (place.x & (STEPS - 1));
    constant short* down = filter + FILTER_PITCH * (place.y & (STEPS - 1));
    const int left = (place.x >> 6) - 2, top = (place.y >> 6) - 2;
    int sum = 0;
    for (int j = 0; j < TAPS; ++j) {
        const int start = clamp(top + j, 0, height - 1) * width;
        int row = 0;
        for (int i = 0; i < TAPS; ++i) {
            const int at = start + clamp(left + i, 0, width - 1);
            row += across[i] * ((int)previous[at] - (is_difference ? (int)minus[at] : 0));
        }
        sum += down[j] * row;
    }
    return sum;
}

inline uchar sample_of(int sum, bool is_known, int is_difference, int doubt, int render) {
    const int most = doubt << 12;
    const int kept = sum - clamp(sum >> 2, -most, most);
    const int carried = ((kept + (1 << 11)) >> 12) + (is_difference ? render : 0);
    return (uchar)clamp(is_known ? carried : render, 1, 255);
}

// What `previous` shows or, for a difference, what it differs by from `minus`, less `doubt`, added to
// `render`: `out`.
kernel void carry_luma(constant Warp* warp, constant short* filter, global const int2* places,
                       global const uchar* previous, global const uchar* minus,
                       global const uchar* render, global uchar* out, int is_difference,
                       int doubt) {
    const int width = warp->width, height = warp->height, n = get_global_id(0);
    if (n >= width * height) return;
    const int2 place = places[n];
    const bool is_known = place.x != NOWHERE;
    const int sum = is_known ? filtered(previous, minus, is_difference, width, height, place,
                                        filter)
                             : 0;
    out[n] = sample_of(sum, is_known, is_difference, doubt, render[n]);
}

// The middle of four luma places: (mean - 1/2) / 2 in a direction where they are two apart, mean / 2
// where the last of an odd number stands for both.
inline int middle(int sum, bool is_pair) { return (sum - (is_pair ? 2 * STEPS : 0) + 4) >> 3; }

kernel void carry_chroma(constant Warp* warp, constant short* filter, global const int2* places,
                         global const uchar* previous, global const uchar* minus,
                         global const uchar* render, global uchar* out, int is_difference,
                         int doubt) {
    const int width = warp->width, height = warp->height;
    const int half_width = (width + 1) / 2, half_height = (height + 1) / 2, n = get_global_id(0);
    if (n >= half_width * half_height) return;
    const int left = 2 * (n % half_width), top = 2 * (n / half_width);
    const bool is_wide = left + 1 < width, is_tall = top + 1 < height;
    bool is_known = true;
    int2 sum = (int2)(0);
    for (int i = 0; i < 4; ++i) {
        const int x = left + (is_wide ? i & 1 : 0), y = top + (is_tall ? i >> 1 : 0);
        const int2 place = places[y * width + x];
        is_known = is_known && place.x != NOWHERE;
        sum += is_known ? place : (int2)(0);
    }
    const int2 place = (int2)(middle(sum.x, is_wide), middle(sum.y, is_tall));
    for (int plane = 0; plane < 2; ++plane) {
        const size_t start = (size_t)width * height + (size_t)plane * half_width * half_height;
        const int found = is_known ? filtered(previous + start, minus + start, is_difference,
                                              half_width, half_height, place, filter)
                                   : 0;
        out[start + n] = sample_of(found, is_known, is_difference, doubt, render[start + n]);
    }
}

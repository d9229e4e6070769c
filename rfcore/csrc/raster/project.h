// From Gaussians to splats: EWA projection (Zwicker et al. 2002), 16 Gaussians at a time.
//
// The projected covariance is M M^T + 0.3 I with M = J W R S (2x3). Its determinant is summed from
// the squared minors of M, none of them negative (Cauchy-Binet), because c_xx c_yy - c_xy^2 of a
// needle has no correct digit in float32.
#pragma once

#include "raster/footprint.h"
#include "simd/math.h"
#include "raster/types.h"

namespace {

using namespace rfcore::raster;

constexpr float kNear = 0.01f;          // m; centres not beyond this are not drawn
constexpr float kFar = 1e9f;            // m; nor those beyond this
constexpr float kMaxVariance = 1e18f;   // px^2; wider splats would overflow and are not drawn
constexpr float kMaxColour = 1e18f;     // keeps a picture finite whatever the coefficients
constexpr float kDilation = 0.3f;       // px^2
constexpr float kMinDetRatio = 1e-6f;   // under (1/255)^2: what it clamps is not drawn
constexpr float kFrustumMargin = 0.3f;  // of the half field of view
constexpr float kMinQuaternionNorm = 1e-12f;
constexpr float kLongQuaternion = 1e15f;
constexpr float kQuaternionShrink = 0x1p-66f;
constexpr float kLog2Of255 = 7.99435344f;
constexpr float kHalfLog2ERoot = 0.849321800288f;  // sqrt(log2(e) / 2)
constexpr float kTwoLn2 = 1.386294361f;
constexpr float kCutoffScale = 1.00002f;  // margins that make every culling test conservative
constexpr float kCutoffOffset = 1e-5f;

struct Vec3 {
    Lanes x, y, z;
};
RF_INLINE Lanes dot(Vec3 p, Vec3 q) { return fma(p.x, q.x, fma(p.y, q.y, p.z * q.z)); }
RF_INLINE Lanes dot(const float* row, Vec3 q) {
    return fma(splat(row[0]), q.x, fma(splat(row[1]), q.y, splat(row[2]) * q.z));
}
RF_INLINE Vec3 cross(Vec3 p, Vec3 q) {
    return {fnma(p.z, q.y, p.y * q.z), fnma(p.x, q.z, p.z * q.x), fnma(p.y, q.x, p.x * q.y)};
}
RF_INLINE const float* plane(const float* block, int index) { return block + index * kLanes; }
RF_INLINE float* plane(float* block, int index) { return block + index * kLanes; }
RF_INLINE Vec3 load_vec3(const float* block, int first) {
    return {load(plane(block, first)), load(plane(block, first + 1)),
            load(plane(block, first + 2))};
}

// Rotation, scales and their product R S (row-major), as training needs them again going back.
struct CovarianceRoot {
    Lanes rotation[9];
    Lanes scale[3];
    Lanes quaternion[4];   // normalised
    Lanes inverse_norm;
    Mask is_rotation;      // the quaternion was long enough to say which way
    Lanes root[9];
};

RF_INLINE void rotation_from(const Lanes* q, Lanes* r) {
    const Lanes one = splat(1.0f), two = splat(2.0f);
    const Lanes w = q[0], x = q[1], y = q[2], z = q[3];
    r[0] = one - two * (y * y + z * z);
    r[1] = two * (x * y - w * z);
    r[2] = two * (x * z + w * y);
    r[3] = two * (x * y + w * z);
    r[4] = one - two * (x * x + z * z);
    r[5] = two * (y * z - w * x);
    r[6] = two * (x * z - w * y);
    r[7] = two * (y * z + w * x);
    r[8] = one - two * (x * x + y * y);
}

// Normalise the quaternion; one shorter than 1e-12 says nothing and counts as no rotation. The
// square of a long one would overflow.
RF_INLINE void normalise(const float* block, CovarianceRoot* c) {
    Lanes q[4];
    for (int k = 0; k < 4; ++k) q[k] = load(plane(block, kQuaternionPlane + k));
    const Lanes longest = max(max(absolute(q[0]), absolute(q[1])),
                              max(absolute(q[2]), absolute(q[3])));
    const Lanes shrink =
        select(gt(longest, splat(kLongQuaternion)), splat(kQuaternionShrink), splat(1.0f));
    for (int k = 0; k < 4; ++k) q[k] = q[k] * shrink;
    const Lanes norm = sqrt(fma(q[0], q[0], fma(q[1], q[1], fma(q[2], q[2], q[3] * q[3]))));
    c->is_rotation = gt(norm, splat(kMinQuaternionNorm));
    const Lanes inverse = splat(1.0f) / max(norm, splat(kMinQuaternionNorm));
    c->inverse_norm = inverse * shrink;
    for (int k = 0; k < 4; ++k) c->quaternion[k] = keep(c->is_rotation, q[k] * inverse);
    c->quaternion[0] = select(c->is_rotation, c->quaternion[0], splat(1.0f));
}

RF_INLINE void covariance_root(const float* block, CovarianceRoot* c) {
    for (int k = 0; k < 3; ++k) {
        c->scale[k] = exp2_accurate(load(plane(block, kScalePlane + k)) * splat(kLog2E));
    }
    normalise(block, c);
    rotation_from(c->quaternion, c->rotation);
    for (int i = 0; i < 9; ++i) c->root[i] = c->rotation[i] * c->scale[i % 3];
}

RF_INLINE Lanes log2_opacity(const float* block) {
    return log2_accurate(sigmoid(load(plane(block, kLogitPlane))));
}

static void prepare(const float* parameters, int planes, float* geometry, int begin, int end) {
    for (int b = begin; b < end; ++b) {
        const float* block = parameters + static_cast<size_t>(b) * planes * kLanes;
        float* out = geometry + static_cast<size_t>(b) * kGeometryPlanes * kLanes;
        CovarianceRoot c;
        covariance_root(block, &c);
        for (int k = 0; k < 3; ++k) store(plane(out, k), load(plane(block, kMeanPlane + k)));
        for (int k = 0; k < 9; ++k) store(plane(out, kRootPlane + k), c.root[k]);
        store(plane(out, kLog2OpacityPlane), log2_opacity(block));
    }
}

struct Projection {
    Vec3 in_camera;
    Lanes inverse_z;
    Lanes slope_x, slope_y;        // of the point of linearisation, clamped
    Mask free_x, free_y;           // the slope was not clamped
    Lanes j00, j02, j11, j12;      // the non-zero entries of J
    Vec3 world_row0, world_row1;   // J W
    Vec3 m0, m1;                   // J W R S
    Lanes c_xx, c_xy, c_yy, det;   // dilated covariance
    Vec3 minors;                   // 2x2 minors of M
    Lanes sharp_det;               // det M M^T, before dilation
    Lanes centre_x, centre_y;
};

// From the camera's position to the mean, in world axes. Subtracting before anything is rotated,
// from a position of twice the digits, keeps a scene sharp a thousand kilometres from its origin.
RF_INLINE Vec3 offset_from(const Camera& camera, Vec3 mean) {
    const float *high = camera.position, *rest = camera.position_rest;
    return {mean.x - splat(high[0]) - splat(rest[0]), mean.y - splat(high[1]) - splat(rest[1]),
            mean.z - splat(high[2]) - splat(rest[2])};
}

RF_INLINE Vec3 to_camera(const Camera& camera, Vec3 offset) {
    const float* r = camera.rotation;
    return {dot(r, offset), dot(r + 3, offset), dot(r + 6, offset)};
}

RF_INLINE Lanes clamped_slope(Lanes slope, float focal, float centre, int side, Mask* is_free) {
    const float half = 0.5f * static_cast<float>(side) / focal;
    const Lanes high =
        splat((static_cast<float>(side) - centre) / focal + kFrustumMargin * half);
    const Lanes low = splat(-(centre / focal + kFrustumMargin * half));
    *is_free = both(ge(high, slope), ge(slope, low));
    return clamp(slope, low, high);
}

RF_INLINE Vec3 row_times(Vec3 row, const Lanes* matrix) {
    const Lanes* m = matrix;
    return {fma(row.x, m[0], fma(row.y, m[3], row.z * m[6])),
            fma(row.x, m[1], fma(row.y, m[4], row.z * m[7])),
            fma(row.x, m[2], fma(row.y, m[5], row.z * m[8]))};
}

// Row i of J W: diagonal entry of J on row i of W plus the entry in its third column on row 2.
RF_INLINE Vec3 jacobian_row(const float* w, int i, Lanes diagonal, Lanes third) {
    return {fma(diagonal, splat(w[3 * i]), third * splat(w[6])),
            fma(diagonal, splat(w[3 * i + 1]), third * splat(w[7])),
            fma(diagonal, splat(w[3 * i + 2]), third * splat(w[8]))};
}

// Fill everything of `p` behind in_camera.
RF_INLINE void project_covariance(const Camera& camera, const Lanes* root, Projection* p) {
    p->inverse_z = splat(1.0f) / p->in_camera.z;
    const Lanes x = p->in_camera.x * p->inverse_z, y = p->in_camera.y * p->inverse_z;
    p->slope_x = clamped_slope(x, camera.fx, camera.cx, camera.width, &p->free_x);
    p->slope_y = clamped_slope(y, camera.fy, camera.cy, camera.height, &p->free_y);
    p->j00 = splat(camera.fx) * p->inverse_z;
    p->j11 = splat(camera.fy) * p->inverse_z;
    p->j02 = negate(p->j00 * p->slope_x);
    p->j12 = negate(p->j11 * p->slope_y);
    p->world_row0 = jacobian_row(camera.rotation, 0, p->j00, p->j02);
    p->world_row1 = jacobian_row(camera.rotation, 1, p->j11, p->j12);
    p->m0 = row_times(p->world_row0, root);
    p->m1 = row_times(p->world_row1, root);
    const Lanes xx = dot(p->m0, p->m0), yy = dot(p->m1, p->m1);
    p->minors = cross(p->m0, p->m1);
    p->sharp_det = dot(p->minors, p->minors);
    p->c_xx = xx + splat(kDilation);
    p->c_yy = yy + splat(kDilation);
    p->c_xy = dot(p->m0, p->m1);
    p->det = fma(splat(kDilation), xx + p->c_yy, p->sharp_det);
    p->centre_x = fma(splat(camera.fx), x, splat(camera.cx));
    p->centre_y = fma(splat(camera.fy), y, splat(camera.cy));
}

// log2 of what keeps the light of a splat when dilation widens it: sqrt(det M M^T / det), 1e-3 at
// least (Mip-Splatting, Yu et al. 2024, eq. 9, at a filter of 0.3 px^2).
RF_INLINE Lanes log2_compensation(const Projection& p) {
    return splat(0.5f) * log2_accurate(max(p.sharp_det / p.det, splat(kMinDetRatio)));
}

// Unit vector along `d`, and one over its length.
RF_INLINE Vec3 direction_of(Vec3 d, Lanes* inverse_distance) {
    *inverse_distance = splat(1.0f) / sqrt(dot(d, d));
    return {d.x * *inverse_distance, d.y * *inverse_distance, d.z * *inverse_distance};
}

// SH(direction) + 0.5 before clamping, [3].
template <int kDegree>
RF_INLINE void sh_colour(const float* harmonics, const Lanes* basis, Lanes* colour) {
    for (int c = 0; c < 3; ++c) colour[c] = splat(0.5f);
    for (int k = 0; k < coefficients_of(kDegree); ++k) {
        for (int c = 0; c < 3; ++c) {
            colour[c] = fma(basis[k], load(plane(harmonics, 3 * k + c)), colour[c]);
        }
    }
}

struct Box {
    Lanes x0, x1, y0, y1;  // first and last pixel of a splat, whole numbers within the picture
};

RF_INLINE Lanes round_down(Lanes a) { return a - above_floor(a); }
RF_INLINE Lanes round_up(Lanes a) { return a + above_floor(negate(a)); }

// Which lanes can colour a pixel; every comparison is false for a value that is not a number.
RF_INLINE Mask find_visible(const Camera& camera, const Projection& p, Lanes headroom, Lanes half_x,
                            Lanes half_y, Box* box) {
    const Lanes half = splat(0.5f);
    const Lanes x0 = p.centre_x - half_x - half, x1 = p.centre_x + half_x - half;
    const Lanes y0 = p.centre_y - half_y - half, y1 = p.centre_y + half_y - half;
    const Lanes last_x = splat(static_cast<float>(camera.width - 1));
    const Lanes last_y = splat(static_cast<float>(camera.height - 1));
    box->x0 = round_up(max(x0, zero()));
    box->y0 = round_up(max(y0, zero()));
    box->x1 = round_down(min(x1, last_x));
    box->y1 = round_down(min(y1, last_y));
    Mask m = both(gt(p.in_camera.z, splat(kNear)), ge(splat(kFar), p.in_camera.z));
    m = both(m, gt(headroom, zero()));
    m = both(m, both(ge(splat(kMaxVariance), p.c_xx), ge(splat(kMaxVariance), p.c_yy)));
    m = both(m, both(ge(x1, zero()), ge(last_x, x0)));
    m = both(m, both(ge(y1, zero()), ge(last_y, y0)));
    return both(m, both(ge(box->x1, box->x0), ge(box->y1, box->y0)));
}

RF_INLINE void make_splats(const Projection& p, Lanes log2_alpha, Lanes headroom, Lanes half_x,
                           Lanes half_y, const Lanes* colour, Lanes* splats) {
    const Lanes a = splat(kHalfLog2ERoot) * sqrt(p.c_yy / p.det);
    const Lanes b_over_a = negate(p.c_xy / p.c_yy);
    const Lanes b = a * b_over_a;
    const Lanes c = splat(kHalfLog2ERoot) / sqrt(p.c_yy);
    const Lanes limit = splat(kMaxColour);
    const Mask is_surface = ge(splat(kSkyM), p.in_camera.z);
    alignas(64) float rows[16 * 16];
    store(rows, a);
    store(rows + 16, b);
    store(rows + 32, c);
    store(rows + 48, log2_alpha + splat(kAlphaBits));
    for (int k = 0; k < 3; ++k) store(rows + 64 + 16 * k, min(max(colour[k], zero()), limit));
    store(rows + 112, keep(is_surface, p.in_camera.z));
    store(rows + 128, p.centre_x);
    store(rows + 144, p.centre_y);
    store(rows + 160, half_x);
    store(rows + 176, half_y);
    store(rows + 192, fma(headroom, splat(kCutoffScale), splat(kCutoffOffset)));
    store(rows + 208, negate(a * b) / fma(b, b, c * c));
    store(rows + 224, negate(b_over_a));
    store(rows + 240, keep(is_surface, splat(1.0f)));
    transpose(rows, splats);
}

// Where 16 boxes lie among the groups of tiles; whole numbers.
struct BoxTiles {
    alignas(64) float column[16], row[16];       // of the upper left group
    alignas(64) float columns[16];               // of tiles, a bit each
    alignas(64) float first_row[16], rows[16];   // of tiles, the first relative to the group
    uint32_t is_large;                           // it does not fit in 2x2 groups
    uint32_t is_exact;                           // at most 2x2 tiles, or one row or column
};

RF_INLINE void find_tiles(const Box& box, BoxTiles* t) {
    const Lanes one = splat(1.0f), four = splat(4.0f), per_tile = splat(1.0f / kTileSide);
    const Lanes x0 = round_down(box.x0 * per_tile), x1 = round_down(box.x1 * per_tile);
    const Lanes y0 = round_down(box.y0 * per_tile), y1 = round_down(box.y1 * per_tile);
    const Lanes column = round_down(x0 * splat(0.25f)), row = round_down(y0 * splat(0.25f));
    const Lanes left = fnma(four, column, x0), right = fnma(four, column, x1);
    const Lanes top = fnma(four, row, y0), bottom = fnma(four, row, y1);
    const Lanes across = x1 - x0, down = y1 - y0;
    store(t->column, column);
    store(t->row, row);
    store(t->columns, times_exp2_floor(one, right + one) - times_exp2_floor(one, left));
    store(t->first_row, top);
    store(t->rows, down + one);
    t->is_large = 0xffffu & ~bits(both(ge(splat(7.0f), right), ge(splat(7.0f), bottom)));
    t->is_exact = bits(both(ge(one, across), ge(one, down))) | bits(ge(zero(), across)) |
                  bits(ge(zero(), down));
}

RF_INLINE Footprint footprint_of(const Camera& camera, const BoxTiles& t, int lane,
                                 const Splat& splat) {
    const uint16_t column = static_cast<uint16_t>(static_cast<int>(t.column[lane]));
    const uint16_t row = static_cast<uint16_t>(static_cast<int>(t.row[lane]));
    if (t.is_large >> lane & 1) return {kLargeFootprint, row, 0, 0};
    const int first = static_cast<int>(t.first_row[lane]), rows = static_cast<int>(t.rows[lane]);
    uint64_t in_rows = ~uint64_t{0} >> (64 - 8 * rows) << (8 * first);
    if (t.is_exact >> lane & 1) {
        const uint64_t columns = static_cast<uint64_t>(static_cast<int>(t.columns[lane]));
        in_rows &= columns * 0x0101010101010101u;
    } else {
        in_rows &= ellipse_tiles(camera, splat, column * kGroupSide, row * kGroupSide);
    }
    return {column, row, static_cast<uint32_t>(in_rows), static_cast<uint32_t>(in_rows >> 32)};
}

// Append the visible of 16 splats to the results of `job` at `first`; return how many.
RF_INLINE int append_visible(const ProjectJob& job, uint32_t visible, uint32_t first,
                             const Lanes* splats, Lanes depth, const Box& box) {
    alignas(64) float z[16];
    BoxTiles tiles;
    store(z, depth);
    find_tiles(box, &tiles);
    uint32_t next = first;
    for (int i = 0; i < kLanes; ++i) {  // an invisible one is overwritten
        store(reinterpret_cast<float*>(job.splats + next), splats[i]);
        next += visible >> i & 1;
    }
    next = first;
    for (uint32_t left = visible; left != 0; left &= left - 1) {
        const int i = __builtin_ctz(left);
        memcpy(&job.items[next].depth_bits, &z[i], sizeof z[i]);
        job.items[next].splat = next;
        job.footprints[next] = footprint_of(*job.camera, tiles, i, job.splats[next]);
        ++next;
    }
    return static_cast<int>(next - first);
}

// Fetch the first planes of a block. The hardware's own prefetching starts anew on every page, so
// for almost every block of coefficients.
template <int kPlanes>
RF_INLINE void prefetch_planes(const float* block) {
    for (int k = 0; k < kPlanes; ++k) __builtin_prefetch(plane(block, k));
}

template <int kDegree, bool kTraining, bool kAntialiased>
static Projected project(const ProjectJob& job, int begin, int end) {
    const Camera& camera = *job.camera;
    const int sh_planes = 3 * coefficients_of(job.stored_degree);
    uint32_t next = static_cast<uint32_t>(begin * kLanes);
    Lanes nearest = splat(kFar), farthest = splat(kNear);
    for (int b = begin; b < end; ++b) {
        if (kTraining) job.block_splats[b] = {next, 0};
        const float* block =
            kTraining ? job.parameters + static_cast<size_t>(b) * (kShPlane + sh_planes) * kLanes
                      : job.geometry + static_cast<size_t>(b) * kGeometryPlanes * kLanes;
        const Vec3 offset = offset_from(camera, load_vec3(block, kMeanPlane));
        Projection p;
        p.in_camera = to_camera(camera, offset);
        if (!any(gt(p.in_camera.z, splat(kNear)))) continue;
        Lanes log2_alpha;
        if (kTraining) {
            CovarianceRoot c;
            covariance_root(block, &c);
            log2_alpha = log2_opacity(block);
            project_covariance(camera, c.root, &p);
        } else {
            Lanes root[9];
            for (int k = 0; k < 9; ++k) root[k] = load(plane(block, kRootPlane + k));
            log2_alpha = load(plane(block, kLog2OpacityPlane));
            project_covariance(camera, root, &p);
        }
        if (kAntialiased) log2_alpha = log2_alpha + log2_compensation(p);
        const Lanes headroom = log2_alpha + splat(kLog2Of255);
        const Lanes reach = splat(kTwoLn2 * kCutoffScale) * max(headroom, zero());
        const Lanes half_x = sqrt(reach * p.c_xx), half_y = sqrt(reach * p.c_yy);
        Box box;
        const Mask is_visible = find_visible(camera, p, headroom, half_x, half_y, &box);
        const uint32_t visible = bits(is_visible);
        if (visible == 0) continue;
        nearest = min(nearest, select(is_visible, p.in_camera.z, nearest));
        farthest = max(farthest, select(is_visible, p.in_camera.z, farthest));
        const float* harmonics =
            kTraining ? plane(block, kShPlane)
                      : job.harmonics + static_cast<size_t>(b) * sh_planes * kLanes;
        prefetch_planes<3 * coefficients_of(kDegree)>(  // of the next block: likely visible too
            harmonics + (kTraining ? kShPlane + sh_planes : sh_planes) * kLanes);
        Lanes inverse_distance, basis[coefficients_of(kDegree)], colour[3], splats[kLanes];
        const Vec3 d = direction_of(offset, &inverse_distance);
        sh_basis<kDegree>(d.x, d.y, d.z, basis);
        sh_colour<kDegree>(harmonics, basis, colour);
        make_splats(p, log2_alpha, headroom, half_x, half_y, colour, splats);
        if (kTraining) job.block_splats[b].lanes = visible;
        next += append_visible(job, visible, next, splats, p.in_camera.z, box);
    }
    alignas(64) float least[16], most[16];
    store(least, nearest);
    store(most, farthest);
    for (int i = 1; i < kLanes; ++i) {
        least[0] = least[i] < least[0] ? least[i] : least[0];
        most[0] = most[i] > most[0] ? most[i] : most[0];
    }
    return {static_cast<int>(next) - begin * kLanes, least[0], most[0]};
}

}  // namespace

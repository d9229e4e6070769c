// From gradients of splats to gradients of parameters, and the Adam step, 16 Gaussians at a time.
//
// Notation: M = J W R S as in project.h, and d_q stands for dL/dq. Only Gaussians
// that were visible move (sparse Adam); a gradient that is not a number or beyond 1e15 counts as 0.
#pragma once

#include "raster/project.h"

namespace {

constexpr float kMaxGradient = 1e15f;  // its square stays finite

// Sums over the entries of 16 Gaussians, and the quantities the backward pass starts from.
struct SplatGradient {
    Lanes s, su, sv, suu, suv, svv, colour[3];
};

// Fetch what gather_entries will read soon: the entries of the block after next, whose positions
// were fetched two blocks ago. Both are scattered over megabytes.
RF_INLINE void prefetch_entries(const ProjectBackwardJob& job, int block, int end) {
    if (block + 4 < end) __builtin_prefetch(&job.ranges[job.block_splats[block + 4].first]);
    if (block + 3 < end) {
        const BlockSplats splats = job.block_splats[block + 3];
        for (uint32_t i = 0; i < static_cast<uint32_t>(__builtin_popcount(splats.lanes)); ++i) {
            __builtin_prefetch(&job.positions[job.ranges[splats.first + i].begin]);
        }
    }
    if (block + 2 < end) {
        const BlockSplats splats = job.block_splats[block + 2];
        for (uint32_t i = 0; i < static_cast<uint32_t>(__builtin_popcount(splats.lanes)); ++i) {
            const EntryRange range = job.ranges[splats.first + i];
            for (uint32_t e = range.begin; e < range.end; ++e) {
                __builtin_prefetch(&job.entry_gradients[job.positions[e]]);
            }
        }
    }
}

// Add up entries in the order of the groups.
RF_INLINE void gather_entries(const ProjectBackwardJob& job, const BlockSplats& splats,
                              SplatGradient* g) {
    alignas(64) float rows[256];
    const EntryRange* range = job.ranges + splats.first;
    for (int i = 0; i < kLanes; ++i) {
        Lanes sum = zero();
        if (splats.lanes >> i & 1) {
            for (uint32_t e = range->begin; e < range->end; ++e) {
                sum = sum + load(reinterpret_cast<const float*>(
                                &job.entry_gradients[job.positions[e]]));
            }
            ++range;
        }
        store(rows + 16 * i, sum);
    }
    Lanes field[16];
    transpose(rows, field);
    g->s = field[0];
    g->su = field[1];
    g->sv = field[2];
    g->suu = field[3];
    g->suv = field[4];
    g->svv = field[5];
    for (int c = 0; c < 3; ++c) g->colour[c] = field[6 + c];
}

RF_INLINE Vec3 combine(Lanes p, Vec3 a, Lanes q, Vec3 b) {
    return {fma(p, a.x, q * b.x), fma(p, a.y, q * b.y), fma(p, a.z, q * b.z)};
}

RF_INLINE Vec3 matrix_times(const Lanes* m, Vec3 v) {
    return {fma(m[0], v.x, fma(m[1], v.y, m[2] * v.z)),
            fma(m[3], v.x, fma(m[4], v.y, m[5] * v.z)),
            fma(m[6], v.x, fma(m[7], v.y, m[8] * v.z))};
}

// Through the pinhole and its linearisation: gradient of the position in the camera.
RF_INLINE Vec3 d_in_camera(const Camera& camera, const Projection& p, Lanes d_centre_x,
                           Lanes d_centre_y, Vec3 d_row0, Vec3 d_row1) {
    const float* w = camera.rotation;
    const Lanes d_j00 = dot(w, d_row0), d_j02 = dot(w + 6, d_row0);
    const Lanes d_j11 = dot(w + 3, d_row1), d_j12 = dot(w + 6, d_row1);
    const Lanes fx = splat(camera.fx), fy = splat(camera.fy), rz = p.inverse_z, rz2 = rz * rz;
    const Lanes shift_x = fx * rz2 * d_j02, shift_y = fy * rz2 * d_j12;
    const Lanes along_x = shift_x * p.slope_x, along_y = shift_y * p.slope_y;
    Vec3 d;
    d.x = fx * rz * d_centre_x - keep(p.free_x, shift_x);
    d.y = fy * rz * d_centre_y - keep(p.free_y, shift_y);
    d.z = negate(rz2 * fma(fx * p.in_camera.x, d_centre_x, fy * p.in_camera.y * d_centre_y));
    d.z = d.z - rz2 * fma(fx, d_j00, fy * d_j11);
    // A free slope x / z brings a second 1 / z, a clamped one does not.
    d.z = d.z + along_x + keep(p.free_x, along_x) + along_y + keep(p.free_y, along_y);
    return d;
}

// The columns of J W R in the splat's own coordinates, z_k = L u_k, where (u, v) = L d.
struct Whitened {
    Lanes a, b, c;  // L = (a b; 0 c)
    Vec3 u, v;      // of the three columns
    Vec3 scale;
};

// L u_k = (a (u0 + u1 b / a), c u1) cancels for a needle; with the minors of J W R nothing does.
RF_INLINE Whitened whiten(const CovarianceRoot& r, const Projection& p) {
    Whitened w;
    const Lanes root = splat(kHalfLog2ERoot);
    w.a = root * sqrt(p.c_yy / p.det);
    w.b = negate(w.a * (p.c_xy / p.c_yy));
    w.c = root / sqrt(p.c_yy);
    w.scale = {r.scale[0], r.scale[1], r.scale[2]};
    const Vec3 u0 = row_times(p.world_row0, r.rotation), u1 = row_times(p.world_row1, r.rotation);
    const Vec3 spread = {r.scale[0] * r.scale[0] * u1.x, r.scale[1] * r.scale[1] * u1.y,
                         r.scale[2] * r.scale[2] * u1.z};
    const Vec3 across = cross(spread, cross(u0, u1));
    const Lanes a_over_yy = w.a / p.c_yy, dilation = splat(kDilation);
    w.u = {a_over_yy * fma(dilation, u0.x, across.x), a_over_yy * fma(dilation, u0.y, across.y),
           a_over_yy * fma(dilation, u0.z, across.z)};
    w.v = {w.c * u1.x, w.c * u1.y, w.c * u1.z};
    return w;
}

// Gradients of M, of the logarithms of the scales, and of a rotation about the splat's own axes.
struct RootGradient {
    Vec3 m0, m1, log_scale, turn;
};

RF_INLINE Vec3 times(Vec3 p, Vec3 q) { return {p.x * q.x, p.y * q.y, p.z * q.z}; }
RF_INLINE Vec3 plus(Vec3 p, Vec3 q) { return {p.x + q.x, p.y + q.y, p.z + q.z}; }
RF_INLINE Vec3 scaled(Lanes f, Vec3 p) { return {f * p.x, f * p.y, f * p.z}; }
RF_INLINE Vec3 rotated(Vec3 p) { return {p.y, p.z, p.x}; }

// From P, the second moments in (u, v), with tau = 2 ln 2: dL/dM = tau^2 L^T P z S,
// dL/d(ln s_k) = tau^2 s_k^2 z_k P z_k and dL/d(turn about axis k) = tau^2 (s_i^2 - s_j^2) z_i P z_j,
// i and j the axes after k.
RF_INLINE RootGradient d_root_of(const Whitened& w, const SplatGradient& g) {
    const Lanes tau2 = splat(kTwoLn2 * kTwoLn2);
    const Vec3 pu = scaled(tau2, combine(g.suu, w.u, g.suv, w.v));
    const Vec3 pv = scaled(tau2, combine(g.suv, w.u, g.svv, w.v));
    RootGradient d;
    d.m0 = times(w.scale, scaled(w.a, pu));
    d.m1 = times(w.scale, combine(w.b, pu, w.c, pv));
    d.log_scale = times(times(w.scale, w.scale), plus(times(w.u, pu), times(w.v, pv)));
    const Vec3 s1 = rotated(w.scale), s2 = rotated(s1);
    const Vec3 difference = {(s1.x - s2.x) * (s1.x + s2.x), (s1.y - s2.y) * (s1.y + s2.y),
                             (s1.z - s2.z) * (s1.z + s2.z)};
    const Vec3 u1 = rotated(w.u), v1 = rotated(w.v);
    d.turn = times(difference, plus(times(u1, rotated(rotated(pu))), times(v1, rotated(rotated(pv)))));
    return d;
}

// Quaternion q moves along q (0, turn) / 2; one that is no rotation does not move.
RF_INLINE void store_d_quaternion(const CovarianceRoot& c, Vec3 turn, float* out) {
    const Lanes *q = c.quaternion, w = q[0], x = q[1], y = q[2], z = q[3];
    const Lanes d[4] = {negate(fma(x, turn.x, fma(y, turn.y, z * turn.z))),
                        fma(w, turn.x, fnma(z, turn.y, y * turn.z)),
                        fma(z, turn.x, fma(w, turn.y, negate(x * turn.z))),
                        fma(x, turn.y, fnma(y, turn.x, w * turn.z))};
    const Lanes factor = splat(2.0f) * c.inverse_norm;
    for (int k = 0; k < 4; ++k) {
        store(plane(out, kQuaternionPlane + k), keep(c.is_rotation, factor * d[k]));
    }
}

// Gradient of sum_k f[k] Y_k(x, y, z) with respect to the unit vector.
template <int kDegree>
RF_INLINE Vec3 d_sh_basis(Lanes x, Lanes y, Lanes z, const Lanes* f) {
    const Lanes c1 = splat(kSh1), two = splat(2.0f);
    Vec3 d = {negate(c1 * f[3]), negate(c1 * f[1]), c1 * f[2]};
    if (kDegree > 1) {
        const Lanes a = splat(kSh2[0]), b6 = splat(kSh2[2]) * f[6], b8 = splat(2 * kSh2[4]) * f[8];
        d.x = d.x + a * (y * f[4] - z * f[7]) - two * x * b6 + x * b8;
        d.y = d.y + a * (x * f[4] - z * f[5]) - two * y * b6 - y * b8;
        d.z = d.z - a * (y * f[5] + x * f[7]) + splat(4.0f) * z * b6;
    }
    if (kDegree > 2) {
        const Lanes three = splat(3.0f), four = splat(4.0f), six = splat(6.0f);
        const Lanes xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
        Lanes k[7];
        for (int i = 0; i < 7; ++i) k[i] = splat(kSh3[i]) * f[9 + i];
        d.x = d.x + k[0] * six * xy + k[1] * yz - k[2] * two * xy - k[3] * six * xz +
              k[4] * (four * zz - three * xx - yy) + k[5] * two * xz +
              k[6] * three * (xx - yy);
        d.y = d.y + k[0] * three * (xx - yy) + k[1] * xz + k[2] * (four * zz - xx - three * yy) -
              k[3] * six * yz - k[4] * two * xy - k[5] * two * yz - k[6] * six * xy;
        d.z = d.z + k[1] * xy + k[2] * splat(8.0f) * yz +
              k[3] * (six * zz - three * xx - three * yy) + k[4] * splat(8.0f) * xz +
              k[5] * (xx - yy);
    }
    return d;
}

// Through the colour: gradients of the coefficients (written to `out`) and of the mean (returned).
template <int kDegree>
RF_INLINE Vec3 d_colour(const float* block, Vec3 offset, const Lanes* d_rgb, float* out) {
    constexpr int kCoefficients = coefficients_of(kDegree);
    const float* harmonics = plane(block, kShPlane);
    Lanes inverse_distance, basis[kCoefficients], colour[3], along[kCoefficients];
    const Vec3 v = direction_of(offset, &inverse_distance);
    sh_basis<kDegree>(v.x, v.y, v.z, basis);
    sh_colour<kDegree>(harmonics, basis, colour);
    Lanes d[3];
    for (int c = 0; c < 3; ++c) d[c] = keep(gt(colour[c], zero()), d_rgb[c]);
    for (int k = 0; k < kCoefficients; ++k) {
        for (int c = 0; c < 3; ++c) store(plane(out, kShPlane + 3 * k + c), basis[k] * d[c]);
        along[k] = fma(d[0], load(plane(harmonics, 3 * k)),
                       fma(d[1], load(plane(harmonics, 3 * k + 1)),
                           d[2] * load(plane(harmonics, 3 * k + 2))));
    }
    if (kDegree == 0) return {zero(), zero(), zero()};
    const Vec3 u = d_sh_basis<kDegree>(v.x, v.y, v.z, along);
    const Lanes radial = dot(u, v);
    return {inverse_distance * fnma(v.x, radial, u.x), inverse_distance * fnma(v.y, radial, u.y),
            inverse_distance * fnma(v.z, radial, u.z)};
}

// Gradient of s ln sqrt(det0 / det) by the rows of M, added to `d`: det0 = |minors|^2 moves along
// m1 x minors, and 1 / det0 - 1 / det = 0.3 trace / (det0 det) has nothing to cancel.
RF_INLINE void add_d_compensation(const CovarianceRoot& c, const Projection& p, Lanes s,
                                  RootGradient* d) {
    const Lanes inverse = splat(kDilation) / p.det;
    const Lanes trace = p.c_xx + p.c_yy - splat(kDilation);
    const Lanes along = s * (inverse * trace / p.sharp_det), back = negate(s * inverse);
    const Vec3 by_m0 = combine(along, cross(p.m1, p.minors), back, p.m0);
    const Vec3 by_m1 = combine(along, cross(p.minors, p.m0), back, p.m1);
    d->m0 = plus(d->m0, by_m0);
    d->m1 = plus(d->m1, by_m1);
    d->log_scale = plus(d->log_scale, plus(times(p.m0, by_m0), times(p.m1, by_m1)));
    const Vec3 u0 = row_times(p.world_row0, c.rotation), u1 = row_times(p.world_row1, c.rotation);
    const Vec3 scale = {c.scale[0], c.scale[1], c.scale[2]};
    const Vec3 r0 = times(scale, by_m0), r1 = times(scale, by_m1);
    d->turn = plus(d->turn, plus(cross(r0, u0), cross(r1, u1)));
}

// Gradients of the parameters of one block into `out`, [planes][16]; return that of the centre.
template <int kDegree, bool kAntialiased>
RF_INLINE Lanes block_gradient(const Camera& camera, const float* block, const SplatGradient& g,
                               float* out) {
    const Vec3 offset = offset_from(camera, load_vec3(block, kMeanPlane));
    CovarianceRoot c;
    covariance_root(block, &c);
    Projection p;
    p.in_camera = to_camera(camera, offset);
    project_covariance(camera, c.root, &p);
    const Whitened w = whiten(c, p);
    const Lanes tau = splat(kTwoLn2);
    const Lanes d_centre_x = tau * (w.a * g.su), d_centre_y = tau * fma(w.b, g.su, w.c * g.sv);
    RootGradient d = d_root_of(w, g);
    if (kAntialiased) add_d_compensation(c, p, g.s, &d);
    const Vec3 d_row0 = matrix_times(c.root, d.m0), d_row1 = matrix_times(c.root, d.m1);
    const Vec3 d_cam = d_in_camera(camera, p, d_centre_x, d_centre_y, d_row0, d_row1);
    store(plane(out, kScalePlane), d.log_scale.x);
    store(plane(out, kScalePlane + 1), d.log_scale.y);
    store(plane(out, kScalePlane + 2), d.log_scale.z);
    store_d_quaternion(c, d.turn, out);
    const Lanes logit = load(plane(block, kLogitPlane));
    store(plane(out, kLogitPlane), g.s * sigmoid(negate(logit)));  // 1 - sigmoid would cancel
    const Vec3 d_mean = d_colour<kDegree>(block, offset, g.colour, out);
    const float* r = camera.rotation;
    const Lanes by_view[3] = {d_mean.x, d_mean.y, d_mean.z};
    for (int j = 0; j < 3; ++j) {
        const float column[3] = {r[j], r[3 + j], r[6 + j]};
        store(plane(out, kMeanPlane + j), dot(column, d_cam) + by_view[j]);
    }
    return sqrt(fma(d_centre_x, d_centre_x, d_centre_y * d_centre_y));
}

// A usable gradient: 0 where the Gaussian is not visible, or the value is not.
RF_INLINE Lanes usable(Mask visible, Lanes gradient) {
    return keep(both(visible, ge(splat(kMaxGradient), absolute(gradient))), gradient);
}

// Gradients of what AdamStep adds to the loss, onto those of the picture.
RF_INLINE void add_regularisation(const AdamStep& step, const float* block, float* gradient) {
    const Lanes opacity = sigmoid(load(plane(block, kLogitPlane)));
    float* logit = plane(gradient, kLogitPlane);
    store(logit, fma(splat(step.opacity_pull) * opacity, splat(1.0f) - opacity, load(logit)));
    for (int k = kScalePlane; k < kScalePlane + 3; ++k) {
        const Lanes scale = exp2_accurate(load(plane(block, k)) * splat(kLog2E));
        store(plane(gradient, k), fma(splat(step.scale_pull), scale, load(plane(gradient, k))));
    }
}

RF_INLINE void add_score(Mask visible, Lanes centre_gradient, float* scores) {
    float *gradient = plane(scores, kGradientPlane), *visits = plane(scores, kVisitsPlane);
    store(gradient, load(gradient) + usable(visible, centre_gradient));
    store(visits, load(visits) + keep(visible, splat(1.0f)));
}

RF_INLINE void adam_plane(const AdamStep& step, int index, Mask visible, Lanes gradient,
                          size_t offset, float* parameters) {
    float* first = step.first_moments + offset;
    float* second = step.second_moments + offset;
    const Lanes one = splat(1.0f), beta1 = splat(step.beta1), beta2 = splat(step.beta2);
    const Lanes m = fma(beta1, load(first), (one - beta1) * gradient);
    const Lanes v = fma(beta2, load(second), (one - beta2) * (gradient * gradient));
    const Lanes root = sqrt(v * splat(step.second_correction)) + splat(step.epsilon);
    store_where(first, visible, m);
    store_where(second, visible, v);
    store_where(parameters, visible,
                fnma(splat(step.rate[index]), m / root, load(parameters)));
}

template <int kDegree, bool kAntialiased>
static void project_backward(const ProjectBackwardJob& job, int begin, int end) {
    constexpr int kPlanes = parameter_planes(kDegree);
    const size_t stride = static_cast<size_t>(parameter_planes(job.stored_degree)) * kLanes;
    for (int b = begin; b < end; ++b) {
        SplatGradient g;
        prefetch_entries(job, b, end);
        if (job.block_splats[b].lanes == 0) continue;
        gather_entries(job, job.block_splats[b], &g);
        const Mask visible = mask_from_bits(job.block_splats[b].lanes);
        const size_t offset = static_cast<size_t>(b) * stride;
        alignas(64) float gradient[kPlanes * kLanes];
        const Lanes centre = block_gradient<kDegree, kAntialiased>(
            *job.camera, job.parameters + offset, g, gradient);
        if (job.scores != nullptr) {
            add_score(visible, centre, job.scores + static_cast<size_t>(b) * kScorePlanes * kLanes);
        }
        if (job.adam != nullptr && job.adam->opacity_pull + job.adam->scale_pull > 0.0f) {
            add_regularisation(*job.adam, job.parameters + offset, gradient);
        }
        for (int k = 0; k < kPlanes; ++k) {
            const Lanes value = usable(visible, load(plane(gradient, k)));
            const size_t at = offset + static_cast<size_t>(k) * kLanes;
            if (job.gradients != nullptr) store(job.gradients + at, value);
            if (job.adam != nullptr) {
                adam_plane(*job.adam, k, visible, value, at, job.parameters + at);
            }
        }
    }
}

}  // namespace

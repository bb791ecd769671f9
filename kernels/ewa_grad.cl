// The gradient of EWA projection: turns gradients with respect to the projected values into gradients with respect to
// the Gaussians and the camera.
//
// Owner: A work-item owns LANES Gaussians.
// Launch: One work-item for each LANES Gaussians, in groups of 64; work-items past the end do nothing.
// Buffers: ewa.cl's inputs except opacities; radii (n, 2).
//   d_means2d (n, 2), d_depths (n), d_conics (n, 3), where b counts as one variable; with COMPENSATED d_compensations
//     (n).
//   -> d_means (n, 3); d_quaternions (n, 4) and d_scales (n, 3), or with COVARIANCES d_covariances (n, 6), where an
//     off-diagonal entry holds the sum for its two places in the matrix. Culled rows become zero. ADDED adds the
//     gradients to the values in these arrays, and leaves culled rows unchanged.
//   by_camera (BY_CAMERA_SIZE, padded), with BY_CAMERA: each Gaussian's gradient with respect to the view matrix's
//     rotation row by row, its translation, fx, fy, cx and cy, in this order; zero from n on.
// Equations: docs/gradients.md, (159) to (166), with (58) to (60).
#include "shared/math.h"
#define NEEDS_GRADIENT
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/ewa.h"

#ifdef ADDED
#define PUT(array, index, value) (array)[index] += (value)
#else
#define PUT(array, index, value) (array)[index] = (value)
#endif
#define STORE_BY_CAMERA(name, index, value)                                                                            \
  STOREL(shown.all ? (value) : (floatL)(0.0f), by_camera + (size_t)(BY_CAMERA_##name + (index)) * padded + first_row)

static inline void cross(const floatL *a, const floatL *b, floatL *result) {
  result[0] = fmaL(a[1], b[2], -(a[2] * b[1]));
  result[1] = fmaL(a[2], b[0], -(a[0] * b[2]));
  result[2] = fmaL(a[0], b[1], -(a[1] * b[0]));
}

__kernel void ewa_grad(const uint n, const uint padded, __constant float *camera, __global const float *means,
                       EWA_SHAPES, __global const int *radii, __global const float *d_means2d,
                       __global const float *d_depths, __global const float *d_conics,
#ifdef COMPENSATED
                       __global const float *d_compensations,
#endif
                       __global float *d_means,
#ifdef COVARIANCES
                       __global float *d_covariances
#else
                       __global float *d_quaternions, __global float *d_scales
#endif
#ifdef BY_CAMERA
                       ,
                       __global float *by_camera
#endif
) {
  const uint first_row = get_global_id(0) * LANES;
  if (first_row >= padded) return;
  uint row[LANES];
  IntLanes shown;
  for (uint lane = 0; lane < LANES; ++lane) {
    row[lane] = first_row + lane < n ? first_row + lane : n - 1;
    shown.lane[lane] = first_row + lane < n && radii[2 * row[lane]] > 0 ? -1 : 0;
  }
  Ellipse2 p;
  if (!ANYL(shown.all) || !project_ellipses(row, means, EWA_SHAPES_GIVEN, camera, &p)) {
#ifndef ADDED
    for (size_t i = first_row; i < min(first_row + LANES, n); ++i) {
      for (int k = 0; k < 3; ++k) d_means[3 * i + k] = 0.0f;
#ifdef COVARIANCES
      for (int k = 0; k < 6; ++k) d_covariances[6 * i + k] = 0.0f;
#else
      for (int k = 0; k < 4; ++k) d_quaternions[4 * i + k] = 0.0f;
      for (int k = 0; k < 3; ++k) d_scales[3 * i + k] = 0.0f;
#endif
    }
#endif
#ifdef BY_CAMERA
    for (uint k = 0; k < BY_CAMERA_SIZE; ++k) STOREL((floatL)(0.0f), by_camera + (size_t)k * padded + first_row);
#endif
    return;
  }

  // Equation (159) of docs/gradients.md: twice the gradient with respect to the whitened covariance.
  const floatL l11 = sqrt(p.syy / p.det), l12 = -(p.sxy / p.syy) * l11, l22 = 1.0f / sqrt(p.syy);
  const floatL ga = GATHER(d_conics, 3, 0), gb = 0.5f * GATHER(d_conics, 3, 1), gc = GATHER(d_conics, 3, 2);
  const floatL g_u = fmaL(ga, l11, gb * l12), g_v = fmaL(gb, l11, gc * l12);
  floatL uu = -2.0f * fmaL(l11, g_u, l12 * g_v), uv = -2.0f * (l22 * g_v), vv = -2.0f * (l22 * l22 * gc);
#ifdef COMPENSATED // equation (160) of docs/gradients.md
  const floatL thinner =
      p.det0 > LEAST_DETERMINANT ? GATHER(d_compensations, 1, 0) * compensation2(&p) : (floatL)(0.0f);
  const floatL by_det0 = p.det0 > LEAST_DETERMINANT ? thinner / p.det0 : (floatL)(0.0f);
  uu -= thinner;
  vv -= thinner;
  floatL d_n[3];
#endif
  floatL d_t1[3], d_t2[3], d_size = (floatL)(0.0f);
  const floatL lean = l11 / p.syy;

#ifdef COVARIANCES // equations (163), (164) of docs/gradients.md
  Lanes d_v[6];
  floatL wu[3], wv[3], gu[3], gv[3], hu[3], hv[3];
  cross(p.v2, p.n, wu);
  FOR_AXES(k) {
    wu[k] = lean * fmaL((floatL)(camera[EWA_EPS]), p.t1[k], wu[k]);
    wv[k] = l22 * p.t2[k];
    gu[k] = fmaL(uu, wu[k], uv * wv[k]);
    gv[k] = fmaL(uv, wu[k], vv * wv[k]);
  }
  symmetric_times(p.v, gu, hu);
  symmetric_times(p.v, gv, hv);
  d_size = dotL(wu, hu) + dotL(wv, hv);
  FOR_AXES(k) {
    d_t1[k] = l11 * hu[k];
    d_t2[k] = fmaL(l12, hu[k], l22 * hv[k]);
  }
  d_v[0].all = 0.5f * fmaL(wu[0], gu[0], wv[0] * gv[0]);
  d_v[3].all = 0.5f * fmaL(wu[1], gu[1], wv[1] * gv[1]);
  d_v[5].all = 0.5f * fmaL(wu[2], gu[2], wv[2] * gv[2]);
  d_v[1].all = fmaL(wu[0], gu[1], wv[0] * gv[1]);
  d_v[2].all = fmaL(wu[0], gu[2], wv[0] * gv[2]);
  d_v[4].all = fmaL(wu[1], gu[2], wv[1] * gv[2]);
#ifdef COMPENSATED
  symmetric_times(p.adj, p.n, d_n);
  FOR_AXES(k) d_n[k] *= by_det0;
  const floatL half_by = 0.5f * by_det0, n0 = p.n[0], n1 = p.n[1], n2 = p.n[2];
  d_v[0].all += half_by * fmaL(n1 * n1, p.v[5], fmaL(n2 * n2, p.v[3], -2.0f * (n1 * n2) * p.v[4]));
  d_v[3].all += half_by * fmaL(n0 * n0, p.v[5], fmaL(n2 * n2, p.v[0], -2.0f * (n0 * n2) * p.v[2]));
  d_v[5].all += half_by * fmaL(n0 * n0, p.v[3], fmaL(n1 * n1, p.v[0], -2.0f * (n0 * n1) * p.v[1]));
  d_v[1].all += by_det0 * (n2 * fmaL(n1, p.v[2], fmaL(n0, p.v[4], -(n2 * p.v[1]))) - n0 * n1 * p.v[5]);
  d_v[2].all += by_det0 * (n1 * fmaL(n0, p.v[4], fmaL(n2, p.v[1], -(n1 * p.v[2]))) - n0 * n2 * p.v[3]);
  d_v[4].all += by_det0 * (n0 * fmaL(n1, p.v[2], fmaL(n2, p.v[1], -(n0 * p.v[4]))) - n1 * n2 * p.v[0]);
#endif
#else // equations (58) to (60), (161), (162) of docs/gradients.md
  Lanes d_scale[3], d_quaternion[4];
  floatL wu[3], wv[3], turned[3];
  FOR_AXES(k) {
    const int l = (k + 1) % 3, m = (k + 2) % 3;
    const floatL minors = fmaL(p.s[l] * p.b2[l], p.s[l] * p.c[m], -(p.s[m] * p.b2[m] * (p.s[m] * p.c[l])));
    wu[k] = lean * fmaL((floatL)(camera[EWA_EPS]), p.b1[k], minors);
    wv[k] = l22 * p.b2[k];
    d_t1[k] = d_t2[k] = (floatL)(0.0f);
#ifdef COMPENSATED
    d_n[k] = (floatL)(0.0f);
#endif
  }
  FOR_AXES(k) {
    const int l = (k + 1) % 3, m = (k + 2) % 3;
    const floatL tu = fmaL(uu, wu[k], uv * wv[k]), tv = fmaL(uv, wu[k], vv * wv[k]); // not yet times the scale
    const floatL along = fmaL(wu[k], tu, wv[k] * tv), variance = p.s[k] * p.s[k];
    d_scale[k].all = p.s[k] * along;
    d_size = fmaL(variance, along, d_size);
    const floatL by_row1 = variance * (l11 * tu), by_row2 = variance * fmaL(l12, tu, l22 * tv);
    FOR_AXES(i) {
      d_t1[i] = fmaL(by_row1, p.r[3 * i + k], d_t1[i]);
      d_t2[i] = fmaL(by_row2, p.r[3 * i + k], d_t2[i]);
    }
    const floatL apart = (p.s[l] - p.s[m]) * (p.s[l] + p.s[m]);
    turned[k] = apart * fmaL(fmaL(uu, wu[l], uv * wv[l]), wu[m], fmaL(uv, wu[l], vv * wv[l]) * wv[m]);
#ifdef COMPENSATED
    const floatL area = p.s[l] * p.s[m], other_l = p.s[m] * p.c[l], other_m = p.s[l] * p.c[m];
    d_scale[k].all = fmaL(by_det0 * p.s[k], fmaL(other_l, other_l, other_m * other_m), d_scale[k].all);
    turned[k] = fmaL(-(by_det0 * variance), apart * (p.c[l] * p.c[m]), turned[k]);
    const floatL lever = by_det0 * (area * area * p.c[k]);
    FOR_AXES(i) d_n[i] = fmaL(lever, p.r[3 * i + k], d_n[i]);
#endif
  }
  const floatL turn = 2.0f / p.length;
  d_quaternion[0].all = turn * -fmaL(p.q[1], turned[0], fmaL(p.q[2], turned[1], p.q[3] * turned[2]));
  d_quaternion[1].all = turn * fmaL(p.q[0], turned[0], fmaL(p.q[2], turned[2], -(p.q[3] * turned[1])));
  d_quaternion[2].all = turn * fmaL(p.q[0], turned[1], fmaL(p.q[3], turned[0], -(p.q[1] * turned[2])));
  d_quaternion[3].all = turn * fmaL(p.q[0], turned[2], fmaL(p.q[1], turned[1], -(p.q[2] * turned[0])));
#endif

#ifdef COMPENSATED
  floatL by_area[3];
  cross(p.t2, d_n, by_area);
  FOR_AXES(k) d_t1[k] += by_area[k];
  cross(d_n, p.t1, by_area);
  FOR_AXES(k) d_t2[k] += by_area[k];
  d_size = fmaL((floatL)(2.0f), thinner, d_size);
#endif

  // Equations (165), (166) of docs/gradients.md: the gradient with respect to the mean in the camera's axes, through
  // its image position, the Jacobian and its depth.
  const floatL d_u = GATHER(d_means2d, 2, 0), d_v2 = GATHER(d_means2d, 2, 1);
  floatL d_x, d_y, d_z;
#ifdef FISHEYE
  floatL by_j1[3], by_j2[3];
  FOR_AXES(i) {
    by_j1[i] = camera[EWA_FX] * dot_row(d_t1, camera + EWA_R00 + 3 * i);
    by_j2[i] = camera[EWA_FY] * dot_row(d_t2, camera + EWA_R00 + 3 * i);
  }
  const floatL g_x = camera[EWA_FX] * d_u, g_y = camera[EWA_FY] * d_v2, mixed = by_j1[1] + by_j2[0];
  const floatL by_away = by_j1[0] + by_j2[1] + fmaL(p.x, g_x, p.y * g_y);
  const floatL by_bend = fmaL(by_j1[0] * p.x, p.x, fmaL(mixed * p.x, p.y, by_j2[1] * p.y * p.y));
  const floatL by_inverse = fmaL(by_j1[2], p.x, by_j2[2] * p.y) * (p.inverse * p.inverse);
  const floatL outwards = fmaL(by_away, p.bend, fmaL(by_bend, p.bend2, 2.0f * by_inverse));
  d_x = fmaL(p.away, g_x, fmaL(p.bend, fmaL(2.0f * p.x, by_j1[0], p.y * mixed), -(by_j1[2] * p.inverse))) +
        p.x * outwards;
  d_y = fmaL(p.away, g_y, fmaL(p.bend, fmaL(2.0f * p.y, by_j2[1], p.x * mixed), -(by_j2[2] * p.inverse))) +
        p.y * outwards;
  d_z = -(by_away * p.inverse) + 2.0f * fmaL(by_bend * p.inverse, p.inverse, p.z * by_inverse);
#else
  const floatL at[3] = {p.x, p.y, p.z}, limited[2] = {p.rx, p.ry};
  const floatL by_j02 = dot_row(d_t1, camera + EWA_R20), by_j12 = dot_row(d_t2, camera + EWA_R20);
  floatL by_mean[3], beyond[2];
  mean_gradient(at, limited, p.jx, p.jy, d_u, d_v2, by_j02, by_j12, d_size, by_mean, beyond);
  d_x = by_mean[0], d_y = by_mean[1], d_z = by_mean[2];
#endif
  d_z += GATHER(d_depths, 1, 0);

  Lanes d_mean[3];
  FOR_AXES(k)
  d_mean[k].all =
      fmaL(d_x, (floatL)(camera[EWA_R00 + k]), fmaL(d_y, (floatL)(camera[EWA_R10 + k]), d_z * camera[EWA_R20 + k]));
  for (uint lane = 0; lane < LANES; ++lane) {
    const size_t i = first_row + lane;
    if (i >= n) break;
#ifdef ADDED
    if (!shown.lane[lane]) continue;
#endif
    const int seen = shown.lane[lane];
    for (int k = 0; k < 3; ++k) PUT(d_means, 3 * i + k, seen ? d_mean[k].lane[lane] : 0.0f);
#ifdef COVARIANCES
    for (int k = 0; k < 6; ++k) PUT(d_covariances, 6 * i + k, seen ? d_v[k].lane[lane] : 0.0f);
#else
    for (int k = 0; k < 4; ++k) PUT(d_quaternions, 4 * i + k, seen ? d_quaternion[k].lane[lane] : 0.0f);
    for (int k = 0; k < 3; ++k) PUT(d_scales, 3 * i + k, seen ? d_scale[k].lane[lane] : 0.0f);
#endif
  }

#ifdef BY_CAMERA
  const floatL mean[3] = {GATHER(means, 3, 0), GATHER(means, 3, 1), GATHER(means, 3, 2)};
  FOR_AXES(k) {
#ifdef FISHEYE
    const floatL by_row0 = fmaL(p.j1[0], d_t1[k], p.j2[0] * d_t2[k]);
    const floatL by_row1 = fmaL(p.j1[1], d_t1[k], p.j2[1] * d_t2[k]);
    const floatL by_row2 = fmaL(p.j1[2], d_t1[k], p.j2[2] * d_t2[k]);
#else
    const floatL by_row0 = p.jx * d_t1[k], by_row1 = p.jy * d_t2[k];
    const floatL by_row2 = -fmaL(p.rx, by_row0, p.ry * by_row1);
#endif
    STORE_BY_CAMERA(R00, k, fmaL(d_x, mean[k], by_row0));
    STORE_BY_CAMERA(R10, k, fmaL(d_y, mean[k], by_row1));
    STORE_BY_CAMERA(R20, k, fmaL(d_z, mean[k], by_row2));
  }
  STORE_BY_CAMERA(T0, 0, d_x);
  STORE_BY_CAMERA(T1, 0, d_y);
  STORE_BY_CAMERA(T2, 0, d_z);
  floatL d_fx = dotL(d_t1, p.t1) / camera[EWA_FX], d_fy = dotL(d_t2, p.t2) / camera[EWA_FY], d_cx = d_u, d_cy = d_v2;
#ifdef FISHEYE
  d_fx = fmaL(p.x * p.away, d_u, d_fx);
  d_fy = fmaL(p.y * p.away, d_v2, d_fy);
#elif defined(PARALLEL_RAYS)
  d_fx = fmaL(p.x, d_u, d_fx);
  d_fy = fmaL(p.y, d_v2, d_fy);
#else // the limit at which the Jacobian is clamped is a position on the image, which moves with the principal point
  d_fx = fmaL(p.x / p.z, d_u, fmaL(p.rx, beyond[0], d_fx));
  d_fy = fmaL(p.y / p.z, d_v2, fmaL(p.ry, beyond[1], d_fy));
  d_cx += beyond[0];
  d_cy += beyond[1];
#endif
  STORE_BY_CAMERA(FX, 0, d_fx);
  STORE_BY_CAMERA(FY, 0, d_fy);
  STORE_BY_CAMERA(CX, 0, d_cx);
  STORE_BY_CAMERA(CY, 0, d_cy);
#endif
}

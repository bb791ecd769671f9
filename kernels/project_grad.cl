// The gradient of projection: sums a Gaussian's slots in the order of its tiles, then the chain rule back to its
// parameters.
//
// Owner: A work-item owns LANES Gaussians, of which it leaves those that are not visible; in add_slots one.
// Launch: One work-item for each LANES Gaussians, or for each one, in groups of 64; those beyond the last do nothing.
// Buffers: slots (pairs, SLOT_STRIDE) of blend_grad.cl, or with ADDED_UP their sums by Gaussian (n, SLOT_STRIDE);
//   tile_counts, first_slots (n): its scan; the parameters, splats and camera as in project.cl -> gradients of the
//   parameters, of the same shapes, in loss per unit of each; rows of Gaussians that are not visible are left as they
//   are. screen (n, 2): of the mean on the image, per pixel, plain or absolute. With CONTRIBUTIONS contributions (n):
//   what each adds to the image, sums of its blending weights over all pixels.
// Equations: docs/gradients.md, (25) to (41) in the forms (50), (52) and (58) to (61); (55).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/splat.h"
#include "shared/gaussian.h"
#include "shared/sh.h"

// Sums that band after band of tiles goes on with: tile_counts, first_slots (n), slots (pairs) of one band
// -> sums (n, SLOT_STRIDE). From the first band to the last these are the additions that project_grad makes by itself.
__kernel void add_slots(const uint n, __global const uint *tile_counts, __global const uint *first_slots,
                        __global const float *slots, __global float *sums) {
  const uint i = get_global_id(0);
  if (i >= n) return;
  const uint count = tile_counts[i];
  if (count == 0) return;
  __global const float *slot = slots + (size_t)SLOT_STRIDE * first_slots[i];
  float own[SLOT_STRIDE];
  for (int field = 0; field < SLOT_STRIDE; ++field) own[field] = sums[(size_t)SLOT_STRIDE * i + field];
  for (uint k = 0; k < count; ++k, slot += SLOT_STRIDE)
    for (int field = 0; field < SLOT_STRIDE; ++field) own[field] += slot[field];
  for (int field = 0; field < SLOT_STRIDE; ++field) sums[(size_t)SLOT_STRIDE * i + field] = own[field];
}

// s1 - s2, their logarithms `x` apart: near each other by the series of exp(x) - 1, as what rounding leaves of two
// equal scales' difference would turn every ball.
static inline floatL scale_difference(floatL x, floatL s1, floatL s2) {
  floatL series = fmaL(x, (floatL)(1.0f / 720.0f), (floatL)(1.0f / 120.0f));
  series = fmaL(x, series, (floatL)(1.0f / 24.0f));
  series = fmaL(x, series, (floatL)(1.0f / 6.0f));
  series = fmaL(x, series, (floatL)(0.5f));
  series = fmaL(x * x, series, x) * s2;
  return x * x < 0.0625f ? series : s1 - s2;
}

__kernel void project_grad(const uint n, const int coefficients, __constant float *camera,
                           __global const uint *tile_counts, __global const uint *first_slots,
                           __global const float *slots, __global const float *splats, __global const float *means,
                           __global const float *quaternions, __global const float *log_scales,
                           __global const float *opacity_logits, __global const float *sh_dc,
                           __global const float *sh_rest, __global float *d_means, __global float *d_quaternions,
                           __global float *d_log_scales, __global float *d_opacity_logits, __global float *d_sh_dc,
                           __global float *d_sh_rest, __global float *screen
#ifdef CONTRIBUTIONS
                           ,
                           __global float *contributions
#endif
) {
  ROWS_OF_ITEM(n)
  Lanes m[SLOT_STRIDE];
  int any = 0;
  for (int field = 0; field < SLOT_STRIDE; ++field) m[field].all = (floatL)(0.0f);
  Lanes whitening[3]; // nobody has written the splats of Gaussians that are not visible
  for (int k = 0; k < 3; ++k) whitening[k].all = (floatL)(0.0f);
  for (uint lane = 0; lane < lanes_used; ++lane) {
    const uint count = tile_counts[first_row + lane];
    if (count == 0) continue;
    any = 1;
#ifdef ADDED_UP
    __global const float *slot = slots + (size_t)SLOT_STRIDE * (first_row + lane);
    const uint addends = 1;
#else
    __global const float *slot = slots + (size_t)SLOT_STRIDE * first_slots[first_row + lane];
    const uint addends = count;
#endif
    float sums[SLOT_STRIDE];
    for (int field = 0; field < SLOT_STRIDE; ++field) sums[field] = 0.0f;
    for (uint k = 0; k < addends; ++k, slot += SLOT_STRIDE)
      for (int field = 0; field < SLOT_STRIDE; ++field) sums[field] += slot[field];
    for (int field = 0; field < SLOT_STRIDE; ++field) m[field].lane[lane] = sums[field];
    __global const float *splat = splats + (size_t)SPLAT_SIZE * (first_row + lane);
    whitening[0].lane[lane] = splat[SPLAT_L11];
    whitening[1].lane[lane] = splat[SPLAT_L12];
    whitening[2].lane[lane] = splat[SPLAT_L22];
  }
  Projection p;
  if (!any || !project_gaussians(row, means, quaternions, log_scales, camera, &p)) return;
  const floatL l11 = whitening[0].all, l12 = whitening[1].all, l22 = whitening[2].all;
  const floatL m_g = m[SLOT_G].all, m_gu = m[SLOT_GU].all, m_gv = m[SLOT_GV].all;

  // Opacity, (29) and (41): sum of g is o dL/do, and do/dlogit = o (1 - o).
  Lanes d_opacity, d_screen[2], d_mean[3], d_scale[3], d_quaternion[4];
  d_opacity.all = m_g * sigmoidL(-GATHER(opacity_logits, 1, 0)); // 1 - o, also where o is next to 1

  // (50). Mean on the image: -W^T (sum of g w).
  const floatL d_mx = -INVERSE_WHITEN2 * (l11 * m_gu);
  const floatL d_my = -INVERSE_WHITEN2 * fmaL(l12, m_gu, l22 * m_gv);
#ifdef ABSOLUTE_GRADIENTS
  d_screen[0].all = INVERSE_WHITEN2 * m[SLOT_ABSX].all;
  d_screen[1].all = INVERSE_WHITEN2 * m[SLOT_ABSY].all;
#else
  d_screen[0].all = d_mx;
  d_screen[1].all = d_my;
#endif

  // (58). The columns of M = J A S, whitened: w[k] times the scale. Of order one, and differences of nothing large.
  const float unwhiten = INVERSE_WHITEN2 * INVERSE_WHITEN2;
  const floatL uu = unwhiten * m[SLOT_GUU].all, uv = unwhiten * m[SLOT_GUV].all, vv = unwhiten * m[SLOT_GVV].all;
  floatL wu[3], wv[3];
  const floatL lean = l11 / p.syy;
  for (int k = 0; k < 3; ++k) {
    const int l = (k + 1) % 3, n = (k + 2) % 3;
    const floatL minors = fmaL(p.s[l] * p.b2[l], p.s[l] * p.c[n], -(p.s[n] * p.b2[n] * (p.s[n] * p.c[l])));
    wu[k] = lean * fmaL((floatL)(LOW_PASS), p.b1[k], minors);
    wv[k] = l22 * p.b2[k];
  }

  // (59) to (61): log scales, the turn in the Gaussian's own frame, and what the Jacobian takes of the gradient.
  floatL d_size = (floatL)(0.0f), along_u = d_size, along_v = d_size, turned[3];
  for (int k = 0; k < 3; ++k) {
    const int l = (k + 1) % 3, n = (k + 2) % 3;
    const floatL nu = p.s[k] * wu[k], nv = p.s[k] * wv[k];
    const floatL tu = fmaL(uu, nu, uv * nv), tv = fmaL(uv, nu, vv * nv);
    d_scale[k].all = fmaL(nu, tu, nv * tv);
    d_size += d_scale[k].all;
    const floatL depth = p.s[k] * p.a2[k];
    along_u = fmaL(tu, depth, along_u);
    along_v = fmaL(tv, depth, along_v);
    const floatL apart = scale_difference(GATHER(log_scales, 3, l) - GATHER(log_scales, 3, n), p.s[l], p.s[n]);
    const floatL au = apart * wu[l], av = apart * wv[l], sum = p.s[l] + p.s[n];
    turned[k] = fmaL(fmaL(uu, au, uv * av), sum * wu[n], fmaL(uv, au, vv * av) * (sum * wv[n]));
  }
  const floatL w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
  const floatL turn = 2.0f / p.length;
  d_quaternion[0].all = turn * -fmaL(x, turned[0], fmaL(y, turned[1], z * turned[2]));
  d_quaternion[1].all = turn * fmaL(w, turned[0], fmaL(y, turned[2], -(z * turned[1])));
  d_quaternion[2].all = turn * fmaL(w, turned[1], fmaL(z, turned[0], -(x * turned[2])));
  d_quaternion[3].all = turn * fmaL(w, turned[2], fmaL(x, turned[1], -(y * turned[0])));

  // Mean in the camera's frame, (52): through the image position, and through J. With the ratio clamped, J moves with
  // z alone.
  const floatL rx = p.x / p.z, ry = p.y / p.z;
  const floatL d_j02 = rx == p.rx ? l11 * along_u : (floatL)(0.0f);
  const floatL d_j12 = ry == p.ry ? fmaL(l12, along_u, l22 * along_v) : (floatL)(0.0f);
  const floatL d_x = p.jx * (d_mx - d_j02 / p.z), d_y = p.jy * (d_my - d_j12 / p.z);
  const floatL d_z = -fmaL(d_x, rx, fmaL(d_y, ry, d_size / p.z));

  // Colour, (38) to (40): a channel that is clamped has no gradient; the basis depends on the mean through the view
  // direction, but for SH so large that the sum overflows.
  floatL vx = FROM_CAMERA(means, X, 0), vy = FROM_CAMERA(means, Y, 1), vz = FROM_CAMERA(means, Z, 2);
  const floatL length = sqrt(fmaL(vx, vx, fmaL(vy, vy, vz * vz)));
  vx /= length;
  vy /= length;
  vz /= length;
  Lanes basis[16], weight[16];
  sh_basis(SH_USED(coefficients), vx, vy, vz, &basis[0].all);
  for (uint lane = 0; lane < lanes_used; ++lane) {
    const size_t i = first_row + lane;
    if (tile_counts[i] == 0) continue;
    __global const float *splat = splats + (size_t)SPLAT_SIZE * i;
    const float4 d_colour = (float4)(splat[SPLAT_RED] > 0.0f ? m[SLOT_RED].lane[lane] : 0.0f,
                                     splat[SPLAT_GREEN] > 0.0f ? m[SLOT_GREEN].lane[lane] : 0.0f,
                                     splat[SPLAT_BLUE] > 0.0f ? m[SLOT_BLUE].lane[lane] : 0.0f, 0.0f);
    d_sh_dc[3 * i] = SH_CONSTANT * d_colour.x;
    d_sh_dc[3 * i + 1] = SH_CONSTANT * d_colour.y;
    d_sh_dc[3 * i + 2] = SH_CONSTANT * d_colour.z;
    __global const float *f = sh_rest + (size_t)3 * (coefficients - 1) * i;
    __global float *d_f = d_sh_rest + (size_t)3 * (coefficients - 1) * i;
    for (int k = 1; k < SH_USED(coefficients); ++k, f += 3, d_f += 3) {
      const float along = basis[k].lane[lane];
#ifndef NO_SH_REST // OptimiserConfig.sh_rest_every
      d_f[0] = along * d_colour.x;
      d_f[1] = along * d_colour.y;
      d_f[2] = along * d_colour.z;
#endif
      weight[k].lane[lane] = fma1(d_colour.x, f[0], fma1(d_colour.y, f[1], d_colour.z * f[2]));
    }
  }
  floatL d_v[3];
  sh_direction_gradient(SH_USED(coefficients), vx, vy, vz, &weight[0].all, d_v);
  const floatL along = d_v[0] * vx + d_v[1] * vy + d_v[2] * vz;
  for (int k = 0; k < 3; ++k) {
    const floatL v = k == 0 ? vx : (k == 1 ? vy : vz);
    const floatL by_colour = (d_v[k] - along * v) / length;
    const floatL above = by_colour < 1e37f ? by_colour : (floatL)(0.0f);
    d_mean[k].all = camera[CAMERA_R00 + k] * d_x + camera[CAMERA_R10 + k] * d_y + camera[CAMERA_R20 + k] * d_z +
                    (by_colour > -1e37f ? above : (floatL)(0.0f));
  }

  for (uint lane = 0; lane < lanes_used; ++lane) {
    const size_t i = first_row + lane;
    if (tile_counts[i] == 0) continue;
    for (int k = 0; k < 3; ++k) d_means[3 * i + k] = d_mean[k].lane[lane];
    for (int k = 0; k < 4; ++k) d_quaternions[4 * i + k] = d_quaternion[k].lane[lane];
    for (int k = 0; k < 3; ++k) d_log_scales[3 * i + k] = d_scale[k].lane[lane];
    d_opacity_logits[i] = d_opacity.lane[lane];
    for (int k = 0; k < 2; ++k) screen[2 * i + k] = d_screen[k].lane[lane];
#ifdef CONTRIBUTIONS
    contributions[i] = m[SLOT_WEIGHT].lane[lane];
#endif
  }
}

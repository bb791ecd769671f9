// The gradient of projection: sums a Gaussian's slots in the order of its tiles, then the chain rule back to its
// parameters (docs/gradients.md, equations 25 to 41 in the forms 50 to 52). A work-item has LANES Gaussians, of which it
// leaves those that are not visible.
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

// slots (pairs, SLOT_STRIDE), or with ADDED_UP their sums by Gaussian (n, SLOT_STRIDE).
// tile_counts, first_slots (n): its scan; the parameters, splats and camera as in project
// -> gradients of the parameters (same shapes; rows of Gaussians that are not visible are left as they are) and of
// the mean on the image: screen (n, 2) in pixels, plain or absolute; with CONTRIBUTIONS what each adds to the image:
// contributions (n), sums of its blending weights over all pixels (55).
__kernel void project_grad(const uint n, const int coefficients, __constant float *camera,
                           __global const uint *tile_counts, __global const uint *first_slots,
                           __global const float *slots, __global const float *splats, __global const float *means,
                           __global const float *quaternions, __global const float *log_scales,
                           __global const float *opacity_logits, __global const float *sh_dc,
                           __global const float *sh_rest,
                           __global float *d_means,
                           __global float *d_quaternions, __global float *d_log_scales,
                           __global float *d_opacity_logits, __global float *d_sh_dc, __global float *d_sh_rest,
                           __global float *screen
#ifdef CONTRIBUTIONS
                           , __global float *contributions
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
  const floatL uu = m[SLOT_GUU].all, uv = m[SLOT_GUV].all, vv = m[SLOT_GVV].all;

  // Opacity, (29) and (41): sum of g is o dL/do, and do/dlogit = o (1 - o).
  Lanes d_opacity, d_screen[2], d_mean[3], d_scale[3], d_quaternion[4];
  d_opacity.all = m_g * (1.0f - sigmoidL(GATHER(opacity_logits, 1, 0)));

  // (50). Mean on the image: -W^T (sum of g w); covariance: W^T (sum of g w w^T) W / 2.
  const floatL d_mx = -INVERSE_WHITEN2 * (l11 * m_gu);
  const floatL d_my = -INVERSE_WHITEN2 * fmaL(l12, m_gu, l22 * m_gv);
#ifdef ABSOLUTE_GRADIENTS
  d_screen[0].all = INVERSE_WHITEN2 * m[SLOT_ABSX].all;
  d_screen[1].all = INVERSE_WHITEN2 * m[SLOT_ABSY].all;
#else
  d_screen[0].all = d_mx;
  d_screen[1].all = d_my;
#endif
  const float half4 = 0.5f * INVERSE_WHITEN2 * INVERSE_WHITEN2;
  const floatL g_xx = half4 * l11 * l11 * uu;
  const floatL g_xy = half4 * l11 * fmaL(l12, uu, l22 * uv);
  const floatL g_yy = half4 * fmaL(l12, fmaL(l12, uu, 2.0f * l22 * uv), l22 * l22 * vv);

  // (31), (51). M = J A S: dL/dM = 2 G M, column by column; J's entries and A's collect theirs.
  floatL d_jx = (floatL)(0.0f), d_kx = d_jx, d_jy = d_jx, d_ky = d_jx, d_a[9];
  for (int k = 0; k < 3; ++k) {
    const floatL m1 = p.s[k] * p.b1[k], m2 = p.s[k] * p.b2[k];
    const floatL d_m1 = 2.0f * fmaL(g_xx, m1, g_xy * m2);
    const floatL d_m2 = 2.0f * fmaL(g_xy, m1, g_yy * m2);
    d_scale[k].all = fmaL(d_m1, m1, d_m2 * m2);
    const floatL d_b1 = p.s[k] * d_m1, d_b2 = p.s[k] * d_m2;
    d_jx = fmaL(d_b1, p.a[k], d_jx);
    d_kx = fmaL(d_b1, p.a[6 + k], d_kx);
    d_jy = fmaL(d_b2, p.a[3 + k], d_jy);
    d_ky = fmaL(d_b2, p.a[6 + k], d_ky);
    d_a[k] = d_b1 * p.jx;
    d_a[3 + k] = d_b2 * p.jy;
    d_a[6 + k] = fmaL(d_b1, p.kx, d_b2 * p.ky);
  }

  // Rotation, (51), (34), (35): A = R_camera R(q), so dL/dR = R_camera^T dL/dA; then q, then the normalisation.
  floatL r[9];
  for (int j = 0; j < 3; ++j)
    for (int k = 0; k < 3; ++k)
      r[3 * j + k] = fmaL((floatL)(camera[CAMERA_R00 + j]), d_a[k],
                          fmaL((floatL)(camera[CAMERA_R10 + j]), d_a[3 + k], camera[CAMERA_R20 + j] * d_a[6 + k]));
  const floatL w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
  floatL d_q[4];
  d_q[0] = 2.0f * (x * (r[7] - r[5]) + y * (r[2] - r[6]) + z * (r[3] - r[1]));
  d_q[1] = 2.0f * (w * (r[7] - r[5]) + y * (r[1] + r[3]) + z * (r[2] + r[6]) - 2.0f * x * (r[4] + r[8]));
  d_q[2] = 2.0f * (w * (r[2] - r[6]) + x * (r[1] + r[3]) + z * (r[5] + r[7]) - 2.0f * y * (r[0] + r[8]));
  d_q[3] = 2.0f * (w * (r[3] - r[1]) + x * (r[2] + r[6]) + y * (r[5] + r[7]) - 2.0f * z * (r[0] + r[4]));
  const floatL radial = d_q[0] * w + d_q[1] * x + d_q[2] * y + d_q[3] * z;
  for (int k = 0; k < 4; ++k) d_quaternion[k].all = fmaL(-radial, p.q[k], d_q[k]) / p.length;

  // Mean in the camera's frame, (52): through the image position, and through J. With the ratio clamped, kx = -jx rx
  // depends on z alone.
  const floatL rx = p.x / p.z, ry = p.y / p.z;
  floatL d_x = d_mx * p.jx, d_y = d_my * p.jy;
  floatL d_z = -(d_mx * p.jx * rx + d_my * p.jy * ry);
  d_z -= (d_jx * p.jx + d_kx * p.kx + d_jy * p.jy + d_ky * p.ky) / p.z;
  const floatL d_rx = rx == p.rx ? -d_kx * p.jx / p.z : (floatL)(0.0f);
  const floatL d_ry = ry == p.ry ? -d_ky * p.jy / p.z : (floatL)(0.0f);
  d_x += d_rx;
  d_y += d_ry;
  d_z -= d_rx * rx;
  d_z -= d_ry * ry;

  // Colour, (38) to (40): a channel clamped at 0 has no gradient; the basis depends on the mean through the view
  // direction.
  floatL vx = GATHER(means, 3, 0) - camera[CAMERA_PX], vy = GATHER(means, 3, 1) - camera[CAMERA_PY];
  floatL vz = GATHER(means, 3, 2) - camera[CAMERA_PZ];
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
    d_mean[k].all = camera[CAMERA_R00 + k] * d_x + camera[CAMERA_R10 + k] * d_y + camera[CAMERA_R20 + k] * d_z +
                    (d_v[k] - along * v) / length;
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

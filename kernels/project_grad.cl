// The gradient of projection: sums a Gaussian's slots in the order of its tiles, then the chain rule back to its
// parameters (docs/gradients.md, equations 25 to 41 in the forms 50 to 52). One work-item a Gaussian.
#include "shared/math.h"
#include "shared/splat.h"
#include "shared/gaussian.h"
#include "shared/sh.h"

// tile_counts, first_slots (n): its scan; the parameters, splats and camera as in project
// -> gradients of the parameters (same shapes; rows of Gaussians that are not visible are left as they are) and of
// the mean on the image: screen (n, 2) in pixels, plain or absolute.
__kernel void project_grad(const uint n, const int coefficients, __constant float *camera,
                           __global const uint *tile_counts, __global const uint *first_slots,
                           __global const float *slots, __global const float *splats, __global const float *means,
                           __global const float *quaternions, __global const float *log_scales,
                           __global const float *opacity_logits, __global const float *sh_dc,
                           __global const float *sh_rest,
                           __global float *d_means,
                           __global float *d_quaternions, __global float *d_log_scales,
                           __global float *d_opacity_logits, __global float *d_sh_dc, __global float *d_sh_rest,
                           __global float *screen) {
  const uint i = get_global_id(0);
  if (i >= n || tile_counts[i] == 0) return;
  const uint first = first_slots[i], after = first + tile_counts[i];
  float m[SLOT_STRIDE];
  for (int field = 0; field < SLOT_STRIDE; ++field) m[field] = 0.0f;
  for (uint slot = first; slot < after; ++slot)
    for (int field = 0; field < SLOT_STRIDE; ++field) m[field] += slots[(size_t)SLOT_STRIDE * slot + field];

  Projection p;
  if (!project_gaussian(means + 3 * i, quaternions + 4 * i, log_scales + 3 * i, camera, &p)) return;
  __global const float *splat = splats + (size_t)SPLAT_SIZE * i;
  const float l11 = splat[SPLAT_L11], l12 = splat[SPLAT_L12], l22 = splat[SPLAT_L22];

  // Opacity, (29) and (41): sum of g is o dL/do, and do/dlogit = o (1 - o).
  d_opacity_logits[i] = m[SLOT_G] * (1.0f - sigmoid1(opacity_logits[i]));

  // (50). Mean on the image: -W^T (sum of g w); covariance: W^T (sum of g w w^T) W / 2.
  const float d_mx = -INVERSE_WHITEN2 * (l11 * m[SLOT_GU]);
  const float d_my = -INVERSE_WHITEN2 * fma1(l12, m[SLOT_GU], l22 * m[SLOT_GV]);
#ifdef ABSOLUTE_GRADIENTS
  screen[2 * i] = INVERSE_WHITEN2 * m[SLOT_ABSX];
  screen[2 * i + 1] = INVERSE_WHITEN2 * m[SLOT_ABSY];
#else
  screen[2 * i] = d_mx;
  screen[2 * i + 1] = d_my;
#endif
  const float half4 = 0.5f * INVERSE_WHITEN2 * INVERSE_WHITEN2;
  const float uu = m[SLOT_GUU], uv = m[SLOT_GUV], vv = m[SLOT_GVV];
  const float g_xx = half4 * l11 * l11 * uu;
  const float g_xy = half4 * l11 * fma1(l12, uu, l22 * uv);
  const float g_yy = half4 * fma1(l12, fma1(l12, uu, 2.0f * l22 * uv), l22 * l22 * vv);

  // (31), (51). M = J A S: dL/dM = 2 G M, column by column; J's entries and A's collect theirs.
  float d_jx = 0.0f, d_kx = 0.0f, d_jy = 0.0f, d_ky = 0.0f, d_a[9];
  for (int k = 0; k < 3; ++k) {
    const float m1 = p.s[k] * p.b1[k], m2 = p.s[k] * p.b2[k];
    const float d_m1 = 2.0f * fma1(g_xx, m1, g_xy * m2);
    const float d_m2 = 2.0f * fma1(g_xy, m1, g_yy * m2);
    d_log_scales[3 * i + k] = fma1(d_m1, m1, d_m2 * m2);
    const float d_b1 = p.s[k] * d_m1, d_b2 = p.s[k] * d_m2;
    d_jx = fma1(d_b1, p.a[k], d_jx);
    d_kx = fma1(d_b1, p.a[6 + k], d_kx);
    d_jy = fma1(d_b2, p.a[3 + k], d_jy);
    d_ky = fma1(d_b2, p.a[6 + k], d_ky);
    d_a[k] = d_b1 * p.jx;
    d_a[3 + k] = d_b2 * p.jy;
    d_a[6 + k] = fma1(d_b1, p.kx, d_b2 * p.ky);
  }

  // Rotation, (51), (34), (35): A = R_camera R(q), so dL/dR = R_camera^T dL/dA; then q, then the normalisation.
  float r[9];
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column)
      r[3 * row + column] =
          fma1(camera[CAMERA_R00 + row], d_a[column],
               fma1(camera[CAMERA_R10 + row], d_a[3 + column], camera[CAMERA_R20 + row] * d_a[6 + column]));
  const float w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
  float d_q[4];
  d_q[0] = 2.0f * (x * (r[7] - r[5]) + y * (r[2] - r[6]) + z * (r[3] - r[1]));
  d_q[1] = 2.0f * (w * (r[7] - r[5]) + y * (r[1] + r[3]) + z * (r[2] + r[6]) - 2.0f * x * (r[4] + r[8]));
  d_q[2] = 2.0f * (w * (r[2] - r[6]) + x * (r[1] + r[3]) + z * (r[5] + r[7]) - 2.0f * y * (r[0] + r[8]));
  d_q[3] = 2.0f * (w * (r[3] - r[1]) + x * (r[2] + r[6]) + y * (r[5] + r[7]) - 2.0f * z * (r[0] + r[4]));
  const float radial = d_q[0] * w + d_q[1] * x + d_q[2] * y + d_q[3] * z;
  for (int k = 0; k < 4; ++k) d_quaternions[4 * i + k] = fma1(-radial, p.q[k], d_q[k]) / p.length;

  // Mean in the camera's frame, (52): through the image position, and through J. With the ratio clamped, kx = -jx rx
  // depends on z alone.
  const float rx = p.x / p.z, ry = p.y / p.z;
  float d_x = d_mx * p.jx, d_y = d_my * p.jy;
  float d_z = -(d_mx * p.jx * rx + d_my * p.jy * ry);
  d_z -= (d_jx * p.jx + d_kx * p.kx + d_jy * p.jy + d_ky * p.ky) / p.z;
  if (rx == p.rx) {
    const float d_rx = -d_kx * p.jx / p.z;
    d_x += d_rx;
    d_z -= d_rx * rx;
  }
  if (ry == p.ry) {
    const float d_ry = -d_ky * p.jy / p.z;
    d_y += d_ry;
    d_z -= d_ry * ry;
  }

  // Colour, (38) to (40): a channel clamped at 0 has no gradient; the basis depends on the mean through the view
  // direction.
  float vx = means[3 * i] - camera[CAMERA_PX], vy = means[3 * i + 1] - camera[CAMERA_PY];
  float vz = means[3 * i + 2] - camera[CAMERA_PZ];
  const float length = sqrt(fma1(vx, vx, fma1(vy, vy, vz * vz)));
  vx /= length;
  vy /= length;
  vz /= length;
  const float d_red = splat[SPLAT_RED] > 0.0f ? m[SLOT_RED] : 0.0f;
  const float d_green = splat[SPLAT_GREEN] > 0.0f ? m[SLOT_GREEN] : 0.0f;
  const float d_blue = splat[SPLAT_BLUE] > 0.0f ? m[SLOT_BLUE] : 0.0f;
  float basis[16], weight[16], d_v[3];
  sh_basis(SH_USED(coefficients), vx, vy, vz, basis);
  __global const float *f = sh_rest + (size_t)3 * (coefficients - 1) * i;
  __global float *d_f = d_sh_rest + (size_t)3 * (coefficients - 1) * i;
  d_sh_dc[3 * i] = basis[0] * d_red;
  d_sh_dc[3 * i + 1] = basis[0] * d_green;
  d_sh_dc[3 * i + 2] = basis[0] * d_blue;
  for (int k = 1; k < SH_USED(coefficients); ++k, f += 3, d_f += 3) {
    d_f[0] = basis[k] * d_red;
    d_f[1] = basis[k] * d_green;
    d_f[2] = basis[k] * d_blue;
    weight[k] = fma1(d_red, f[0], fma1(d_green, f[1], d_blue * f[2]));
  }
  sh_direction_gradient(SH_USED(coefficients), vx, vy, vz, weight, d_v);
  const float along = d_v[0] * vx + d_v[1] * vy + d_v[2] * vz;
  d_means[3 * i] = camera[CAMERA_R00] * d_x + camera[CAMERA_R10] * d_y + camera[CAMERA_R20] * d_z +
                   (d_v[0] - along * vx) / length;
  d_means[3 * i + 1] = camera[CAMERA_R01] * d_x + camera[CAMERA_R11] * d_y + camera[CAMERA_R21] * d_z +
                       (d_v[1] - along * vy) / length;
  d_means[3 * i + 2] = camera[CAMERA_R02] * d_x + camera[CAMERA_R12] * d_y + camera[CAMERA_R22] * d_z +
                       (d_v[2] - along * vz) / length;
}

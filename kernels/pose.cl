// The gradients with respect to a camera's pose and lens. The pose's gradient is computed from the gradients with
// respect to the model. The lens's gradient is a sum over Gaussians.
//
// Owner: A work-item owns POSE_ROWS consecutive Gaussians (pose_rows, lens_rows), then POSE_ROWS consecutive sums
//   (pose_sums). Built with one lane; LANES and ITEMS do not change its bits.
// Launch: One work-item for each POSE_ROWS Gaussians; then one for each POSE_ROWS sums of each of `width` columns,
//   until one row is left.
// Buffers: tile_counts (n), means (n, 3), quaternions (n, 4), sh_rest (n, coefficients - 1, 3).
//   d_means, d_quaternions, d_sh_dc: the gradients in the parameters' shapes, not read for Gaussians without tiles.
//   -> sums (ceil(n / POSE_ROWS), 6), from row first_block on: the gradient with respect to rotation about the world's
//     axes, then to translation along them.
//   lens_rows: by_lens (n, 4) of project_grad.cl -> sums (ceil(n / POSE_ROWS), 4).
// Equations: docs/gradients.md, (140) to (142), (144).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/sh.h"
#include "shared/camera.h"

__kernel void pose_rows(const uint n, const uint first_block, const int coefficients, __constant float *camera,
                        __global const uint *tile_counts, __global const float *means,
                        __global const float *quaternions, __global const float *sh_rest, __global const float *d_means,
                        __global const float *d_quaternions, __global const float *d_sh_dc, __global float *sums) {
  const uint block = get_global_id(0), first = block * POSE_ROWS;
  if (first >= n) return;
  float turn[3] = {0.0f, 0.0f, 0.0f}, shift[3] = {0.0f, 0.0f, 0.0f};
  for (size_t i = first; i < min(first + POSE_ROWS, n); ++i) {
    if (tile_counts[i] == 0) continue;
    const float x = (means[3 * i] - camera[CAMERA_PX]) - camera[CAMERA_PX_LOW];
    const float y = (means[3 * i + 1] - camera[CAMERA_PY]) - camera[CAMERA_PY_LOW];
    const float z = (means[3 * i + 2] - camera[CAMERA_PZ]) - camera[CAMERA_PZ_LOW];
    const float gx = d_means[3 * i], gy = d_means[3 * i + 1], gz = d_means[3 * i + 2];
    shift[0] += gx;
    shift[1] += gy;
    shift[2] += gz;

    // Equation (142) of docs/gradients.md: the gradient with respect to the view direction. For parallel rays this
    // direction does not depend on the mean.
    const float distance = sqrt(fma1(x, x, fma1(y, y, z * z)));
    const float ux = SEEN_ALONG(x, distance, camera[CAMERA_R20]), uy = SEEN_ALONG(y, distance, camera[CAMERA_R21]),
                uz = SEEN_ALONG(z, distance, camera[CAMERA_R22]);
    const float red = d_sh_dc[3 * i] / SH_CONSTANT, green = d_sh_dc[3 * i + 1] / SH_CONSTANT,
                blue = d_sh_dc[3 * i + 2] / SH_CONSTANT;
    __global const float *f = sh_rest + (size_t)3 * (coefficients - 1) * i;
    float weight[16], by[3];
    for (int k = 1; k < coefficients; ++k, f += 3) weight[k] = fma1(red, f[0], fma1(green, f[1], blue * f[2]));
    sh_direction_gradient(coefficients, ux, uy, uz, weight, by);
    // Equation (141) of docs/gradients.md: SH do not rotate with the camera, so the torque of the gradient through the
    // direction is subtracted.
    const float across_x = uy * by[2] - uz * by[1], across_y = uz * by[0] - ux * by[2],
                across_z = ux * by[1] - uy * by[0];

    __global const float *q = quaternions + 4 * i, *g = d_quaternions + 4 * i;
    turn[0] += fma1(y, gz, -(z * gy)) - across_x +
               0.5f * (fma1(q[0], g[1], -(q[1] * g[0])) + fma1(q[2], g[3], -(q[3] * g[2])));
    turn[1] += fma1(z, gx, -(x * gz)) - across_y +
               0.5f * (fma1(q[0], g[2], -(q[2] * g[0])) + fma1(q[3], g[1], -(q[1] * g[3])));
    turn[2] += fma1(x, gy, -(y * gx)) - across_z +
               0.5f * (fma1(q[0], g[3], -(q[3] * g[0])) + fma1(q[1], g[2], -(q[2] * g[1])));
  }
  __global float *own = sums + 6 * (first_block + block);
  for (int k = 0; k < 3; ++k) own[k] = turn[k], own[3 + k] = shift[k];
}

__kernel void lens_rows(const uint n, const uint first_block, __global const uint *tile_counts,
                        __global const float *by_lens, __global float *sums) {
  const uint block = get_global_id(0), first = block * POSE_ROWS;
  if (first >= n) return;
  float own[4] = {0.0f, 0.0f, 0.0f, 0.0f};
  for (size_t i = first; i < min(first + POSE_ROWS, n); ++i)
    if (tile_counts[i] > 0)
      for (int k = 0; k < 4; ++k) own[k] += by_lens[4 * i + k];
  for (int k = 0; k < 4; ++k) sums[4 * (first_block + block) + k] = own[k];
}

// Adds up blocks of POSE_ROWS rows: parts (count, width) -> sums (ceil(count / POSE_ROWS), width).
__kernel void pose_sums(const uint count, const uint width, __global const float *parts, __global float *sums) {
  const uint item = get_global_id(0), block = item / width, first = block * POSE_ROWS;
  if (first >= count) return;
  float sum = 0.0f;
  for (size_t i = first; i < min(first + POSE_ROWS, count); ++i) sum += parts[width * i + item % width];
  sums[item] = sum;
}

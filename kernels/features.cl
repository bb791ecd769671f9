// Features of each visible Gaussian for the auxiliary channels: depth, normal, position and motion. A Gaussian's row
// has FEATURES floats. FEATURE_X is the offset of feature X in the row; the macro is defined if X is requested.
//
// Owner: A work-item owns a Gaussian. Built with one lane; LANES and ITEMS do not change its bits.
// Launch: One work-item for each Gaussian, in groups of 64; work-items past the end do nothing.
// Buffers: camera: the frame's camera; after, before: the cameras at the ends of forward and backward motion.
//   tile_counts (n): 0 for an invisible Gaussian.
//   means, quaternions, log_scales: as in project.cl.
//   means_after, means_before (n, 3): the means at the times of `after` and `before`; in a static model the array
//     `means`.
//   splats (n, SPLAT_SIZE): from the projection that wrote tile_counts.
//   -> features (n, FEATURES), written for visible Gaussians: depth and position in world units, a unit normal, motion
//     in pixels.
// Equations: docs/channels.md, (61) to (64), (74) and (75).
#include "shared/math.h"
#if defined(FEATURE_MOTION) || defined(FEATURE_BACKWARD)
#define NEEDS_MOTION // motion_of in shared/camera/, equation (64) of docs/channels.md
#endif
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/gaussian.h"

#ifdef FEATURE_NORMAL
// Equation (62) of docs/channels.md: the axis of the smallest scale, in world axes, with the sign that faces the
// camera. (dx, dy, dz): the view direction at the mean.
static inline void normal_of(__global const float *q, __global const float *log_scales, float dx, float dy, float dz,
                             __global float *normal) {
  const int first = log_scales[1] < log_scales[0] ? 1 : 0;
  const int axis = log_scales[2] < log_scales[first] ? 2 : first;
  const int next = axis == 2 ? 0 : axis + 1, last = axis == 0 ? 2 : axis - 1;
  const float length = sqrt(fma1(q[0], q[0], fma1(q[1], q[1], fma1(q[2], q[2], q[3] * q[3]))));
  const float w = q[0] / length, v[3] = {q[1] / length, q[2] / length, q[3] / length};
  float n[3];
  n[axis] = 1.0f - 2.0f * fma1(v[next], v[next], v[last] * v[last]);
  n[next] = 2.0f * fma1(v[axis], v[next], w * v[last]);
  n[last] = 2.0f * fma1(v[axis], v[last], -(w * v[next]));
  const float away = fma1(n[0], dx, fma1(n[1], dy, n[2] * dz));
  for (int k = 0; k < 3; ++k) normal[k] = away > 0.0f ? -n[k] : n[k];
}
#endif

__kernel void features(const uint n, __constant float *camera, __constant float *after, __constant float *before,
                       __global const uint *tile_counts, __global const float *means, __global const float *quaternions,
                       __global const float *log_scales, __global const float *means_after,
                       __global const float *means_before, __global const float *splats, __global float *features) {
  const size_t i = get_global_id(0);
  if (i >= n || tile_counts[i] == 0) return;
  __global float *row = features + FEATURES * i;
  __global const float *splat = splats + SPLAT_SIZE * i;
  const float x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
#ifdef FEATURE_DEPTH
  row[FEATURE_DEPTH] = splat[SPLAT_DEPTH];
#endif
#ifdef FEATURE_NORMAL
  const float d[3] = {SEEN_ALONG(x - camera[CAMERA_PX], 1.0f, camera[CAMERA_R20]),
                      SEEN_ALONG(y - camera[CAMERA_PY], 1.0f, camera[CAMERA_R21]),
                      SEEN_ALONG(z - camera[CAMERA_PZ], 1.0f, camera[CAMERA_R22])};
  normal_of(quaternions + 4 * i, log_scales + 3 * i, d[0], d[1], d[2], row + FEATURE_NORMAL);
#endif
#ifdef FEATURE_POSITION
  row[FEATURE_POSITION] = x;
  row[FEATURE_POSITION + 1] = y;
  row[FEATURE_POSITION + 2] = z;
#endif
#ifdef FEATURE_MOTION
  motion_of(camera, after, x, y, z, means_after + 3 * i, splat, row + FEATURE_MOTION);
#endif
#ifdef FEATURE_BACKWARD
  motion_of(camera, before, x, y, z, means_before + 3 * i, splat, row + FEATURE_BACKWARD);
#endif
}

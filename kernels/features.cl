// What a Gaussian brings to the channels beside colour (docs/channels.md): a row of FEATURES floats for each visible one.
// FEATURE_X is the place of X in the row, where X is wanted. Built with one lane: its bits are those of any shape.
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/gaussian.h"

#ifdef FEATURE_NORMAL
// (62): the axis of the smallest scale, in the world, on the side of it that the camera sees; (dx, dy, dz): from the
// camera to the mean.
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

#ifdef FEATURE_MOTION
// (64): from the mean's place on the image to that under another camera, in pixels; 0 where that has it behind its near
// plane. Whole pixels and the rest are subtracted apart, as a float32 of their sum would be cut.
static inline void motion_of(__constant float *camera, float x, float y, float z, __global const float *splat,
                             __global float *motion) {
  const Double at_x = CAMERA_ROW(0), at_y = CAMERA_ROW(1), at_z = CAMERA_ROW(2);
  motion[0] = motion[1] = 0.0f;
  if (!(at_z.high > camera[CAMERA_NEAR])) return;
  float whole, rest;
  image_position(at_x.high, at_x.low, at_z.high, at_z.low, camera[CAMERA_FX], camera[CAMERA_FX_LOW],
                 camera[CAMERA_CX], camera[CAMERA_CX_LOW], camera[CAMERA_WINDOW_X], &whole, &rest);
  motion[0] = (whole - splat[SPLAT_PIXEL_X]) + (rest - splat[SPLAT_SUB_X]);
  image_position(at_y.high, at_y.low, at_z.high, at_z.low, camera[CAMERA_FY], camera[CAMERA_FY_LOW],
                 camera[CAMERA_CY], camera[CAMERA_CY_LOW], camera[CAMERA_WINDOW_Y], &whole, &rest);
  motion[1] = (whole - splat[SPLAT_PIXEL_Y]) + (rest - splat[SPLAT_SUB_Y]);
}
#endif

// tile_counts (n): 0 where not visible; camera: the frame's own; after: the one that motion goes to; splats (n,
// SPLAT_SIZE) -> features (n, FEATURES), written where visible.
__kernel void features(const uint n, __constant float *camera, __constant float *after,
                       __global const uint *tile_counts, __global const float *means,
                       __global const float *quaternions, __global const float *log_scales,
                       __global const float *splats, __global float *features) {
  const size_t i = get_global_id(0);
  if (i >= n || tile_counts[i] == 0) return;
  __global float *row = features + FEATURES * i;
  __global const float *splat = splats + SPLAT_SIZE * i;
  const float x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
#ifdef FEATURE_DEPTH
  row[FEATURE_DEPTH] = splat[SPLAT_DEPTH];
#endif
#ifdef FEATURE_NORMAL
  normal_of(quaternions + 4 * i, log_scales + 3 * i, x - camera[CAMERA_PX], y - camera[CAMERA_PY],
            z - camera[CAMERA_PZ], row + FEATURE_NORMAL);
#endif
#ifdef FEATURE_POSITION
  row[FEATURE_POSITION] = x;
  row[FEATURE_POSITION + 1] = y;
  row[FEATURE_POSITION + 2] = z;
#endif
#ifdef FEATURE_MOTION
  motion_of(after, x, y, z, splat, row + FEATURE_MOTION);
#endif
}

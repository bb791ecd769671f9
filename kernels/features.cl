// A Gaussian's part in the channels beside colour: a row of FEATURES floats for each visible one. FEATURE_X is the
// place of X in the row, where X is wanted.
//
// Owner: A work-item owns a Gaussian. Built with one lane: its bits are those of any shape.
// Launch: One work-item for each Gaussian, in groups of 64; those beyond the last do nothing.
// Buffers: camera: the frame's own; after, before: those that motion goes to and backward motion goes back to;
//   tile_counts (n): 0 where not visible; means, quaternions, log_scales as in project.cl; means_after, means_before
//   (n, 3): where they are when motion has come there, the means themselves where nothing moves; splats
//   (n, SPLAT_SIZE), all of one projection -> features (n, FEATURES), written where visible: depth and position in
//   world units, a normal of unit length, motion in pixels.
// Equations: docs/channels.md, (61) to (64), (74) and (75).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/gaussian.h"
#include "shared/angles.h"

#ifdef FEATURE_NORMAL
// (62): the axis of the smallest scale, in the world, on the side of it that the camera sees; (dx, dy, dz): where that
// looks, at the mean.
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

#if defined(FEATURE_MOTION) || defined(FEATURE_BACKWARD)
// (64): from the mean's place on the image to that of the mean `to` under another camera, in pixels; 0 where that has
// it behind its near plane.
#if defined(RAYS) && RAYS != 3
typedef struct {
  Double at[3];
} InCamera;

static inline InCamera in_camera(__constant float *camera, float x, float y, float z) {
  const InCamera p = {{CAMERA_ROW(0), CAMERA_ROW(1), CAMERA_ROW(2)}};
  return p;
}

// The growth of a value of the camera.
#define GROWN(name)                                                                                                    \
  ((after[CAMERA_##name] - camera[CAMERA_##name]) + (after[CAMERA_##name##_LOW] - camera[CAMERA_##name##_LOW]))

// Angles by what the coordinates have grown by (74), (75): a small motion is nothing beside the rounding of two angles.
static inline void motion_of(__constant float *camera, __constant float *after, float x, float y, float z,
                             __global const float *to, __global const float *splat, __global float *motion) {
  motion[0] = motion[1] = 0.0f;
  const InCamera here = in_camera(camera, x, y, z), there = in_camera(after, to[0], to[1], to[2]);
  float p[3], q[3], d[3];
  for (int k = 0; k < 3; ++k) {
    p[k] = here.at[k].high;
    q[k] = there.at[k].high;
    d[k] = subtract2(there.at[k], here.at[k]).high;
  }
  const float distance = sqrt(fma1(q[0], q[0], fma1(q[1], q[1], q[2] * q[2])));
  if (!(distance > after[CAMERA_NEAR] && distance < 1e15f)) return;
#if RAYS == 1
  const float level = sqrt(fma1(p[0], p[0], p[2] * p[2])), level_there = sqrt(fma1(q[0], q[0], q[2] * q[2]));
  const float sum = level + level_there;
  const float grown = sum > 0.0f ? fma1(d[0], p[0] + q[0], d[2] * (p[2] + q[2])) / sum : 0.0f;
  const float turned = signed_atan(fma1(d[0], p[2], -(d[2] * p[0])), fma1(p[0], q[0], p[2] * q[2]));
  const float risen = signed_atan(fma1(d[1], level, -(grown * p[1])), fma1(p[1], q[1], level * level_there));
  // the longitude nearest to that of the frame's middle, which is where the mean is shown (docs/cameras.md, 6)
  const float middle = 0.5f * (camera[CAMERA_XMIN] + camera[CAMERA_XMAX]), longitude = signed_atan(p[0], p[2]);
  const float turns = floorL(fma1(longitude - middle, 0.5f / HALF_TURN, 0.5f));
  const float a = fma1(turns, -2.0f * HALF_TURN, longitude), b = signed_atan(p[1], level);
  motion[0] = fma1(after[CAMERA_FX], turned, fma1(GROWN(FX), a, GROWN(CX)));
  motion[1] = fma1(after[CAMERA_FY], risen, fma1(GROWN(FY), b, GROWN(CY)));
#else
  const float across = sqrt(fma1(p[0], p[0], p[1] * p[1])), across_there = sqrt(fma1(q[0], q[0], q[1] * q[1]));
  if (!(across > 0.0f || p[2] > 0.0f) || !(across_there > 0.0f || q[2] > 0.0f)) return; // straight behind: no pixel
  const float sum = across + across_there;
  const float grown = sum > 0.0f ? fma1(d[0], p[0] + q[0], d[1] * (p[1] + q[1])) / sum : 0.0f;
  const float turned = signed_atan(fma1(grown, p[2], -(d[2] * across)), fma1(across, across_there, p[2] * q[2]));
  const float c = across > 0.0f ? p[0] / across : 0.0f, s = across > 0.0f ? p[1] / across : 0.0f;
  const float theta = half_atan(across, p[2]);
  const float slope = across_there > 0.0f ? half_atan(across_there, q[2]) / across_there : 1.0f / q[2];
  const float along_x = fma1(slope, fma1(-grown, c, d[0]), turned * c);
  const float along_y = fma1(slope, fma1(-grown, s, d[1]), turned * s);
  motion[0] = fma1(after[CAMERA_FX], along_x, fma1(GROWN(FX), theta * c, GROWN(CX)));
  motion[1] = fma1(after[CAMERA_FY], along_y, fma1(GROWN(FY), theta * s, GROWN(CY)));
#endif
}
#else
// The place of a mean on the image, whole pixels and the rest; 0 where it is not before the near plane.
static inline int place_of(__constant float *camera, float x, float y, float z, float *whole, float *rest) {
  const Double at_x = CAMERA_ROW(0), at_y = CAMERA_ROW(1), at_z = CAMERA_ROW(2);
  if (!(at_z.high > camera[CAMERA_NEAR])) return 0;
  image_position(at_x.high, at_x.low, at_z.high, at_z.low, camera[CAMERA_FX], camera[CAMERA_FX_LOW], camera[CAMERA_CX],
                 camera[CAMERA_CX_LOW], camera[CAMERA_WINDOW_X], &whole[0], &rest[0]);
  image_position(at_y.high, at_y.low, at_z.high, at_z.low, camera[CAMERA_FY], camera[CAMERA_FY_LOW], camera[CAMERA_CY],
                 camera[CAMERA_CY_LOW], camera[CAMERA_WINDOW_Y], &whole[1], &rest[1]);
  return 1;
}

// Whole pixels and the rest are subtracted apart, as a float32 of their sum would be cut.
static inline void motion_of(__constant float *camera, __constant float *after, float x, float y, float z,
                             __global const float *to, __global const float *splat, __global float *motion) {
  float whole[2], rest[2];
  motion[0] = motion[1] = 0.0f;
  if (!place_of(after, to[0], to[1], to[2], whole, rest)) return;
#ifdef RAYS // a splat has no place
  float own_whole[2], own_rest[2];
  if (!place_of(camera, x, y, z, own_whole, own_rest)) return;
  for (int k = 0; k < 2; ++k) motion[k] = (whole[k] - own_whole[k]) + (rest[k] - own_rest[k]);
#else
  motion[0] = (whole[0] - splat[SPLAT_PIXEL_X]) + (rest[0] - splat[SPLAT_SUB_X]);
  motion[1] = (whole[1] - splat[SPLAT_PIXEL_Y]) + (rest[1] - splat[SPLAT_SUB_Y]);
#endif
}
#endif
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
#ifdef ORTHOGRAPHIC
  const float d[3] = {camera[CAMERA_R20], camera[CAMERA_R21], camera[CAMERA_R22]};
#else
  const float d[3] = {x - camera[CAMERA_PX], y - camera[CAMERA_PY], z - camera[CAMERA_PZ]};
#endif
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

// Pixels as rays, of equirectangular (RAYS == 1), fisheye (RAYS == 2) and perspective (RAYS == 3) cameras: equations
// (2), (4) and (5) of docs/cameras.md, in the camera's axes. Needs lanes.h; its own functions, for the same bits on
// every driver.
#include "shared/elementary.h"
#include "shared/angles.h"

#ifndef CAMERA_SPACE // where the camera is
#define CAMERA_SPACE __constant
#endif

// sin(x) for |x| up to a little over a quarter turn, to 2e-8 of it: minimax in x^2.
static inline floatL sinL(floatL x) {
  const floatL t = x * x;
  floatL p = fmaL(t, (floatL)(2.601887672e-06f), (floatL)(-1.980741217e-04f));
  p = fmaL(t, p, (floatL)(8.333025500e-03f));
  p = fmaL(t, p, (floatL)(-1.666665673e-01f));
  return fmaL(t * p, x, x);
}

static inline floatL absL(floatL x) { return x < 0.0f ? -x : x; }

#if RAYS == 2
#ifdef KANNALA_BRANDT // (18) of docs/cameras.md
#define FARTHEST_ANGLE(camera) (camera)[CAMERA_FOLD]
#define SERIES(camera) (2.0f * (camera)[CAMERA_K1])
// The distance from the axis in focal lengths of what is seen at the angle t from it, its slope, and that one's.
static inline floatL radius_of(floatL t, CAMERA_SPACE float *camera) {
  const floatL t2 = t * t;
  floatL p = fmaL(t2, (floatL)(camera[CAMERA_K4]), (floatL)(camera[CAMERA_K3]));
  p = fmaL(t2, p, (floatL)(camera[CAMERA_K2]));
  p = fmaL(t2, p, (floatL)(camera[CAMERA_K1]));
  return fmaL(t2 * p, t, t);
}
static inline floatL slope_of(floatL t, CAMERA_SPACE float *camera) {
  const floatL t2 = t * t;
  floatL p = fmaL(t2, (floatL)(9.0f * camera[CAMERA_K4]), (floatL)(7.0f * camera[CAMERA_K3]));
  p = fmaL(t2, p, (floatL)(5.0f * camera[CAMERA_K2]));
  p = fmaL(t2, p, (floatL)(3.0f * camera[CAMERA_K1]));
  return fmaL(t2, p, (floatL)(1.0f));
}
static inline float bend_of(float t, CAMERA_SPACE float *camera) {
  const float t2 = t * t;
  float p = fma1(t2, 72.0f * camera[CAMERA_K4], 42.0f * camera[CAMERA_K3]);
  p = fma1(t2, p, 20.0f * camera[CAMERA_K2]);
  return t * fma1(t2, p, 6.0f * camera[CAMERA_K1]);
}
// The angle of a distance from the axis by Newton's steps; the host sees to it that they arrive.
static inline floatL angle_of(floatL radius, CAMERA_SPACE float *camera) {
  const floatL fold = (floatL)(FARTHEST_ANGLE(camera));
  floatL t = radius < fold ? radius : fold;
  for (int step = 0; step < 12; ++step) {
    t = t - (radius_of(t, camera) - radius) / slope_of(t, camera);
    t = t < 0.0f ? (floatL)(0.0f) : t;
    t = t < fold ? t : fold;
  }
  return t;
}
#else
#define FARTHEST_ANGLE(camera) HALF_TURN
#define SERIES(camera) 0.0f
#define radius_of(t, camera) (t)
#endif
#endif

// The direction (x, y, z), of unit length, of pixels (px, py); all 0 where a pixel has none.
static inline void ray_of(floatL px, floatL py, CAMERA_SPACE float *camera, floatL *x, floatL *y, floatL *z) {
  const floatL a = (px - camera[CAMERA_CX]) / camera[CAMERA_FX], b = (py - camera[CAMERA_CY]) / camera[CAMERA_FY];
#if RAYS == 1
  // longitude within half a turn of the axis
  const floatL turns = floorL(fmaL(a, (floatL)(0.5f / HALF_TURN), (floatL)(0.5f)));
  const floatL longitude = fmaL(turns, (floatL)(-2.0f * HALF_TURN), a);
  const floatL away = absL(longitude), from_side = QUARTER_TURN - away;
  const floatL across = sinL(away > QUARTER_TURN ? HALF_TURN - away : away);
  const floatL level = sinL(QUARTER_TURN - absL(b));
  const floatL there = absL(b) <= QUARTER_TURN ? (floatL)(1.0f) : (floatL)(0.0f);
  *x = there * (level * (longitude < 0.0f ? -across : across));
  *y = there * sinL(there * b);
  *z = there * (level * sinL(from_side));
#elif RAYS == 3
  const floatL shrunk = 1.0f / sqrt(fmaL(a, a, fmaL(b, b, (floatL)(1.0f))));
  *x = shrunk * a;
  *y = shrunk * b;
  *z = shrunk;
#else
  const floatL theta = sqrt(fmaL(a, a, b * b));
#ifdef KANNALA_BRANDT
  const floatL there = theta < camera[CAMERA_FOLD_RADIUS] ? (floatL)(1.0f) : (floatL)(0.0f);
  const floatL angle = there * angle_of(theta, camera);
  const floatL sine = sinL(angle > QUARTER_TURN ? HALF_TURN - angle : angle);
  const floatL ratio = angle > 1e-6f ? sine / theta : (floatL)(1.0f);
#else
  const floatL there = theta <= HALF_TURN ? (floatL)(1.0f) : (floatL)(0.0f);
  const floatL angle = there * theta;
  const floatL sine = sinL(angle > QUARTER_TURN ? HALF_TURN - angle : angle);
  const floatL ratio = angle > 1e-6f ? sine / angle : (floatL)(1.0f);
#endif
  *x = there * (ratio * a);
  *y = there * (ratio * b);
  *z = there * sinL(QUARTER_TURN - angle);
#endif
}

// log2 of alpha before the cap, and where the ray (x, y, z) goes through the tangent plane at the mean's direction,
// whitened: (14).
static inline floatL offset_of_ray(floatL x, floatL y, floatL z, __global const float *splat, floatL *u, floatL *v) {
  const floatL along = fmaL(x, (floatL)(splat[RAY_FX]), fmaL(y, (floatL)(splat[RAY_FY]), z * splat[RAY_FZ]));
  // U and V are at right angles to the mean's direction: of the ray only what differs from that matters, and has its
  // digits left where the two are near
  const floatL dx = x - splat[RAY_FX], dy = y - splat[RAY_FY], dz = z - splat[RAY_FZ];
  *u = fmaL(dx, (floatL)(splat[RAY_UX]), fmaL(dy, (floatL)(splat[RAY_UY]), dz * splat[RAY_UZ])) / along;
  *v = fmaL(dx, (floatL)(splat[RAY_VX]), fmaL(dy, (floatL)(splat[RAY_VY]), dz * splat[RAY_VZ])) / along;
  const floatL power = fmaL(-*u, *u, fmaL(-*v, *v, (floatL)(splat[RAY_LOG2O])));
  return along > 0.0f ? power : (floatL)(-1e30f);
}

static inline floatL log2_alpha_of_ray(floatL x, floatL y, floatL z, __global const float *splat) {
  floatL u, v;
  return offset_of_ray(x, y, z, splat, &u, &v);
}

// The whitening on the tangent plane, of U and V.
static inline void whitening_of_ray(__global const float *splat, float *l11, float *l12, float *l22) {
  const float ux = splat[RAY_UX], uy = splat[RAY_UY], uz = splat[RAY_UZ];
  const float vx = splat[RAY_VX], vy = splat[RAY_VY], vz = splat[RAY_VZ];
  *l22 = sqrt(fma1(vx, vx, fma1(vy, vy, vz * vz)));
  *l12 = fma1(ux, vx, fma1(uy, vy, uz * vz)) / *l22;
  // along e1, which is at right angles to V and to the mean's direction
  const float fx = splat[RAY_FX], fy = splat[RAY_FY], fz = splat[RAY_FZ];
  const float wx = fma1(vy, fz, -(vz * fy)), wy = fma1(vz, fx, -(vx * fz)), wz = fma1(vx, fy, -(vy * fx));
  *l11 = fma1(ux, wx, fma1(uy, wy, uz * wz)) / *l22;
}

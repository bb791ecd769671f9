// Pixels as rays, of equirectangular (RAYS == 1) and fisheye (RAYS == 2) cameras: equations (4) and (5) of
// docs/cameras.md, in the camera's axes. Needs lanes.h; its own functions, for the same bits on every driver.
#include "shared/elementary.h"
#include "shared/angles.h"

// sin(x) for |x| up to a little over a quarter turn, to 2e-8 of it: minimax in x^2.
static inline floatL sinL(floatL x) {
  const floatL t = x * x;
  floatL p = fmaL(t, (floatL)(2.601887672e-06f), (floatL)(-1.980741217e-04f));
  p = fmaL(t, p, (floatL)(8.333025500e-03f));
  p = fmaL(t, p, (floatL)(-1.666665673e-01f));
  return fmaL(t * p, x, x);
}

static inline floatL absL(floatL x) { return x < 0.0f ? -x : x; }

// The direction (x, y, z), of unit length, of pixels (px, py); all 0 where a pixel has none.
static inline void ray_of(floatL px, floatL py, __constant float *camera, floatL *x, floatL *y, floatL *z) {
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
#else
  const floatL theta = sqrt(fmaL(a, a, b * b));
  const floatL there = theta <= HALF_TURN ? (floatL)(1.0f) : (floatL)(0.0f);
  const floatL angle = there * theta;
  const floatL sine = sinL(angle > QUARTER_TURN ? HALF_TURN - angle : angle);
  const floatL ratio = angle > 1e-6f ? sine / angle : (floatL)(1.0f);
  *x = there * (ratio * a);
  *y = there * (ratio * b);
  *z = there * sinL(QUARTER_TURN - angle);
#endif
}

// log2 of alpha before the cap: the ray (x, y, z) goes through the tangent plane at the mean's direction, (14).
static inline floatL log2_alpha_of_ray(floatL x, floatL y, floatL z, __global const float *splat) {
  const floatL along = fmaL(x, (floatL)(splat[RAY_FX]), fmaL(y, (floatL)(splat[RAY_FY]), z * splat[RAY_FZ]));
  // U and V are at right angles to the mean's direction: of the ray only what differs from that matters, and has its
  // digits left where the two are near
  const floatL dx = x - splat[RAY_FX], dy = y - splat[RAY_FY], dz = z - splat[RAY_FZ];
  const floatL u = fmaL(dx, (floatL)(splat[RAY_UX]), fmaL(dy, (floatL)(splat[RAY_UY]), dz * splat[RAY_UZ])) / along;
  const floatL v = fmaL(dx, (floatL)(splat[RAY_VX]), fmaL(dy, (floatL)(splat[RAY_VY]), dz * splat[RAY_VZ])) / along;
  const floatL power = fmaL(-u, u, fmaL(-v, v, (floatL)(splat[RAY_LOG2O])));
  return along > 0.0f ? power : (floatL)(-1e30f);
}

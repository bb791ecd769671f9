// The Kannala-Brandt fisheye, a fisheye with coefficients: the radius on the image as a function of the angle from the
// axis, equation (18) of docs/cameras.md. fisheye.h includes this file.
#define FARTHEST_ANGLE(camera) (camera)[CAMERA_FOLD]
#define IS_IN_PICTURE(radius, camera) ((radius) < (camera)[CAMERA_FOLD_RADIUS])
#define SERIES(camera) (2.0f * (camera)[CAMERA_K1])

// radius_of: the radius on the image, in focal lengths, at the angle t from the axis; slope_of, bend_of: the first and
// second derivatives of the radius.
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
// The derivative of p = 1 / slope_of with respect to the angle theta.
#define SLOPE_OF_INVERSE(theta, p, camera) (-bend_of(theta, camera) * (p) * (p))

// The angle from the axis whose radius on the image is `radius`, by Newton's method. The host has checked that the
// iteration converges.
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

#ifdef NEEDS_TANGENTS
// True if the lens shows the direction f: nothing is shown beyond the angle at which the image folds over.
static inline int is_shown(const float *f, __constant float *camera) {
  const float across = sqrt(fma1(f[0], f[0], f[1] * f[1]));
  return half_atan(across, f[2]) < FARTHEST_ANGLE(camera);
}
#endif

// Functions that all camera models with an image plane share; camera.h includes this file after the model's header.
// Image positions are linear functions of RATIO. Equation numbers refer to docs/gradients.md.

#if defined(NEEDS_PROJECTION) || defined(NEEDS_MOTION)
// Computes a coordinate on the image, focal * RATIO + centre, equation (2) of docs/gradients.md, as whole pixels
// relative to the window and a fraction (`rest`) in [0, 1). The fraction has the same bits in every window of a frame.
static inline void image_position(floatL x, floatL x_low, floatL z, floatL z_low, float focal, float focal_low,
                                  float centre, float centre_low, float window, floatL *whole, floatL *rest) {
  const floatL ratio = RATIO(x, z);
  const Double c = {(floatL)(centre),
                    fmaL((floatL)(focal), ratio_rest(ratio, x, x_low, z, z_low), (floatL)(centre_low))};
  const Double at = multiply_add2(focal, focal_low, ratio, c);
  const floatL in_frame = floorL(at.high);
  *whole = in_frame - window;
  *rest = (at.high - in_frame) + at.low;
}
#endif

#ifdef NEEDS_MOTION
// Computes a mean's position on the image, as whole pixels and fractions. Returns 0 if the mean is not beyond the near
// plane.
static inline int place_of(__constant float *camera, float x, float y, float z, float *whole, float *rest) {
  const Double at_x = CAMERA_ROW(0), at_y = CAMERA_ROW(1), at_z = CAMERA_ROW(2);
  if (!(at_z.high > camera[CAMERA_NEAR])) return 0;
  image_position(at_x.high, at_x.low, at_z.high, at_z.low, camera[CAMERA_FX], camera[CAMERA_FX_LOW], camera[CAMERA_CX],
                 camera[CAMERA_CX_LOW], camera[CAMERA_WINDOW_X], &whole[0], &rest[0]);
  image_position(at_y.high, at_y.low, at_z.high, at_z.low, camera[CAMERA_FY], camera[CAMERA_FY_LOW], camera[CAMERA_CY],
                 camera[CAMERA_CY_LOW], camera[CAMERA_WINDOW_Y], &whole[1], &rest[1]);
  return 1;
}

// The motion of a mean on the image, in pixels. Whole pixels and fractions are subtracted separately, because their sum
// in float32 would lose digits.
static inline void motion_of(__constant float *camera, __constant float *after, float x, float y, float z,
                             __global const float *to, __global const float *splat, __global float *motion) {
  float whole[2], rest[2];
  motion[0] = motion[1] = 0.0f;
  if (!place_of(after, to[0], to[1], to[2], whole, rest)) return;
#ifdef RAYS // a ray splat does not store its position
  float own_whole[2], own_rest[2];
  if (!place_of(camera, x, y, z, own_whole, own_rest)) return;
  for (int k = 0; k < 2; ++k) motion[k] = (whole[k] - own_whole[k]) + (rest[k] - own_rest[k]);
#else
  motion[0] = (whole[0] - splat[SPLAT_PIXEL_X]) + (rest[0] - splat[SPLAT_SUB_X]);
  motion[1] = (whole[1] - splat[SPLAT_PIXEL_Y]) + (rest[1] - splat[SPLAT_SUB_Y]);
#endif
}
#endif

#ifdef NEEDS_PIXEL_WIDTH
// The width of a pixel in world units at the point (x, y, z) in the camera's axes, equation (88) of docs/gradients.md
// for one view; 1e30 if the camera does not see the point.
static inline float pixel_width(float x, float y, float z, CAMERA_SPACE float *camera) {
  const int seen = z > camera[CAMERA_NEAR] && x > camera[CAMERA_XMIN] * z && x < camera[CAMERA_XMAX] * z &&
                   y > camera[CAMERA_YMIN] * z && y < camera[CAMERA_YMAX] * z;
  return seen ? z / fmax(camera[CAMERA_FX], camera[CAMERA_FY]) : 1e30f;
}
#endif

// The camera model "perspective along rays": a pinhole camera for which each Gaussian is projected to the tangent plane
// at its mean's direction, as for a fisheye. Equation numbers refer to docs/cameras.md.
#define ON_PLANE

// RATIO: the number on which the image position depends linearly. ratio_rest: the low part of RATIO.
#define RATIO(x, z) ((x) / (z))
#define ratio_rest slope_rest

// The unit direction (x, y, z) of the pixels (px, py), equation (2) of docs/cameras.md.
static inline void ray_of(floatL px, floatL py, CAMERA_SPACE float *camera, floatL *x, floatL *y, floatL *z) {
  const floatL a = (px - camera[CAMERA_CX]) / camera[CAMERA_FX], b = (py - camera[CAMERA_CY]) / camera[CAMERA_FY];
  const floatL shrunk = 1.0f / sqrt(fmaL(a, a, fmaL(b, b, (floatL)(1.0f))));
  *x = shrunk * a;
  *y = shrunk * b;
  *z = shrunk;
}

#ifdef NEEDS_TANGENTS
#define NEAR_DEPTH(z, distance) (z)
#define is_shown(f, camera) 1

// The tangent plane at the unit direction f, equations (9) and (30) of docs/cameras.md: fills *t.
static inline void tangent_of(const float *f, __constant float *camera, Tangent *t) {
  const float across = sqrt(fma1(f[0], f[0], f[1] * f[1]));
  tangent_around_axis(f, across, f[2] * f[2], 1.0f, f[2], camera, t);
}

// The gradient `by` through the low-pass part of the covariance, equation (31) of docs/cameras.md, with respect to a
// move of the mean's direction f along e1 and e2. g: the gradient with respect to the covariance's xx, xy (as one
// variable) and yy.
static inline void low_pass_gradient(const float *f, __constant float *camera, const float *g, float *by) {
  const float r = sqrt(fma1(f[0], f[0], f[1] * f[1])), z = f[2];
  low_pass_around_axis(f, r, z * z, z, -2.0f * (z * r), -r, camera, g, by);
}
#endif

#ifdef NEEDS_BOXES
#define NO_END 1e15f
#define LEAST_AHEAD 1e-4f // least z of a unit direction that can be in a picture

// The range [*low, *high] on one axis of the image, in focal lengths, of all directions within an angle of a given
// direction, equation (32) of docs/cameras.md. sine: the sine of the angle; along, z: the given direction's coordinates
// along the axis and forward. An end of the range that is behind the plane z = 0 becomes NO_END.
static inline void side_of(float along, float z, float sine, float *low, float *high) {
  const float level = sqrt(fma1(along, along, z * z));
  *low = -NO_END;
  *high = NO_END;
  if (!(sine < 0.999f * level)) return;
  const float ratio = sine / level, cosine = sqrt(1.0f - ratio * ratio);
  const float ahead_low = fma1(cosine, z, ratio * along), ahead_high = fma1(cosine, z, -(ratio * along));
  if (ahead_low > LEAST_AHEAD * level) *low = fma1(cosine, along, -(ratio * z)) / ahead_low;
  if (ahead_high > LEAST_AHEAD * level) *high = fma1(cosine, along, ratio * z) / ahead_high;
}

// The box *t of the pixels of all directions within an angle of the unit direction f. reach: the tangent of the angle.
static inline void box_of(const float *f, float reach, __constant float *camera, Box *t) {
  const float fx = camera[CAMERA_FX], fy = camera[CAMERA_FY];
  const float cx = camera[CAMERA_CX] - camera[CAMERA_WINDOW_X], cy = camera[CAMERA_CY] - camera[CAMERA_WINDOW_Y];
  const float sine = reach / sqrt(fma1(reach, reach, 1.0f));
  t->whole_rows = 0;
  side_of(f[0], f[2], sine, &t->low_x, &t->high_x);
  side_of(f[1], f[2], sine, &t->low_y, &t->high_y);
  t->low_x = fma1(fx, t->low_x, cx);
  t->high_x = fma1(fx, t->high_x, cx);
  t->low_y = fma1(fy, t->low_y, cy);
  t->high_y = fma1(fy, t->high_y, cy);
}
#endif

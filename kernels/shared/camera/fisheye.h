// The fisheye camera models: the radius on the image depends only on the angle from the axis. It is the angle itself
// (equidistant), or with BENT_FISHEYE a polynomial of the angle. Equation numbers refer to docs/cameras.md.
#ifdef BENT_FISHEYE
#include "shared/camera/bent_fisheye.h"
#else // equidistant: the radius, in focal lengths, is the angle in radians
#define FARTHEST_ANGLE(camera) HALF_TURN
#define IS_IN_PICTURE(radius, camera) ((radius) <= HALF_TURN)
#define SERIES(camera) 0.0f
#define radius_of(t, camera) (t)
#define slope_of(t, camera) 1.0f
#define SLOPE_OF_INVERSE(theta, p, camera) 0.0f
#define angle_of(radius, camera) (radius)
#define is_shown(f, camera) 1
#endif

// The unit direction (x, y, z) of the pixels (px, py), equation (4) of docs/cameras.md; (0, 0, 0) for pixels outside
// the lens's picture.
static inline void ray_of(floatL px, floatL py, CAMERA_SPACE float *camera, floatL *x, floatL *y, floatL *z) {
  const floatL a = (px - camera[CAMERA_CX]) / camera[CAMERA_FX], b = (py - camera[CAMERA_CY]) / camera[CAMERA_FY];
  const floatL radius = sqrt(fmaL(a, a, b * b));
  const floatL there = IS_IN_PICTURE(radius, camera) ? (floatL)(1.0f) : (floatL)(0.0f);
  const floatL angle = there * angle_of(radius, camera);
  const floatL sine = sinL(angle > QUARTER_TURN ? HALF_TURN - angle : angle);
  const floatL ratio = angle > 1e-6f ? sine / radius : (floatL)(1.0f);
  *x = there * (ratio * a);
  *y = there * (ratio * b);
  *z = there * sinL(QUARTER_TURN - angle);
}

#ifdef NEEDS_TANGENTS
#define NEAR_DEPTH(z, distance) (distance)

// The tangent plane at the unit direction f, equations (9), (10) and (19) of docs/cameras.md: fills *t.
static inline void tangent_of(const float *f, __constant float *camera, Tangent *t) {
  const float across = sqrt(fma1(f[0], f[0], f[1] * f[1]));
  const float theta = half_atan(across, f[2]), radius = radius_of(theta, camera);
  const float ratio = theta > 1e-6f ? across / radius : 1.0f;
  const float least = 0.5f / (HALF_TURN * camera[CAMERA_FX]);
  const float around = ratio > least ? ratio : least;
  tangent_around_axis(f, across, 1.0f, slope_of(theta, camera), around, camera, t);
}

// The gradient `by` through the low-pass part of the covariance, equations (27) and (28) of docs/cameras.md, with
// respect to a move of the mean's direction f along e1 and e2. g: the gradient with respect to the covariance's xx, xy
// (as one variable) and yy.
static inline void low_pass_gradient(const float *f, __constant float *camera, const float *g, float *by) {
  const float r = sqrt(fma1(f[0], f[0], f[1] * f[1])), z = f[2], theta = half_atan(r, z);
  const float radius = radius_of(theta, camera), slope = slope_of(theta, camera);
  const float p = 1.0f / slope, dp = SLOPE_OF_INVERSE(theta, p, camera);
  const float ratio = theta > 1e-6f ? r / radius : 1.0f, least = 0.5f / (HALF_TURN * camera[CAMERA_FX]);
  const float q = ratio > least ? ratio : least;
  // Near the axis dq is computed from a series: sin(t) / D(t) is 1 - (1/6 + k1) t^2, with D the radius at the angle t.
  const float near_axis = theta * (-1.0f / 3.0f - SERIES(camera));
  const float off_axis = fma1(-q, slope, z) / radius;
  const float dq = ratio > least ? (theta > 0.02f ? off_axis : near_axis) : 0.0f;
  low_pass_around_axis(f, r, p, q, dp, dq, camera, g, by);
}
#endif

#ifdef NEEDS_BOXES
// The box *t of the pixels of all directions within an angle of the unit direction f. reach: the tangent of the angle.
static inline void box_of(const float *f, float reach, __constant float *camera, Box *t) {
  const float fx = camera[CAMERA_FX], fy = camera[CAMERA_FY];
  const float cx = camera[CAMERA_CX] - camera[CAMERA_WINDOW_X], cy = camera[CAMERA_CY] - camera[CAMERA_WINDOW_Y];
  const float sine = reach / sqrt(fma1(reach, reach, 1.0f));
  t->whole_rows = 0;
  const float cap = quarter_atan(reach, 1.0f);
  const float across = sqrt(fma1(f[0], f[0], f[1] * f[1]));
  const float theta = half_atan(across, f[2]);
  const float far = theta + cap < FARTHEST_ANGLE(camera) ? theta + cap : FARTHEST_ANGLE(camera);
  const float outer = radius_of(far, camera);
  float middle_x = 0.0f, middle_y = 0.0f, half_x = outer, half_y = outer;
  if (sine < 0.999f * across && theta > cap && theta + cap < FARTHEST_ANGLE(camera)) {
    // The directions lie in a part of a ring around the axis, which a rectangle along the mean's direction bounds.
    const float ratio = sine / across, cosine = sqrt(1.0f - ratio * ratio);
    const float c = f[0] / across, s = f[1] / across;
    const float near = radius_of(theta - cap, camera) * cosine;
    const float middle = 0.5f * (near + outer), along = 0.5f * (outer - near), aside = outer * ratio;
    middle_x = middle * c;
    middle_y = middle * s;
    half_x = fma1(fabs(c), along, fabs(s) * aside);
    half_y = fma1(fabs(s), along, fabs(c) * aside);
  }
  t->low_x = fma1(fx, middle_x - half_x, cx);
  t->high_x = fma1(fx, middle_x + half_x, cx);
  t->low_y = fma1(fy, middle_y - half_y, cy);
  t->high_y = fma1(fy, middle_y + half_y, cy);
}
#endif

#ifdef NEEDS_MOTION
// The motion of a mean on the image, in pixels, equation (75) of docs/channels.md. The change of the angles is computed
// from the change of the coordinates, because a difference of two angles would lose small motions by rounding.
static inline void motion_of(__constant float *camera, __constant float *after, float x, float y, float z,
                             __global const float *to, __global const float *splat, __global float *motion) {
  Moved m;
  motion[0] = motion[1] = 0.0f;
  if (!move(camera, after, x, y, z, to, &m)) return;
  const float *p = m.p, *q = m.q, *d = m.d;
  const float across = sqrt(fma1(p[0], p[0], p[1] * p[1])), across_there = sqrt(fma1(q[0], q[0], q[1] * q[1]));
  // A direction straight behind the camera has no pixel.
  if (!(across > 0.0f || p[2] > 0.0f) || !(across_there > 0.0f || q[2] > 0.0f)) return;
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
}
#endif

#ifdef NEEDS_PIXEL_WIDTH
// The width of a pixel in world units at the point (x, y, z) in the camera's axes: along the radius or around the axis,
// whichever is smaller. 1e30 if the camera does not see the point.
static inline float pixel_width(float x, float y, float z, CAMERA_SPACE float *camera) {
  const float distance = sqrt(fma1(x, x, fma1(y, y, z * z)));
  const float width = distance / fmax(camera[CAMERA_FX], camera[CAMERA_FY]);
  const float across = sqrt(fma1(x, x, y * y)), theta = half_atan(across, z);
  const float radius = radius_of(theta, camera);
  const float place_x = across > 0.0f ? radius * (x / across) : 0.0f;
  const float place_y = across > 0.0f ? radius * (y / across) : 0.0f;
  const int seen = distance > camera[CAMERA_NEAR] && theta < FARTHEST_ANGLE(camera) && place_x > camera[CAMERA_XMIN] &&
                   place_x < camera[CAMERA_XMAX] && place_y > camera[CAMERA_YMIN] && place_y < camera[CAMERA_YMAX];
  const float around = theta > 1e-6f ? across / (distance * radius) : 1.0f;
  return seen ? width * fmin(1.0f / slope_of(theta, camera), around) : 1e30f;
}
#endif

// The equirectangular camera model: x on the image is proportional to longitude, y to latitude. Equation numbers refer
// to docs/cameras.md.
#define WRAPS

// The unit direction (x, y, z) of the pixels (px, py), equation (5) of docs/cameras.md; (0, 0, 0) for pixels that have
// no direction.
static inline void ray_of(floatL px, floatL py, CAMERA_SPACE float *camera, floatL *x, floatL *y, floatL *z) {
  const floatL a = (px - camera[CAMERA_CX]) / camera[CAMERA_FX], b = (py - camera[CAMERA_CY]) / camera[CAMERA_FY];
  // The longitude, moved by whole turns to within half a turn of the axis.
  const floatL turns = floorL(fmaL(a, (floatL)(0.5f / HALF_TURN), (floatL)(0.5f)));
  const floatL longitude = fmaL(turns, (floatL)(-2.0f * HALF_TURN), a);
  const floatL away = absL(longitude), from_side = QUARTER_TURN - away;
  const floatL across = sinL(away > QUARTER_TURN ? HALF_TURN - away : away);
  const floatL level = sinL(QUARTER_TURN - absL(b));
  const floatL there = absL(b) <= QUARTER_TURN ? (floatL)(1.0f) : (floatL)(0.0f);
  *x = there * (level * (longitude < 0.0f ? -across : across));
  *y = there * sinL(there * b);
  *z = there * (level * sinL(from_side));
}

#ifdef NEEDS_TANGENTS
#define NEAR_DEPTH(z, distance) (distance)
#define is_shown(f, camera) 1

// The tangent plane at the unit direction f, equations (9) and (10) of docs/cameras.md: fills *t.
static inline void tangent_of(const float *f, __constant float *camera, Tangent *t) {
  const float fx = camera[CAMERA_FX], fy = camera[CAMERA_FY];
  const float level = sqrt(fma1(f[0], f[0], f[2] * f[2]));
  const float s = level > 0.0f ? f[0] / level : 0.0f, c = level > 0.0f ? f[2] / level : 1.0f;
  t->e1[0] = c;
  t->e1[1] = 0.0f;
  t->e1[2] = -s;
  t->e2[0] = -f[1] * s;
  t->e2[1] = level;
  t->e2[2] = -f[1] * c;
  // Pixels nearer than half a row to a pole count as half a row away, because at the pole their width is 0.
  const float least = 0.5f / fy;
  t->k[0] = (level > least ? level : least) / fx;
  t->k[1] = t->k[2] = 0.0f;
  t->k[3] = 1.0f / fy;
}

// The gradient `by` through the low-pass part of the covariance, equation (26) of docs/cameras.md, with respect to a
// move of the mean's direction f along e1 and e2. g: the gradient with respect to the covariance's xx, xy (as one
// variable) and yy.
static inline void low_pass_gradient(const float *f, __constant float *camera, const float *g, float *by) {
  const float wide = 1.0f / (camera[CAMERA_FX] * camera[CAMERA_FX]);
  const float level = sqrt(fma1(f[0], f[0], f[2] * f[2])), least = 0.5f / camera[CAMERA_FY];
  const float across = level > least ? level : least;
  const float high = 1.0f / (camera[CAMERA_FY] * camera[CAMERA_FY]);
  by[0] = level > 0.0f ? 2.0f * LOW_PASS * g[1] * (f[1] / level) * fma1(across * across, wide, -high) : 0.0f;
  by[1] = level > least ? -2.0f * LOW_PASS * g[0] * (across * f[1] * wide) : 0.0f;
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
  const float level = sqrt(fma1(f[0], f[0], f[2] * f[2]));
  const float latitude = f[1] < 0.0f ? -quarter_atan(-f[1], level) : quarter_atan(f[1], level);
  const float longitude = f[0] < 0.0f ? -half_atan(-f[0], f[2]) : half_atan(f[0], f[2]);
  t->low_y = fma1(fy, latitude - cap, cy);
  t->high_y = fma1(fy, latitude + cap, cy);
  if (!(sine < 0.999f * level)) { // the box contains a pole, or nearly does
    t->whole_rows = 1;
    t->low_x = t->high_x = 0.0f;
    return;
  }
  const float ratio = sine / level;
  const float half_width = quarter_atan(ratio, sqrt(1.0f - ratio * ratio));
  t->low_x = fma1(fx, longitude - half_width, cx);
  t->high_x = fma1(fx, longitude + half_width, cx);
}
#endif

#ifdef NEEDS_MOTION
// The motion of a mean on the image, in pixels, equation (74) of docs/channels.md. The change of the angles is computed
// from the change of the coordinates, because a difference of two angles would lose small motions by rounding.
static inline void motion_of(__constant float *camera, __constant float *after, float x, float y, float z,
                             __global const float *to, __global const float *splat, __global float *motion) {
  Moved m;
  motion[0] = motion[1] = 0.0f;
  if (!move(camera, after, x, y, z, to, &m)) return;
  const float *p = m.p, *q = m.q, *d = m.d;
  const float level = sqrt(fma1(p[0], p[0], p[2] * p[2])), level_there = sqrt(fma1(q[0], q[0], q[2] * q[2]));
  const float sum = level + level_there;
  const float grown = sum > 0.0f ? fma1(d[0], p[0] + q[0], d[2] * (p[2] + q[2])) / sum : 0.0f;
  const float turned = signed_atan(fma1(d[0], p[2], -(d[2] * p[0])), fma1(p[0], q[0], p[2] * q[2]));
  const float risen = signed_atan(fma1(d[1], level, -(grown * p[1])), fma1(p[1], q[1], level * level_there));
  // Equation (6) of docs/cameras.md: the mean is drawn at the longitude nearest to the middle of the frame.
  const float middle = 0.5f * (camera[CAMERA_XMIN] + camera[CAMERA_XMAX]), longitude = signed_atan(p[0], p[2]);
  const float turns = floorL(fma1(longitude - middle, 0.5f / HALF_TURN, 0.5f));
  const float a = fma1(turns, -2.0f * HALF_TURN, longitude), b = signed_atan(p[1], level);
  motion[0] = fma1(after[CAMERA_FX], turned, fma1(GROWN(FX), a, GROWN(CX)));
  motion[1] = fma1(after[CAMERA_FY], risen, fma1(GROWN(FY), b, GROWN(CY)));
}
#endif

#ifdef NEEDS_PIXEL_WIDTH
// The width of a pixel in world units at the point (x, y, z) in the camera's axes; 1e30 if the camera does not see the
// point.
static inline float pixel_width(float x, float y, float z, CAMERA_SPACE float *camera) {
  const float distance = sqrt(fma1(x, x, fma1(y, y, z * z)));
  return distance > camera[CAMERA_NEAR] ? distance / fmax(camera[CAMERA_FX], camera[CAMERA_FY]) : 1e30f;
}
#endif

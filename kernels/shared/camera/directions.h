// Functions that all camera models along rays (RAYS) share; camera.h includes this file before the model's header.
// Equation numbers refer to docs/cameras.md.

// sin(x) for |x| up to slightly over a quarter turn, in radians, with a relative error of 2e-8: a minimax polynomial in
// x^2.
static inline floatL sinL(floatL x) {
  const floatL t = x * x;
  floatL p = fmaL(t, (floatL)(2.601887672e-06f), (floatL)(-1.980741217e-04f));
  p = fmaL(t, p, (floatL)(8.333025500e-03f));
  p = fmaL(t, p, (floatL)(-1.666665673e-01f));
  return fmaL(t * p, x, x);
}

static inline floatL absL(floatL x) { return x < 0.0f ? -x : x; }

#ifdef NEEDS_TANGENTS
// The tangent plane at a direction, for images whose radius depends only on the angle from the axis: fills *t by
// equations (9), (10), (19) and (30) of docs/cameras.md. f: the unit direction; across: the distance of f from the
// axis; along / slope: the angle in radians that fx pixels cover in the direction away from the axis; around: the angle
// that fx pixels cover around the axis.
static inline void tangent_around_axis(const float *f, float across, float along, float slope, float around,
                                       __constant float *camera, Tangent *t) {
  const float fx = camera[CAMERA_FX], fy = camera[CAMERA_FY];
  const float c = across > 0.0f ? f[0] / across : 1.0f, s = across > 0.0f ? f[1] / across : 0.0f;
  t->e1[0] = f[2] * c;
  t->e1[1] = f[2] * s;
  t->e1[2] = -across;
  t->e2[0] = -s;
  t->e2[1] = c;
  t->e2[2] = 0.0f;
  t->k[0] = c * along / fx / slope;
  t->k[1] = s * along / fy / slope;
  t->k[2] = -(s * around) / fx;
  t->k[3] = c * around / fy;
}

// The gradient `by` through the low-pass part of the covariance, with respect to a move of the mean's direction along
// e1 and e2, for the images of tangent_around_axis: equations (27) and (28) of docs/cameras.md. r: the distance of the
// direction f from the axis; p, q: along / slope and around of tangent_around_axis; dp, dq: the derivatives of p and q
// with respect to the angle from the axis; g: the gradient with respect to the covariance's xx, xy (as one variable)
// and yy.
static inline void low_pass_around_axis(const float *f, float r, float p, float q, float dp, float dq,
                                        __constant float *camera, const float *g, float *by) {
  const float wide = 1.0f / (camera[CAMERA_FX] * camera[CAMERA_FX]), z = f[2];
  const float c = r > 0.0f ? f[0] / r : 1.0f, s = r > 0.0f ? f[1] / r : 0.0f;
  const float more = 1.0f / (camera[CAMERA_FY] * camera[CAMERA_FY]) - wide;
  by[0] = 2.0f * LOW_PASS *
          (g[0] * (p * dp) * fma1(s * s, more, wide) + g[1] * fma1(dp, q, p * dq) * (c * s * more) +
           g[2] * (q * dq) * fma1(c * c, more, wide));
  const float lean = 2.0f * (c * s * more);
  const float turned = p * q * (fma1(c, c, -(s * s)) * more) +
                       z * (fma1(p, p, -(q * q)) * wide + more * (p * p * (s * s) - q * q * (c * c)));
  const float by_angle = lean * (g[0] * (p * p - p * q * z) - g[2] * (q * q - p * q * z)) + 2.0f * (g[1] * turned);
  by[1] = r > 1e-6f ? LOW_PASS * (by_angle / r) : 0.0f;
}
#endif

#ifdef NEEDS_MOTION
typedef struct {
  Double at[3];
} InCamera;

static inline InCamera in_camera(__constant float *camera, float x, float y, float z) {
  const InCamera p = {{CAMERA_ROW(0), CAMERA_ROW(1), CAMERA_ROW(2)}};
  return p;
}

// A mean in the camera's axes: p before the motion, q after the motion, and d, the difference q - p.
typedef struct {
  float p[3], q[3], d[3];
} Moved;

// Computes the motion of a mean in the camera's axes, in *m: from (x, y, z) seen by `camera` to `to` seen by `after`.
// Returns 0 if the mean is, after the motion, nearer than the near plane of `after`, or too far away (1e15).
static inline int move(__constant float *camera, __constant float *after, float x, float y, float z,
                       __global const float *to, Moved *m) {
  const InCamera here = in_camera(camera, x, y, z), there = in_camera(after, to[0], to[1], to[2]);
  for (int k = 0; k < 3; ++k) {
    m->p[k] = here.at[k].high;
    m->q[k] = there.at[k].high;
    m->d[k] = subtract2(there.at[k], here.at[k]).high;
  }
  const float distance = sqrt(fma1(m->q[0], m->q[0], fma1(m->q[1], m->q[1], m->q[2] * m->q[2])));
  return distance > after[CAMERA_NEAR] && distance < 1e15f;
}

// The change of the camera's value `name` from `camera` to `after`.
#define GROWN(name)                                                                                                    \
  ((after[CAMERA_##name] - camera[CAMERA_##name]) + (after[CAMERA_##name##_LOW] - camera[CAMERA_##name##_LOW]))
#endif

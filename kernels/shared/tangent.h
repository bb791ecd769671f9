// From a Gaussian's parameters to its ellipse on the plane that touches the sphere of directions at its mean's, which
// projection and its gradient both need; and what a pixel is on that plane, with its derivative. Scalars: built with
// one lane. Equation numbers are those of docs/cameras.md. Needs gaussian.h, angles.h and rays.h.

typedef struct {
  float e1[3], e2[3]; // right and down on the tangent plane
  float k[4];         // tangent plane by pixels: what one pixel is there
} Tangent;

typedef struct {
  float f[3], distance; // direction and distance of the mean, in the camera
  Tangent t;
  float q[4], length;       // unit quaternion, and the length of the raw one
  float a[9];               // the Gaussian's axes in the camera, in columns
  float s[3];               // scales
  float c1[3], c2[3];       // the axes along e1 and e2
  float m1[5], m2[5];       // M, and the low-pass as two columns more
  float sxx, sxy, syy, det; // covariance with the low-pass
#ifdef ANTIALIASED
  float det0; // without it
#endif
} RayProjection;

// (10), f: the direction.
static inline void tangent_of(const float *f, __constant float *camera, Tangent *t) {
  const float fx = camera[CAMERA_FX], fy = camera[CAMERA_FY];
#if RAYS == 1
  const float level = sqrt(fma1(f[0], f[0], f[2] * f[2]));
  const float s = level > 0.0f ? f[0] / level : 0.0f, c = level > 0.0f ? f[2] / level : 1.0f;
  t->e1[0] = c;
  t->e1[1] = 0.0f;
  t->e1[2] = -s;
  t->e2[0] = -f[1] * s;
  t->e2[1] = level;
  t->e2[2] = -f[1] * c;
  const float least = 0.5f / fy; // half a row from the pole, where a pixel is a point
  t->k[0] = (level > least ? level : least) / fx;
  t->k[1] = t->k[2] = 0.0f;
  t->k[3] = 1.0f / fy;
#else
  const float across = sqrt(fma1(f[0], f[0], f[1] * f[1]));
  const float c = across > 0.0f ? f[0] / across : 1.0f, s = across > 0.0f ? f[1] / across : 0.0f;
  t->e1[0] = f[2] * c;
  t->e1[1] = f[2] * s;
  t->e1[2] = -across;
  t->e2[0] = -s;
  t->e2[1] = c;
  t->e2[2] = 0.0f;
#if RAYS == 3 // (30)
  t->k[0] = c * (f[2] * f[2]) / fx;
  t->k[1] = s * (f[2] * f[2]) / fy;
  t->k[2] = -(s * f[2]) / fx;
  t->k[3] = c * f[2] / fy;
#else
  const float theta = half_atan(across, f[2]), radius = radius_of(theta, camera);
  const float ratio = theta > 1e-6f ? across / radius : 1.0f;
  const float least = 0.5f / (HALF_TURN * fx);
  const float around = ratio > least ? ratio : least;
  t->k[0] = c / fx;
  t->k[1] = s / fy;
#ifdef KANNALA_BRANDT
  const float slope = slope_of(theta, camera);
  t->k[0] /= slope;
  t->k[1] /= slope;
#endif
  t->k[2] = -(s * around) / fx;
  t->k[3] = c * around / fy;
#endif
#endif
}

// (8) to (12); returns 0 where the Gaussian is culled. Conditions are positive, so that NaN culls.
static inline int project_ray(size_t i, __global const float *means, __global const float *quaternions,
                              __global const float *log_scales, __constant float *camera, RayProjection *p) {
  const float x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
  const Double in_x = CAMERA_ROW(0), in_y = CAMERA_ROW(1), in_z = CAMERA_ROW(2);
  const float at[3] = {in_x.high, in_y.high, in_z.high};
  const float distance = sqrt(fma1(at[0], at[0], fma1(at[1], at[1], at[2] * at[2])));
  const float depth = RAYS == 3 ? at[2] : distance;
  if (!(depth > camera[CAMERA_NEAR] && depth < camera[CAMERA_FAR] && distance < 1e15f)) return 0;
  p->distance = distance;
  for (int k = 0; k < 3; ++k) p->f[k] = at[k] / distance;
#ifdef KANNALA_BRANDT // beyond the fold-over a lens shows nothing
  const float across = sqrt(fma1(p->f[0], p->f[0], p->f[1] * p->f[1]));
  if (!(half_atan(across, p->f[2]) < FARTHEST_ANGLE(camera))) return 0;
#endif
  tangent_of(p->f, camera, &p->t);

  // (11), (12): M = e A S / distance, and the low-pass as two columns more; the determinant by its minors.
  const Tangent t = p->t;
  __global const float *raw = quaternions + 4 * i;
  float norm2 = 0.0f, r[9];
  for (int k = 0; k < 4; ++k) norm2 = fma1(raw[k], raw[k], norm2);
  if (!(norm2 > 1e-30f && norm2 < 1e30f)) return 0;
  p->length = sqrt(norm2);
  for (int k = 0; k < 4; ++k) p->q[k] = raw[k] / p->length;
  rotation_of(p->q, r);
  for (int k = 0; k < 3; ++k) {
    p->s[k] = expL(log_scales[3 * i + k]);
    const float scale = p->s[k] / distance;
    float a[3]; // the axis in the camera
    for (int row = 0; row < 3; ++row)
      p->a[3 * row + k] = a[row] =
          fma1(camera[CAMERA_R00 + 3 * row], r[k],
               fma1(camera[CAMERA_R01 + 3 * row], r[3 + k], camera[CAMERA_R02 + 3 * row] * r[6 + k]));
    p->c1[k] = fma1(t.e1[0], a[0], fma1(t.e1[1], a[1], t.e1[2] * a[2]));
    p->c2[k] = fma1(t.e2[0], a[0], fma1(t.e2[1], a[1], t.e2[2] * a[2]));
    p->m1[k] = scale * p->c1[k];
    p->m2[k] = scale * p->c2[k];
  }
  const float blur = sqrt(LOW_PASS);
  for (int k = 0; k < 2; ++k) {
    p->m1[3 + k] = blur * t.k[k];
    p->m2[3 + k] = blur * t.k[2 + k];
  }
  p->sxx = p->sxy = p->syy = p->det = 0.0f;
#ifdef ANTIALIASED
  p->det0 = 0.0f;
#endif
  for (int k = 0; k < 5; ++k) {
    p->sxx = fma1(p->m1[k], p->m1[k], p->sxx);
    p->sxy = fma1(p->m1[k], p->m2[k], p->sxy);
    p->syy = fma1(p->m2[k], p->m2[k], p->syy);
    for (int l = 0; l < k; ++l) {
      const float minor = fma1(p->m1[k], p->m2[l], -(p->m1[l] * p->m2[k]));
      p->det = fma1(minor, minor, p->det);
#ifdef ANTIALIASED
      if (k < 3) p->det0 = fma1(minor, minor, p->det0);
#endif
    }
  }
  return p->sxx < 1e15f && p->syy < 1e15f && p->syy > 0.0f && p->det > 0.0f && p->det < 1e30f;
}

// The part along the mean's direction of the Gaussian's axis k.
static inline float depth_of_axis(const RayProjection *p, int k) {
  return fma1(p->f[0], p->a[k], fma1(p->f[1], p->a[3 + k], p->f[2] * p->a[6 + k]));
}

// The minor of M without its scales that has the axes beside k.
static inline float minor_of_axis(const RayProjection *p, __constant float *camera, int k) {
  const float inverse = 1.0f / p->distance;
  return camera[CAMERA_HAND] * depth_of_axis(p, k) * (inverse * inverse);
}

// (26) to (28): the gradient by a step of the mean's direction along e1 and e2 of what the low-pass adds to the
// covariance; g: the gradient by the covariance's xx, xy (once) and yy.
static inline void low_pass_gradient(const float *f, __constant float *camera, const float *g, float *by) {
  const float wide = 1.0f / (camera[CAMERA_FX] * camera[CAMERA_FX]);
#if RAYS == 1
  const float level = sqrt(fma1(f[0], f[0], f[2] * f[2])), least = 0.5f / camera[CAMERA_FY];
  const float across = level > least ? level : least;
  const float high = 1.0f / (camera[CAMERA_FY] * camera[CAMERA_FY]);
  by[0] = level > 0.0f ? 2.0f * LOW_PASS * g[1] * (f[1] / level) * fma1(across * across, wide, -high) : 0.0f;
  by[1] = level > least ? -2.0f * LOW_PASS * g[0] * (across * f[1] * wide) : 0.0f;
#else
  const float r = sqrt(fma1(f[0], f[0], f[1] * f[1])), z = f[2];
  const float c = r > 0.0f ? f[0] / r : 1.0f, s = r > 0.0f ? f[1] / r : 0.0f;
  const float more = 1.0f / (camera[CAMERA_FY] * camera[CAMERA_FY]) - wide;
#if RAYS == 3 // (31)
  const float p = z * z, q = z, dp = -2.0f * (z * r), dq = -r;
#else
  const float theta = half_atan(r, z);
  float p = 1.0f, dp = 0.0f, radius = theta, slope = 1.0f;
#ifdef KANNALA_BRANDT
  radius = radius_of(theta, camera);
  slope = slope_of(theta, camera);
  p = 1.0f / slope;
  dp = -bend_of(theta, camera) * p * p;
#endif
  const float ratio = theta > 1e-6f ? r / radius : 1.0f, least = 0.5f / (HALF_TURN * camera[CAMERA_FX]);
  const float q = ratio > least ? ratio : least;
  // near the axis the difference by its series: sin(t) / D(t) is 1 - (1/6 + k1) t^2
  const float near_axis = theta * (-1.0f / 3.0f - SERIES(camera));
  const float off_axis = fma1(-q, slope, z) / radius;
  const float dq = ratio > least ? (theta > 0.02f ? off_axis : near_axis) : 0.0f;
#endif
  by[0] = 2.0f * LOW_PASS *
          (g[0] * (p * dp) * fma1(s * s, more, wide) + g[1] * fma1(dp, q, p * dq) * (c * s * more) +
           g[2] * (q * dq) * fma1(c * c, more, wide));
  const float lean = 2.0f * (c * s * more);
  const float turned = p * q * (fma1(c, c, -(s * s)) * more) +
                       z * (fma1(p, p, -(q * q)) * wide + more * (p * p * (s * s) - q * q * (c * c)));
  const float by_angle = lean * (g[0] * (p * p - p * q * z) - g[2] * (q * q - p * q * z)) + 2.0f * (g[1] * turned);
  by[1] = r > 1e-6f ? LOW_PASS * (by_angle / r) : 0.0f;
#endif
}

// Projects a Gaussian to an ellipse on the plane that touches the sphere of directions at the Gaussian's mean.
// Projection and its gradient share this code. Built with one lane. Equation numbers refer to docs/cameras.md. Before
// this file, define NEEDS_TANGENTS (camera.h) and include gaussian.h.

typedef struct {
  float f[3], distance; // unit direction and distance of the mean, in the camera's axes
  Tangent t;
  float q[4], length;       // unit quaternion, and length of the raw quaternion
  float a[9];               // the Gaussian's axes in the camera's axes, as columns of a 3x3 matrix
  float s[3];               // scales
  float c1[3], c2[3];       // components of the Gaussian's axes along e1 and e2
  float m1[5], m2[5];       // the rows of M of equation (11) of docs/cameras.md, with two more columns for the low-pass
  float sxx, sxy, syy, det; // covariance with the low-pass
#ifdef ANTIALIASED
  float det0; // determinant without the low-pass
#endif
} RayProjection;

// Projects Gaussian i, equations (8) to (12) of docs/cameras.md: fills *p, and returns 0 if the Gaussian is culled.
// Conditions are written so that NaN culls.
static inline int project_ray(size_t i, PARAMETER *means, PARAMETER *quaternions, PARAMETER *log_scales,
                              __constant float *camera, RayProjection *p) {
  const float x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
  const Double in_x = CAMERA_ROW(0), in_y = CAMERA_ROW(1), in_z = CAMERA_ROW(2);
  const float at[3] = {in_x.high, in_y.high, in_z.high};
  const float distance = sqrt(fma1(at[0], at[0], fma1(at[1], at[1], at[2] * at[2])));
  const float depth = NEAR_DEPTH(at[2], distance);
  if (!(depth > camera[CAMERA_NEAR] && depth < camera[CAMERA_FAR] && distance < 1e15f)) return 0;
  p->distance = distance;
  for (int k = 0; k < 3; ++k) p->f[k] = at[k] / distance;
  if (!is_shown(p->f, camera)) return 0;
  tangent_of(p->f, camera, &p->t);

  // Equations (11), (12) of docs/cameras.md: M = e A S / distance, with two more columns for the low-pass. The
  // determinant is the sum of the squared minors.
  const Tangent t = p->t;
  PARAMETER *raw = quaternions + 4 * i;
  float norm2 = 0.0f, r[9];
  for (int k = 0; k < 4; ++k) norm2 = fma1(raw[k], raw[k], norm2);
  if (!(norm2 > 1e-30f && norm2 < 1e30f)) return 0;
  p->length = sqrt(norm2);
  for (int k = 0; k < 4; ++k) p->q[k] = raw[k] / p->length;
  rotation_of(p->q, r);
  for (int k = 0; k < 3; ++k) {
    p->s[k] = expL(log_scales[3 * i + k]);
    const float scale = p->s[k] / distance;
    float a[3]; // the Gaussian's axis k in the camera's axes
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

// The component of the Gaussian's axis k along the mean's direction.
static inline float depth_of_axis(const RayProjection *p, int k) {
  return fma1(p->f[0], p->a[k], fma1(p->f[1], p->a[3 + k], p->f[2] * p->a[6 + k]));
}

// The minor of M that omits the Gaussian's axis k, without the factors of the scales.
static inline float minor_of_axis(const RayProjection *p, __constant float *camera, int k) {
  const float inverse = 1.0f / p->distance;
  return camera[CAMERA_HAND] * depth_of_axis(p, k) * (inverse * inverse);
}

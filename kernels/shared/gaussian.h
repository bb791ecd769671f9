// From a Gaussian's parameters to its ellipse on the image: what projection and its gradient both need.
// Equation numbers are those of docs/gradients.md.

typedef struct {
  float x, y, z;        // mean in the camera's frame
  float lx, ly, lz;     // what rounding it to float32 left
  float rx, ry;         // x/z and y/z as the Jacobian takes them, clamped
  float jx, jy, kx, ky; // Jacobian: rows (jx, 0, kx) and (0, jy, ky)
  float q[4];           // unit quaternion w x y z
  float length;         // of the raw one
  float a[9];           // camera from Gaussian rotation, a[3 * row + column]
  float b1[3], b2[3];   // the two rows of J a
  float s[3];           // scales
  float sxx, sxy, syy;  // projected covariance with the low-pass
  float det;
} Projection;

static inline void rotation_of(const float *q, float *r) {
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  r[0] = 1.0f - 2.0f * (y * y + z * z);
  r[1] = 2.0f * (x * y - w * z);
  r[2] = 2.0f * (x * z + w * y);
  r[3] = 2.0f * (x * y + w * z);
  r[4] = 1.0f - 2.0f * (x * x + z * z);
  r[5] = 2.0f * (y * z - w * x);
  r[6] = 2.0f * (x * z - w * y);
  r[7] = 2.0f * (y * z + w * x);
  r[8] = 1.0f - 2.0f * (x * x + y * y);
}

// Row of cam_from_world times the mean (x, y, z). In float32 alone this would cost 1e-4 pixels, and a pixel at the edge
// of an ellipse flips over that.
#define CAMERA_ROW(row)                                                                                               \
  camera_row(camera + CAMERA_R##row##0, camera + CAMERA_R##row##0_LOW, camera[CAMERA_T##row],                         \
             camera[CAMERA_T##row##_LOW], x, y, z)

static inline Double camera_row(__constant float *r, __constant float *r_low, float t, float t_low, float x, float y,
                                float z) {
  Double sum = {t, t_low};
  sum = multiply_add2(r[0], r_low[0], x, sum);
  sum = multiply_add2(r[1], r_low[1], y, sum);
  return multiply_add2(r[2], r_low[2], z, sum);
}

// (2): focal * (x / z) + centre, as whole pixels and the rest in [0, 1).
static inline void image_position(float x, float x_low, float z, float z_low, float focal, float focal_low,
                                  float centre, float centre_low, __global float *whole, __global float *rest) {
  const float ratio = x / z;
  const float ratio_low = (fma1(-ratio, z, x) + fma1(-ratio, z_low, x_low)) / z;
  const Double c = {centre, fma1(focal, ratio_low, centre_low)};
  const Double at = multiply_add2(focal, focal_low, ratio, c);
  const float floored = floor(at.high);
  *whole = floored;
  *rest = (at.high - floored) + at.low;
}

// Fills *p: (1), (3) to (7). Returns 0 where the Gaussian is to be culled; conditions are positive, so that NaN culls.
static inline int project_gaussian(__global const float *mean, __global const float *quaternion,
                                   __global const float *log_scale, __constant float *camera, Projection *p) {
  const float x = mean[0], y = mean[1], z = mean[2];
  const Double in_x = CAMERA_ROW(0), in_y = CAMERA_ROW(1), in_z = CAMERA_ROW(2);
  p->x = in_x.high;
  p->y = in_y.high;
  p->z = in_z.high;
  p->lx = in_x.low;
  p->ly = in_y.low;
  p->lz = in_z.low;
  if (!(p->z > camera[CAMERA_NEAR])) return 0;

  float norm2 = 0.0f;
  for (int i = 0; i < 4; ++i) norm2 = fma1(quaternion[i], quaternion[i], norm2);
  if (!(norm2 > 1e-30f && norm2 < 1e30f)) return 0;
  p->length = sqrt(norm2);
  for (int i = 0; i < 4; ++i) p->q[i] = quaternion[i] / p->length;
  float r[9];
  rotation_of(p->q, r);
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column)
      p->a[3 * row + column] =
          fma1(camera[CAMERA_R00 + 3 * row], r[column],
               fma1(camera[CAMERA_R01 + 3 * row], r[3 + column], camera[CAMERA_R02 + 3 * row] * r[6 + column]));
  for (int k = 0; k < 3; ++k) p->s[k] = exp1(log_scale[k]);

  const float rx = p->x / p->z, ry = p->y / p->z;
  p->rx = rx < camera[CAMERA_XMIN] ? camera[CAMERA_XMIN] : (rx > camera[CAMERA_XMAX] ? camera[CAMERA_XMAX] : rx);
  p->ry = ry < camera[CAMERA_YMIN] ? camera[CAMERA_YMIN] : (ry > camera[CAMERA_YMAX] ? camera[CAMERA_YMAX] : ry);
  p->jx = camera[CAMERA_FX] / p->z;
  p->jy = camera[CAMERA_FY] / p->z;
  p->kx = -p->jx * p->rx;
  p->ky = -p->jy * p->ry;

  // (5) to (7): the square root M = J A S. Its entries give the covariance; the minors of its columns give the
  // determinant as a sum of squares, where sxx * syy - sxy * sxy would cancel for a needle.
  float m1[3], m2[3];
  for (int k = 0; k < 3; ++k) {
    p->b1[k] = fma1(p->jx, p->a[k], p->kx * p->a[6 + k]);
    p->b2[k] = fma1(p->jy, p->a[3 + k], p->ky * p->a[6 + k]);
    m1[k] = p->s[k] * p->b1[k];
    m2[k] = p->s[k] * p->b2[k];
  }
  const float xx = fma1(m1[0], m1[0], fma1(m1[1], m1[1], m1[2] * m1[2]));
  const float yy = fma1(m2[0], m2[0], fma1(m2[1], m2[1], m2[2] * m2[2]));
  p->sxx = xx + LOW_PASS;
  p->syy = yy + LOW_PASS;
  p->sxy = fma1(m1[0], m2[0], fma1(m1[1], m2[1], m1[2] * m2[2]));
  float det = fma1(LOW_PASS, xx + yy, LOW_PASS * LOW_PASS);
  for (int k = 0; k < 3; ++k) {
    const int l = k == 2 ? 0 : k + 1;
    const float minor = p->s[k] * p->s[l] * fma1(p->b1[k], p->b2[l], -(p->b1[l] * p->b2[k]));
    det = fma1(minor, minor, det);
  }
  p->det = det;
  return p->sxx < 1e30f && p->syy < 1e30f && det > 0.0f && det < 1e30f;
}

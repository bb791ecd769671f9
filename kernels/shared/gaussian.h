// From LANES Gaussians' parameters to their ellipses on the image: what projection and its gradient both need.
// Equation numbers are those of docs/gradients.md.

typedef struct {
  intL valid;            // not to be culled
  floatL x, y, z;        // mean in the camera's frame
  floatL lx, ly, lz;     // what rounding it to float32 left
  floatL rx, ry;         // x/z and y/z as the Jacobian takes them, clamped
  floatL jx, jy, kx, ky; // Jacobian: rows (jx, 0, kx) and (0, jy, ky)
  floatL q[4];           // unit quaternion w x y z
  floatL length;         // of the raw one
  floatL a[9];           // camera from Gaussian rotation, a[3 * row + column]
  floatL b1[3], b2[3];   // the two rows of J a
  floatL s[3];           // scales
  floatL sxx, sxy, syy;  // projected covariance with the low-pass
  floatL det;
} Projection;

static inline void rotation_of(const floatL *q, floatL *r) {
  const floatL w = q[0], x = q[1], y = q[2], z = q[3];
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
#define CAMERA_ROW(index)                                                                                             \
  camera_row(camera + CAMERA_R##index##0, camera + CAMERA_R##index##0_LOW, camera[CAMERA_T##index],                   \
             camera[CAMERA_T##index##_LOW], x, y, z)

static inline Double camera_row(__constant float *r, __constant float *r_low, float t, float t_low, floatL x, floatL y,
                                floatL z) {
  Double sum = {(floatL)(t), (floatL)(t_low)};
  sum = multiply_add2(r[0], r_low[0], x, sum);
  sum = multiply_add2(r[1], r_low[1], y, sum);
  return multiply_add2(r[2], r_low[2], z, sum);
}

// (2): focal * (x / z) + centre, as whole pixels from the window's first and the rest in [0, 1): the rest has the same bits
// in every window.
static inline void image_position(floatL x, floatL x_low, floatL z, floatL z_low, float focal, float focal_low,
                                  float centre, float centre_low, float window, floatL *whole, floatL *rest) {
  const floatL ratio = x / z;
  const floatL ratio_low = (fmaL(-ratio, z, x) + fmaL(-ratio, z_low, x_low)) / z;
  const Double c = {(floatL)(centre), fmaL((floatL)(focal), ratio_low, (floatL)(centre_low))};
  const Double at = multiply_add2(focal, focal_low, ratio, c);
  const floatL in_frame = floorL(at.high);
  *whole = in_frame - window;
  *rest = (at.high - in_frame) + at.low;
}

// x within [low, high], and NaN as it is.
static inline floatL clampL(floatL x, float low, float high) {
  const floatL above = x < low ? (floatL)(low) : x;
  return above > high ? (floatL)(high) : above;
}

// Fills *p: (1), (3) to (7). Conditions are positive, so that NaN culls. `row` as ROWS_OF_ITEM makes it. Returns 0 where
// every one is culled.
static inline int project_gaussians(const uint *row, __global const float *means, __global const float *quaternions,
                                    __global const float *log_scales, __constant float *camera, Projection *p) {
  const floatL x = GATHER(means, 3, 0), y = GATHER(means, 3, 1), z = GATHER(means, 3, 2);
  const Double in_x = CAMERA_ROW(0), in_y = CAMERA_ROW(1), in_z = CAMERA_ROW(2);
  p->x = in_x.high;
  p->y = in_y.high;
  p->z = in_z.high;
  p->lx = in_x.low;
  p->ly = in_y.low;
  p->lz = in_z.low;
  p->valid = p->z > camera[CAMERA_NEAR];
  if (!ANYL(p->valid)) return 0;

  floatL raw[4], norm2 = (floatL)(0.0f);
  raw[0] = GATHER(quaternions, 4, 0);
  raw[1] = GATHER(quaternions, 4, 1);
  raw[2] = GATHER(quaternions, 4, 2);
  raw[3] = GATHER(quaternions, 4, 3);
  for (int i = 0; i < 4; ++i) norm2 = fmaL(raw[i], raw[i], norm2);
  p->valid &= (norm2 > 1e-30f) & (norm2 < 1e30f);
  p->length = sqrt(norm2);
  for (int i = 0; i < 4; ++i) p->q[i] = raw[i] / p->length;
  floatL r[9];
  rotation_of(p->q, r);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      p->a[3 * i + j] =
          fmaL((floatL)(camera[CAMERA_R00 + 3 * i]), r[j],
               fmaL((floatL)(camera[CAMERA_R01 + 3 * i]), r[3 + j], camera[CAMERA_R02 + 3 * i] * r[6 + j]));
  p->s[0] = expL(GATHER(log_scales, 3, 0));
  p->s[1] = expL(GATHER(log_scales, 3, 1));
  p->s[2] = expL(GATHER(log_scales, 3, 2));

  p->rx = clampL(p->x / p->z, camera[CAMERA_XMIN], camera[CAMERA_XMAX]);
  p->ry = clampL(p->y / p->z, camera[CAMERA_YMIN], camera[CAMERA_YMAX]);
  p->jx = camera[CAMERA_FX] / p->z;
  p->jy = camera[CAMERA_FY] / p->z;
  p->kx = -p->jx * p->rx;
  p->ky = -p->jy * p->ry;

  // (5) to (7): the square root M = J A S. Its entries give the covariance; the minors of its columns give the
  // determinant as a sum of squares, where sxx * syy - sxy * sxy would cancel for a needle.
  floatL m1[3], m2[3];
  for (int k = 0; k < 3; ++k) {
    p->b1[k] = fmaL(p->jx, p->a[k], p->kx * p->a[6 + k]);
    p->b2[k] = fmaL(p->jy, p->a[3 + k], p->ky * p->a[6 + k]);
    m1[k] = p->s[k] * p->b1[k];
    m2[k] = p->s[k] * p->b2[k];
  }
  const floatL xx = fmaL(m1[0], m1[0], fmaL(m1[1], m1[1], m1[2] * m1[2]));
  const floatL yy = fmaL(m2[0], m2[0], fmaL(m2[1], m2[1], m2[2] * m2[2]));
  p->sxx = xx + LOW_PASS;
  p->syy = yy + LOW_PASS;
  p->sxy = fmaL(m1[0], m2[0], fmaL(m1[1], m2[1], m1[2] * m2[2]));
  floatL det = fmaL((floatL)(LOW_PASS), xx + yy, (floatL)(LOW_PASS * LOW_PASS));
  for (int k = 0; k < 3; ++k) {
    const int l = k == 2 ? 0 : k + 1;
    const floatL minor = p->s[k] * p->s[l] * fmaL(p->b1[k], p->b2[l], -(p->b1[l] * p->b2[k]));
    det = fmaL(minor, minor, det);
  }
  p->det = det;
  p->valid &= (p->sxx < 1e30f) & (p->syy < 1e30f) & (det > 0.0f) & (det < 1e30f);
  return 1;
}

// From LANES Gaussians' parameters to their ellipses on the image: what projection and its gradient both need.
// Equation numbers are those of docs/gradients.md. With ORTHOGRAPHIC the image is linear in x and y, not in x/z and y/z
// (docs/cameras.md, equations 15 to 17).

#include "shared/place.h"

// px^2 added to the projected covariance, and with ANTIALIASED the least that (83) makes of an opacity.
#ifdef ANTIALIASED
#define LOW_PASS 0.1f
#define LEAST_COMPENSATION 0.005f
#else
#define LOW_PASS 0.3f
#endif

typedef struct {
  intL valid;           // not to be culled
  floatL x, y, z;       // mean in the camera's frame
  floatL lx, ly, lz;    // what rounding it to float32 left
  floatL rx, ry;        // x/z and y/z as the Jacobian takes them, clamped; orthographic: 0
  floatL jx, jy;        // the Jacobian's rows are jx (1, 0, -rx) and jy (0, 1, -ry)
  floatL q[4];          // unit quaternion w x y z
  floatL length;        // of the raw one
  floatL a2[3];         // the last row of the camera from Gaussian rotation A: its axes' depths
  floatL b1[3], b2[3];  // the two rows of J A
  floatL c[3];          // their minors: b1[k] b2[l] - b1[l] b2[k] is c[m], for k, l, m in turn
  floatL s[3];          // scales
  floatL sxx, sxy, syy; // projected covariance with the low-pass
  floatL det;
#ifdef ANTIALIASED
  floatL det0; // without the low-pass
#endif
} Projection;

// Row of cam_from_world times the mean (x, y, z). In float32 alone this would cost 1e-4 pixels, and a pixel at the edge
// of an ellipse flips over that.
#define CAMERA_ROW(index)                                                                                              \
  camera_row(camera + CAMERA_R##index##0, camera + CAMERA_R##index##0_LOW, camera[CAMERA_T##index],                    \
             camera[CAMERA_T##index##_LOW], x, y, z)

// (2): focal * (x / z) + centre, as whole pixels from the window's first and the rest in [0, 1): the rest has the same
// bits in every window.
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

// From the camera's centre to the mean, along a world axis.
#define FROM_CAMERA(means, axis, index)                                                                                \
  ((GATHER(means, 3, index) - camera[CAMERA_P##axis]) - camera[CAMERA_P##axis##_LOW])

// (5) to (7) from J A and S, with the determinant as a sum of squares (56).
static inline void covariance(Projection *p) {
  floatL xx = (floatL)(0.0f), yy = xx, xy = xx, minors = (floatL)(LOW_PASS * LOW_PASS);
#ifdef ANTIALIASED
  p->det0 = (floatL)(0.0f);
#endif
  FOR_AXES(k) {
    const floatL m1 = p->s[k] * p->b1[k], m2 = p->s[k] * p->b2[k];
    xx = fmaL(m1, m1, xx);
    yy = fmaL(m2, m2, yy);
    xy = fmaL(m1, m2, xy);
    const floatL minor = p->s[(k + 1) % 3] * p->s[(k + 2) % 3] * p->c[k];
    minors = fmaL(minor, minor, minors);
#ifdef ANTIALIASED
    p->det0 = fmaL(minor, minor, p->det0);
#endif
  }
  p->sxx = xx + LOW_PASS;
  p->syy = yy + LOW_PASS;
  p->sxy = xy;
  p->det = fmaL((floatL)(LOW_PASS), xx + yy, minors);
}

#ifdef ANTIALIASED
// (83): what the low-pass thickens, opacity makes up for. det0, det: the covariance's determinant without it and with.
static inline floatL compensation(floatL det0, floatL det) {
  const floatL part = det0 / det;
  return part > LEAST_COMPENSATION * LEAST_COMPENSATION ? sqrt(part) : (floatL)(LEAST_COMPENSATION);
}
#endif

// The rest of x/z as the Jacobian takes it: of a limit where it is clamped.
static inline floatL clamped_rest(floatL ratio, floatL x, floatL x_low, floatL z, floatL z_low, float low,
                                  float low_rest, float high, float high_rest) {
#ifdef ORTHOGRAPHIC
  return (floatL)(0.0f);
#else
  const floatL rest = ratio_rest(ratio, x, x_low, z, z_low);
  const floatL above = ratio == low ? (floatL)(low_rest) : rest;
  return ratio == high ? (floatL)(high_rest) : above;
#endif
}

// (57): J A and its minors once more, in two floats up to where nothing cancels any more, for the lanes of `which`.
static inline void refine(const uint *row, __global const float *quaternions, __constant float *camera, intL which,
                          Projection *p) {
  Double r[9];
  const floatL length = rotation2_of(row, quaternions, p->length, r);
  const Double rx = {p->rx, clamped_rest(p->rx, p->x, p->lx, p->z, p->lz, camera[CAMERA_XMIN], camera[CAMERA_XMIN_LOW],
                                         camera[CAMERA_XMAX], camera[CAMERA_XMAX_LOW])};
  const Double ry = {p->ry, clamped_rest(p->ry, p->y, p->ly, p->z, p->lz, camera[CAMERA_YMIN], camera[CAMERA_YMIN_LOW],
                                         camera[CAMERA_YMAX], camera[CAMERA_YMAX_LOW])};
  const floatL along_x = p->jx / (length * length), along_y = p->jy / (length * length);
  const floatL area = camera[CAMERA_HAND] * p->jx * along_y;
  FOR_AXES(k) {
    Double a[3];
    FOR_AXES(i) {
      a[i] = scaled2(camera[CAMERA_R00 + 3 * i], camera[CAMERA_R00_LOW + 3 * i], r[k]);
      a[i] = add2(a[i], scaled2(camera[CAMERA_R01 + 3 * i], camera[CAMERA_R01_LOW + 3 * i], r[3 + k]));
      a[i] = add2(a[i], scaled2(camera[CAMERA_R02 + 3 * i], camera[CAMERA_R02_LOW + 3 * i], r[6 + k]));
    }
    const floatL b1 = along_x * subtract2(a[0], multiply2(rx, a[2])).high;
    const floatL b2 = along_y * subtract2(a[1], multiply2(ry, a[2])).high;
    const floatL c = area * add2(add2(multiply2(rx, a[0]), multiply2(ry, a[1])), a[2]).high;
    p->b1[k] = which ? b1 : p->b1[k];
    p->b2[k] = which ? b2 : p->b2[k];
    p->c[k] = which ? c : p->c[k];
  }
}

// Fills *p: (1), (3) to (7). Conditions are positive, so that NaN culls. `row` as ROWS_OF_ITEM makes it. Returns 0
// where every one is culled.
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
  p->valid = (p->z > camera[CAMERA_NEAR]) & (p->z < camera[CAMERA_FAR]);
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
  floatL r[9], a[9];
  rotation_of(p->q, r);
  FOR_AXES(i)
  FOR_AXES(j)
  a[3 * i + j] = fmaL((floatL)(camera[CAMERA_R00 + 3 * i]), r[j],
                      fmaL((floatL)(camera[CAMERA_R01 + 3 * i]), r[3 + j], camera[CAMERA_R02 + 3 * i] * r[6 + j]));
  p->s[0] = expL(GATHER(log_scales, 3, 0));
  p->s[1] = expL(GATHER(log_scales, 3, 1));
  p->s[2] = expL(GATHER(log_scales, 3, 2));

#ifdef ORTHOGRAPHIC
  p->rx = p->ry = (floatL)(0.0f);
  p->jx = (floatL)(camera[CAMERA_FX]);
  p->jy = (floatL)(camera[CAMERA_FY]);
#else
  p->rx = clampL(p->x / p->z, camera[CAMERA_XMIN], camera[CAMERA_XMAX]);
  p->ry = clampL(p->y / p->z, camera[CAMERA_YMIN], camera[CAMERA_YMAX]);
  p->jx = camera[CAMERA_FX] / p->z;
  p->jy = camera[CAMERA_FY] / p->z;
#endif
  const floatL area = camera[CAMERA_HAND] * p->jx * p->jy;
  FOR_AXES(k) {
    p->a2[k] = a[6 + k];
    p->b1[k] = p->jx * fmaL(-p->rx, a[6 + k], a[k]);
    p->b2[k] = p->jy * fmaL(-p->ry, a[6 + k], a[3 + k]);
    p->c[k] = area * fmaL(p->rx, a[k], fmaL(p->ry, a[3 + k], a[6 + k]));
  }
  covariance(p);

  // Rounding the rotation moves a point at a long axis' end by that axis times 1e-7, which has to be little beside the
  // ellipse's short axis: the square root of det / (sxx + syy), or up to 1.42 times that. The gradient wants to know an
  // axis that points at the camera too.
  floatL longest = p->s[0] > p->s[1] ? p->s[0] : p->s[1];
  longest = longest > p->s[2] ? longest : p->s[2];
  const floatL across2 = fmaL(p->jx, p->jx, p->jy * p->jy);
  const floatL longest2 = longest * longest * across2;
  p->valid &= longest2 < FARTHEST * FARTHEST;
  intL which = longest2 * (p->sxx + p->syy) > REFINE_FROM * REFINE_FROM * p->det;
  FOR_AXES(k)
  which |= across2 > FORESHORTENED * FORESHORTENED * fmaL(p->b1[k], p->b1[k], p->b2[k] * p->b2[k]);
  if (ANYL(which & p->valid)) {
    refine(row, quaternions, camera, MASKL(which), p);
    covariance(p);
  }
  p->valid &= (p->sxx < 1e30f) & (p->syy < 1e30f) & (p->det > 0.0f) & (p->det < 1e30f);
  return 1;
}

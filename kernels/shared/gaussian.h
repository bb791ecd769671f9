// Projects LANES Gaussians to ellipses on the image (EWA splatting). Projection and its gradient share this code.
// Equation numbers refer to docs/gradients.md. With RAYS the projection is in tangent.h, which uses the rest of this
// file.

#include "shared/place.h"

// LOW_PASS: dilation, the variance added to the projected covariance, in px^2. LEAST_COMPENSATION: the minimum factor
// of the opacity (its compensation) in equation (83) of docs/gradients.md.
#ifdef ANTIALIASED
#define LOW_PASS 0.1f
#define LEAST_COMPENSATION 0.005f
#else
#define LOW_PASS 0.3f
#endif

typedef struct {
  intL valid;           // not culled
  floatL x, y, z;       // mean in the camera's axes
  floatL lx, ly, lz;    // low parts of x, y and z
  floatL rx, ry;        // x/z and y/z, clamped for the Jacobian; orthographic: 0
  floatL jx, jy;        // the Jacobian's rows are jx (1, 0, -rx) and jy (0, 1, -ry)
  floatL q[4];          // unit quaternion w x y z
  floatL length;        // length of the raw quaternion
  floatL a2[3];         // last row of A (camera from Gaussian): depths of the Gaussian's axes
  floatL b1[3], b2[3];  // the two rows of J A
  floatL c[3];          // minors of J A: c[m] is b1[k] b2[l] - b1[l] b2[k], for cyclic k, l, m
  floatL s[3];          // scales
  floatL sxx, sxy, syy; // projected covariance with the low-pass
  floatL det;
#ifdef ANTIALIASED
  floatL det0; // determinant without the low-pass
#endif
} Projection;

#define NEEDS_PROJECTION
#include "shared/camera.h"

// The component along a world axis of the vector from the camera's centre to the mean.
#define FROM_CAMERA(means, axis, index)                                                                                \
  ((GATHER(means, 3, index) - camera[CAMERA_P##axis]) - camera[CAMERA_P##axis##_LOW])

#ifndef RAYS
// Computes the projected covariance from J A and S, equations (5) to (7) of docs/gradients.md, and the determinant as a
// sum of squares, equation (56) of docs/gradients.md.
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
#endif

#ifdef ANTIALIASED
// The factor by which opacity compensates for the low-pass, equation (83) of docs/gradients.md. det0, det: determinants
// of the covariance without and with the low-pass.
static inline floatL compensation(floatL det0, floatL det) {
  const floatL part = det0 / det;
  return part > LEAST_COMPENSATION * LEAST_COMPENSATION ? sqrt(part) : (floatL)(LEAST_COMPENSATION);
}
#endif

#ifndef RAYS
// Recomputes J A and its minors in the lanes of `which`, equation (57) of docs/gradients.md. It uses two floats up to
// the last step in which terms cancel.
static inline void refine(const uint *row, PARAMETER *quaternions, __constant float *camera, intL which,
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

// Projects LANES Gaussians, equations (1) and (3) to (7) of docs/gradients.md: fills *p, and returns 0 if every lane is
// culled. Conditions are written so that NaN culls. row (LANES): the Gaussians' rows, from ROWS_OF_ITEM.
static inline int project_gaussians(const uint *row, PARAMETER *means, PARAMETER *quaternions, PARAMETER *log_scales,
                                    __constant float *camera, Projection *p) {
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

  jacobian_row(p->x, p->z, camera[CAMERA_FX], camera[CAMERA_XMIN], camera[CAMERA_XMAX], &p->rx, &p->jx);
  jacobian_row(p->y, p->z, camera[CAMERA_FY], camera[CAMERA_YMIN], camera[CAMERA_YMAX], &p->ry, &p->jy);
  const floatL area = camera[CAMERA_HAND] * p->jx * p->jy;
  FOR_AXES(k) {
    p->a2[k] = a[6 + k];
    p->b1[k] = p->jx * fmaL(-p->rx, a[6 + k], a[k]);
    p->b2[k] = p->jy * fmaL(-p->ry, a[6 + k], a[3 + k]);
    p->c[k] = area * fmaL(p->rx, a[k], fmaL(p->ry, a[3 + k], a[6 + k]));
  }
  covariance(p);

  // Rounding of the rotation moves the end of a long axis by 1e-7 of its length. This error must be small compared to
  // the ellipse's short axis, which is between 1 and 1.42 times sqrt(det / (sxx + syy)). The gradient also needs an
  // accurate axis where the axis points to the camera.
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
#endif

// Projects LANES Gaussians to ellipses on the image (EWA) with gsplat's conventions. ewa.cl and ewa_grad.cl share this
// code. Equation numbers refer to docs/gradients.md. The view matrix need not be a rotation, and all its twelve numbers
// have gradients; therefore equation (154) of docs/gradients.md uses the matrix's cofactors instead of its rows. With
// ORTHOGRAPHIC the image is linear in x and y, with FISHEYE in the angle from the axis. With COVARIANCES, covariances
// replace quaternions and scales.
#include "shared/place.h"
#define NEEDS_PROJECTION
#include "shared/camera.h"

// The compensation has no gradient if the determinant of the covariance without the low-pass is this or less.
#define LEAST_DETERMINANT 1e-30f

typedef struct {
  intL valid;        // not culled: depth and size are within the limits, and all values are finite
  floatL x, y, z;    // mean in the camera's axes
  floatL lx, ly, lz; // low parts of x, y and z
#ifdef FISHEYE
  floatL away;         // theta / r: distance on the image divided by distance from the axis
  floatL bend, bend2;  // the operator (1/r d/dr) applied to `away` once and twice
  floatL inverse;      // 1 / (x^2 + y^2 + z^2)
  floatL j1[3], j2[3]; // rows of the Jacobian
#else
  floatL rx, ry; // x/z and y/z, clamped for the Jacobian; orthographic: 0
  floatL jx, jy; // the Jacobian's rows are jx (1, 0, -rx) and jy (0, 1, -ry)
#endif
  floatL t1[3], t2[3]; // rows of the Jacobian times the view matrix
  floatL n[3];         // cross product of t1 and t2
#ifdef COVARIANCES
  floatL v[6];   // the Gaussian's covariance V: xx, xy, xz, yy, yz, zz
  floatL v2[3];  // V times t2
  floatL adj[6]; // adjugate of V, in the order of v
#else
  floatL q[4];         // unit quaternion w x y z
  floatL length;       // length of the raw quaternion
  floatL r[9];         // rotation matrix
  floatL s[3];         // scales
  floatL b1[3], b2[3]; // t1 and t2 along the Gaussian's axes
  floatL c[3];         // n along the Gaussian's axes
#endif
  floatL sxx, sxy, syy; // projected covariance with the low-pass
  floatL det, det0;     // determinants of the covariance with and without the low-pass
} Ellipse2;

#ifdef COVARIANCES
#define EWA_SHAPES __global const float *covariances
#define EWA_SHAPES_GIVEN covariances
#else
#define EWA_SHAPES __global const float *quaternions, __global const float *scales
#define EWA_SHAPES_GIVEN quaternions, scales
#endif

#define EWA_ROW(index)                                                                                                 \
  camera_row(camera + EWA_R##index##0, camera + EWA_R##index##0_LOW, camera[EWA_T##index], camera[EWA_T##index##_LOW], \
             x, y, z)

static inline floatL dotL(const floatL *a, const floatL *b) { return fmaL(a[0], b[0], fmaL(a[1], b[1], a[2] * b[2])); }

// The dot product of a and three consecutive numbers of the camera's array.
static inline floatL dot_row(const floatL *a, __constant float *row) {
  return fmaL(a[0], (floatL)(row[0]), fmaL(a[1], (floatL)(row[1]), a[2] * row[2]));
}

// a b - c d, accurate to the last digits even where the products nearly cancel.
static inline floatL product_difference(floatL a, floatL b, floatL c, floatL d) {
  const floatL cd = c * d;
  return fmaL(a, b, -cd) + fmaL(-c, d, cd);
}

#ifdef COVARIANCES
// The product of a symmetric 3x3 matrix, given by its upper triangle v, and the vector a.
static inline void symmetric_times(const floatL *v, const floatL *a, floatL *result) {
  result[0] = fmaL(v[0], a[0], fmaL(v[1], a[1], v[2] * a[2]));
  result[1] = fmaL(v[1], a[0], fmaL(v[3], a[1], v[4] * a[2]));
  result[2] = fmaL(v[2], a[0], fmaL(v[4], a[1], v[5] * a[2]));
}
#endif

#ifdef FISHEYE
// atan(x) for x in [0, 1], by the polynomial of quarter_atan (angles.h).
static inline floatL atan_of_ratio(floatL x) {
  const floatL t = x * x;
  floatL p = fmaL(t, (floatL)(ATAN0), (floatL)(ATAN1));
  p = fmaL(t, p, (floatL)(ATAN2));
  p = fmaL(t, p, (floatL)(ATAN3));
  p = fmaL(t, p, (floatL)(ATAN4));
  p = fmaL(t, p, (floatL)(ATAN5));
  p = fmaL(t, p, (floatL)(ATAN6));
  p = fmaL(t, p, (floatL)(ATAN7));
  return fmaL(t * p, x, x);
}

// Computes four fields of a fisheye's projection, equations (157) and (158) of docs/gradients.md: away = theta / r,
// bend = (d away / dr) / r, bend2 = (d bend / dr) / r, and inverse, 1 / the squared length of (x, y, z). r is the
// distance from the axis and theta the angle from it. Near the axis series are used, because terms of the closed forms
// nearly cancel there.
static inline void fisheye_of(Ellipse2 *p) {
  const floatL q = fmaL(p->x, p->x, p->y * p->y), d = fmaL(p->z, p->z, q);
  const floatL up = 1.0f / p->z, up2 = up * up, t = q * up2;
  const intL near_axis = (p->z > 0.0f) & (t < 0.1f);
  floatL s = fmaL(t, (floatL)(-1.0f / 15.0f), (floatL)(1.0f / 13.0f));
  s = fmaL(t, -s, (floatL)(1.0f / 11.0f));
  s = fmaL(t, -s, (floatL)(1.0f / 9.0f));
  s = fmaL(t, -s, (floatL)(1.0f / 7.0f));
  s = fmaL(t, -s, (floatL)(1.0f / 5.0f));
  s = fmaL(t, -s, (floatL)(1.0f / 3.0f));
  s = fmaL(t, -s, (floatL)(1.0f));
  floatL h = fmaL(t, (floatL)(-16.0f / 17.0f), (floatL)(14.0f / 15.0f));
  h = fmaL(t, -h, (floatL)(12.0f / 13.0f));
  h = fmaL(t, -h, (floatL)(10.0f / 11.0f));
  h = fmaL(t, -h, (floatL)(8.0f / 9.0f));
  h = fmaL(t, -h, (floatL)(6.0f / 7.0f));
  h = fmaL(t, -h, (floatL)(4.0f / 5.0f));
  h = fmaL(t, -h, (floatL)(2.0f / 3.0f));
  floatL k = fmaL(t, (floatL)(-288.0f / 19.0f), (floatL)(224.0f / 17.0f));
  k = fmaL(t, -k, (floatL)(168.0f / 15.0f));
  k = fmaL(t, -k, (floatL)(120.0f / 13.0f));
  k = fmaL(t, -k, (floatL)(80.0f / 11.0f));
  k = fmaL(t, -k, (floatL)(48.0f / 9.0f));
  k = fmaL(t, -k, (floatL)(24.0f / 7.0f));
  k = fmaL(t, -k, (floatL)(8.0f / 5.0f));
  // The closed forms, used elsewhere.
  const floatL r = sqrt(q), z = p->z < 0.0f ? -p->z : p->z;
  const intL steep = r > z;
  const floatL angle = atan_of_ratio(steep ? z / r : r / z);
  const floatL first = steep ? QUARTER_TURN - angle : angle;
  const floatL theta = p->z < 0.0f ? HALF_TURN - first : first;
  const floatL away = theta / r, by_r2 = (p->z / d - away) / q;
  p->inverse = 1.0f / d;
  p->away = near_axis ? s * up : away;
  p->bend = near_axis ? -h * (up * up2) : by_r2;
  p->bend2 = near_axis ? k * (up * up2 * up2) : fmaL((floatL)(-3.0f), by_r2, -2.0f * (p->z / d) / d) / q;
}
#endif

// Computes the projected covariance with the low-pass eps, equations (153) to (155) of docs/gradients.md. The
// determinants are sums of squares or of positive terms.
static inline void covariance2(float eps, Ellipse2 *p) {
  floatL xx, xy, yy;
#ifdef COVARIANCES
  floatL v1[3];
  symmetric_times(p->v, p->t1, v1);
  symmetric_times(p->v, p->t2, p->v2);
  xx = dotL(p->t1, v1);
  xy = dotL(p->t1, p->v2);
  yy = dotL(p->t2, p->v2);
  p->adj[0] = product_difference(p->v[3], p->v[5], p->v[4], p->v[4]);
  p->adj[1] = product_difference(p->v[2], p->v[4], p->v[1], p->v[5]);
  p->adj[2] = product_difference(p->v[1], p->v[4], p->v[2], p->v[3]);
  p->adj[3] = product_difference(p->v[0], p->v[5], p->v[2], p->v[2]);
  p->adj[4] = product_difference(p->v[1], p->v[2], p->v[0], p->v[4]);
  p->adj[5] = product_difference(p->v[0], p->v[3], p->v[1], p->v[1]);
  floatL across[3];
  symmetric_times(p->adj, p->n, across);
  const floatL det0 = dotL(p->n, across);
  p->det0 = det0 > 0.0f ? det0 : (floatL)(0.0f);
#else
  xx = xy = yy = p->det0 = (floatL)(0.0f);
  FOR_AXES(k) {
    const floatL m1 = p->s[k] * p->b1[k], m2 = p->s[k] * p->b2[k];
    xx = fmaL(m1, m1, xx);
    yy = fmaL(m2, m2, yy);
    xy = fmaL(m1, m2, xy);
    const floatL minor = p->s[(k + 1) % 3] * p->s[(k + 2) % 3] * p->c[k];
    p->det0 = fmaL(minor, minor, p->det0);
  }
#endif
  p->sxx = xx + eps;
  p->syy = yy + eps;
  p->sxy = xy;
  p->det = fmaL((floatL)(eps), xx + yy, fmaL((floatL)(eps), (floatL)(eps), p->det0));
}

#if !defined(COVARIANCES) && !defined(FISHEYE)
#define EWA_NUMBER2(name, index)                                                                                       \
  {(floatL)(camera[EWA_##name##0 + (index)]), (floatL)(camera[EWA_##name##0_LOW + (index)])}

// Recomputes b1, b2 and c of *p, the rows of J A and its minors, in the lanes of `which`: equation (57) of
// docs/gradients.md. It uses two floats up to the last step in which terms cancel.
static inline void refine2(const uint *row, __global const float *quaternions, __constant float *camera, intL which,
                           Ellipse2 *p) {
  Double r[9];
  const floatL length = rotation2_of(row, quaternions, p->length, r);
  const Double rx = {p->rx, clamped_rest(p->rx, p->x, p->lx, p->z, p->lz, camera[EWA_XMIN], camera[EWA_XMIN_LOW],
                                         camera[EWA_XMAX], camera[EWA_XMAX_LOW])};
  const Double ry = {p->ry, clamped_rest(p->ry, p->y, p->ly, p->z, p->lz, camera[EWA_YMIN], camera[EWA_YMIN_LOW],
                                         camera[EWA_YMAX], camera[EWA_YMAX_LOW])};
  const floatL along_x = p->jx / (length * length), along_y = p->jy / (length * length), area = p->jx * along_y;
  Double t1[3], t2[3], n[3];
  FOR_AXES(i) {
    const Double r0 = EWA_NUMBER2(R0, i), r1 = EWA_NUMBER2(R1, i), n2 = EWA_NUMBER2(N2, i);
    t1[i] = subtract2(r0, scaled2(camera[EWA_R20 + i], camera[EWA_R20_LOW + i], rx));
    t2[i] = subtract2(r1, scaled2(camera[EWA_R20 + i], camera[EWA_R20_LOW + i], ry));
    n[i] = add2(add2(scaled2(camera[EWA_N00 + i], camera[EWA_N00_LOW + i], rx),
                     scaled2(camera[EWA_N10 + i], camera[EWA_N10_LOW + i], ry)),
                n2);
  }
  FOR_AXES(k) {
    const Double b1 = add2(add2(multiply2(t1[0], r[k]), multiply2(t1[1], r[3 + k])), multiply2(t1[2], r[6 + k]));
    const Double b2 = add2(add2(multiply2(t2[0], r[k]), multiply2(t2[1], r[3 + k])), multiply2(t2[2], r[6 + k]));
    const Double c = add2(add2(multiply2(n[0], r[k]), multiply2(n[1], r[3 + k])), multiply2(n[2], r[6 + k]));
    p->b1[k] = which ? along_x * b1.high : p->b1[k];
    p->b2[k] = which ? along_y * b2.high : p->b2[k];
    p->c[k] = which ? area * c.high : p->c[k];
  }
}
#endif

// Projects LANES Gaussians, equations (150) to (155) of docs/gradients.md: fills *p, and returns 0 if every lane is
// culled. Conditions are written so that NaN culls. row (LANES): the Gaussians' rows, from ROWS_OF_ITEM.
static inline int project_ellipses(const uint *row, __global const float *means, EWA_SHAPES, __constant float *camera,
                                   Ellipse2 *p) {
  const floatL x = GATHER(means, 3, 0), y = GATHER(means, 3, 1), z = GATHER(means, 3, 2);
  const Double in_x = EWA_ROW(0), in_y = EWA_ROW(1), in_z = EWA_ROW(2);
  p->x = in_x.high;
  p->y = in_y.high;
  p->z = in_z.high;
  p->lx = in_x.low;
  p->ly = in_y.low;
  p->lz = in_z.low;
  p->valid = (p->z > camera[EWA_NEAR]) & (p->z < camera[EWA_FAR]);
  if (!ANYL(p->valid)) return 0;

#ifdef FISHEYE
  fisheye_of(p);
  const floatL cross = p->x * p->y * p->bend;
  p->j1[0] = camera[EWA_FX] * fmaL(p->x * p->x, p->bend, p->away);
  p->j1[1] = camera[EWA_FX] * cross;
  p->j1[2] = -camera[EWA_FX] * (p->x * p->inverse);
  p->j2[0] = camera[EWA_FY] * cross;
  p->j2[1] = camera[EWA_FY] * fmaL(p->y * p->y, p->bend, p->away);
  p->j2[2] = -camera[EWA_FY] * (p->y * p->inverse);
  floatL m[3];
  m[0] = product_difference(p->j1[1], p->j2[2], p->j1[2], p->j2[1]);
  m[1] = product_difference(p->j1[2], p->j2[0], p->j1[0], p->j2[2]);
  m[2] = product_difference(p->j1[0], p->j2[1], p->j1[1], p->j2[0]);
  FOR_AXES(i) {
    const float r0 = camera[EWA_R00 + i], r1 = camera[EWA_R10 + i], r2 = camera[EWA_R20 + i];
    p->t1[i] = fmaL(p->j1[0], (floatL)(r0), fmaL(p->j1[1], (floatL)(r1), p->j1[2] * r2));
    p->t2[i] = fmaL(p->j2[0], (floatL)(r0), fmaL(p->j2[1], (floatL)(r1), p->j2[2] * r2));
    p->n[i] = fmaL(m[0], (floatL)(camera[EWA_N00 + i]),
                   fmaL(m[1], (floatL)(camera[EWA_N10 + i]), m[2] * camera[EWA_N20 + i]));
  }
#else
  jacobian_row(p->x, p->z, camera[EWA_FX], camera[EWA_XMIN], camera[EWA_XMAX], &p->rx, &p->jx);
  jacobian_row(p->y, p->z, camera[EWA_FY], camera[EWA_YMIN], camera[EWA_YMAX], &p->ry, &p->jy);
  const floatL area = p->jx * p->jy;
  FOR_AXES(i) {
    p->t1[i] = p->jx * fmaL(-p->rx, (floatL)(camera[EWA_R20 + i]), (floatL)(camera[EWA_R00 + i]));
    p->t2[i] = p->jy * fmaL(-p->ry, (floatL)(camera[EWA_R20 + i]), (floatL)(camera[EWA_R10 + i]));
    p->n[i] = area * fmaL(p->rx, (floatL)(camera[EWA_N00 + i]),
                          fmaL(p->ry, (floatL)(camera[EWA_N10 + i]), (floatL)(camera[EWA_N20 + i])));
  }
#endif

#ifdef COVARIANCES
  p->v[0] = GATHER(covariances, 6, 0);
  p->v[1] = GATHER(covariances, 6, 1);
  p->v[2] = GATHER(covariances, 6, 2);
  p->v[3] = GATHER(covariances, 6, 3);
  p->v[4] = GATHER(covariances, 6, 4);
  p->v[5] = GATHER(covariances, 6, 5);
  covariance2(camera[EWA_EPS], p);
#else
  floatL raw[4], norm2 = (floatL)(0.0f);
  raw[0] = GATHER(quaternions, 4, 0);
  raw[1] = GATHER(quaternions, 4, 1);
  raw[2] = GATHER(quaternions, 4, 2);
  raw[3] = GATHER(quaternions, 4, 3);
  for (int i = 0; i < 4; ++i) norm2 = fmaL(raw[i], raw[i], norm2);
  p->valid &= (norm2 > 1e-30f) & (norm2 < 1e30f);
  p->length = sqrt(norm2);
  for (int i = 0; i < 4; ++i) p->q[i] = raw[i] / p->length;
  rotation_of(p->q, p->r);
  p->s[0] = GATHER(scales, 3, 0);
  p->s[1] = GATHER(scales, 3, 1);
  p->s[2] = GATHER(scales, 3, 2);
  FOR_AXES(k) {
    p->b1[k] = fmaL(p->t1[0], p->r[k], fmaL(p->t1[1], p->r[3 + k], p->t1[2] * p->r[6 + k]));
    p->b2[k] = fmaL(p->t2[0], p->r[k], fmaL(p->t2[1], p->r[3 + k], p->t2[2] * p->r[6 + k]));
    p->c[k] = fmaL(p->n[0], p->r[k], fmaL(p->n[1], p->r[3 + k], p->n[2] * p->r[6 + k]));
  }
  covariance2(camera[EWA_EPS], p);
#ifndef FISHEYE // as in gaussian.h, refines if rounding moves the end of a long axis by much compared to the short axis
  floatL longest2 = p->s[0] * p->s[0];
  longest2 = p->s[1] * p->s[1] > longest2 ? p->s[1] * p->s[1] : longest2;
  longest2 = p->s[2] * p->s[2] > longest2 ? p->s[2] * p->s[2] : longest2;
  const floatL across2 = fmaL(p->jx, p->jx, p->jy * p->jy);
  longest2 = longest2 * across2;
  p->valid &= longest2 < FARTHEST * FARTHEST;
  intL which = longest2 * (p->sxx + p->syy) > REFINE_FROM * REFINE_FROM * p->det;
  FOR_AXES(k)
  which |= across2 > FORESHORTENED * FORESHORTENED * fmaL(p->b1[k], p->b1[k], p->b2[k] * p->b2[k]);
  if (ANYL(which & p->valid)) {
    refine2(row, quaternions, camera, MASKL(which), p);
    covariance2(camera[EWA_EPS], p);
  }
#endif
#endif
  p->valid &=
      (p->sxx < 1e30f) & (p->syy < 1e30f) & (p->sxx > 0.0f) & (p->syy > 0.0f) & (p->det > 0.0f) & (p->det < 1e30f);
  return 1;
}

// The factor by which opacity compensates for the low-pass, equation (156) of docs/gradients.md.
static inline floatL compensation2(const Ellipse2 *p) { return sqrt(p->det0 / p->det); }

// The perspective camera model: the image is linear in x/z and y/z, (2) of docs/cameras.md. Other equation numbers
// refer to docs/gradients.md.
#define ON_PLANE

// RATIO: the number on which the image position depends linearly. ratio_rest: the low part of RATIO.
#define RATIO(x, z) ((x) / (z))
#define ratio_rest slope_rest

#ifdef NEEDS_PROJECTION
// The low part of the Jacobian's clamped x/z. Where x/z is clamped, this is the low part of the limit. ratio: the
// clamped x/z; low, high: the limits, with the low parts low_rest and high_rest.
static inline floatL clamped_rest(floatL ratio, floatL x, floatL x_low, floatL z, floatL z_low, float low,
                                  float low_rest, float high, float high_rest) {
  const floatL rest = ratio_rest(ratio, x, x_low, z, z_low);
  const floatL above = ratio == low ? (floatL)(low_rest) : rest;
  return ratio == high ? (floatL)(high_rest) : above;
}

// Computes rx and jx of the Jacobian's row for x, jx (1, 0, -rx), equations (3) and (4) of docs/gradients.md. For y the
// row is jy (0, 1, -ry). low, high: limits of x/z.
static inline void jacobian_row(floatL x, floatL z, float focal, float low, float high, floatL *rx, floatL *jx) {
  *rx = clampL(x / z, low, high);
  *jx = focal / z;
}
#endif

#ifdef NEEDS_GRADIENT
// The gradient d (3) with respect to the mean in the camera's axes, through the image position and through the Jacobian
// J, equation (52) of docs/gradients.md. Where x/z or y/z is clamped, J depends only on z. at: the mean; limited: rx,
// ry; jx, jy: as in equation (4) of docs/gradients.md; d_mx, d_my: the gradient with respect to the image position;
// by_j02, by_j12: the gradient with respect to J's last column, divided by -jx and -jy; d_size: the gradient with
// respect to the log of the ellipse's size. Also sets beyond (2), the part of equation (145) of docs/gradients.md for a
// clamped x/z or y/z, whose limit is a fixed image position.
static inline void mean_gradient(const floatL *at, const floatL *limited, floatL jx, floatL jy, floatL d_mx,
                                 floatL d_my, floatL by_j02, floatL by_j12, floatL d_size, floatL *d, floatL *beyond) {
  const floatL z = at[2], rx = at[0] / z, ry = at[1] / z;
  const floatL d_j02 = rx == limited[0] ? by_j02 : (floatL)(0.0f);
  const floatL d_j12 = ry == limited[1] ? by_j12 : (floatL)(0.0f);
  beyond[0] = (by_j02 - d_j02) / z;
  beyond[1] = (by_j12 - d_j12) / z;
  d[0] = jx * (d_mx - d_j02 / z);
  d[1] = jy * (d_my - d_j12 / z);
  d[2] = -fmaL(d[0], rx, fmaL(d[1], ry, d_size / z));
}
#endif

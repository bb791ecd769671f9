// The orthographic camera model: the image is linear in x and y, equations (3) and (15) to (17). Equation numbers refer
// to docs/cameras.md.
#define ON_PLANE
#define PARALLEL_RAYS

// RATIO: the number on which the image position depends linearly. ratio_rest: the low part of RATIO.
#define RATIO(x, z) (x)
#define ratio_rest(ratio, x, x_low, z, z_low) (x_low)

#ifdef NEEDS_PROJECTION
static inline floatL clamped_rest(floatL ratio, floatL x, floatL x_low, floatL z, floatL z_low, float low,
                                  float low_rest, float high, float high_rest) {
  return (floatL)(0.0f);
}

// Computes rx and jx of the Jacobian's row for x, equation (16) of docs/cameras.md; for y the same function gives ry
// and jy. The arguments are explained at jacobian_row in perspective.h.
static inline void jacobian_row(floatL x, floatL z, float focal, float low, float high, floatL *rx, floatL *jx) {
  *rx = (floatL)(0.0f);
  *jx = (floatL)(focal);
}
#endif

#ifdef NEEDS_GRADIENT
// The gradient d (3) with respect to the mean in the camera's axes, equation (20) of docs/cameras.md. The arguments are
// explained at mean_gradient in perspective.h.
static inline void mean_gradient(const floatL *at, const floatL *limited, floatL jx, floatL jy, floatL d_mx,
                                 floatL d_my, floatL by_j02, floatL by_j12, floatL d_size, floatL *d, floatL *beyond) {
  d[0] = jx * d_mx;
  d[1] = jy * d_my;
  d[2] = beyond[0] = beyond[1] = (floatL)(0.0f);
}
#endif

// The alpha of a Gaussian in a tile's pixels: blend and blend_grad must agree to the last bit, or the transmittance
// that the gradient recovers by division is another one.

// True if a vector has a pixel that takes the Gaussian (RasterizerConfig.vector_skip).
#ifdef NO_VECTOR_SKIP
#define REACHES(mask) 1
#else
#define REACHES(mask) ANYL(mask)
#endif

// u of a pixel, from the mean's offset (dx, dy) to it.
static inline floatL whitened_u(float l11, float l12, floatL dx, floatL dy) {
  return fmaL((floatL)(l12), dy, l11 * dx);
}

// Moments of g over pixels, into the sums of those names.
#define ADD_MOMENTS(g, u, v)                                                                                           \
  do {                                                                                                                 \
    const floatL gu = (g) * (u), gv = (g) * (v);                                                                       \
    sum_g += g;                                                                                                        \
    sum_gu += gu;                                                                                                      \
    sum_gv += gv;                                                                                                      \
    sum_guu = fmaL(gu, u, sum_guu);                                                                                    \
    sum_guv = fmaL(gu, v, sum_guv);                                                                                    \
    sum_gvv = fmaL(gv, v, sum_gvv);                                                                                    \
  } while (0)

// A Gaussian's values for a loop over cells, and log2 of its alpha before the cap in cell `cell`, the k-th of the
// item's.
#ifdef RAYS
#include "shared/rays.h"
#define RAY_TABLES                                                                                                     \
  floatL ray_x[OWNED], ray_y[OWNED], ray_z[OWNED];                                                                     \
  for (int k = 0; k < OWNED; ++k) {                                                                                    \
    const int cell = OWN_CELL(k);                                                                                      \
    const float left = (float)tile_x + camera[CAMERA_WINDOW_X], top = (float)tile_y + camera[CAMERA_WINDOW_Y];         \
    ray_of(left + 0.5f + PIXELS_X(cell), top + 0.5f + PIXELS_Y(cell), camera, ray_x + k, ray_y + k, ray_z + k);        \
  }
#define SPLAT_HERE(splat)
#define LOG2_ALPHA(splat, cell, k) log2_alpha_of_ray(ray_x[k], ray_y[k], ray_z[k], splat)
#else
#define RAY_TABLES
#define SPLAT_HERE(splat)                                                                                              \
  const float l11 = (splat)[SPLAT_L11], l12 = (splat)[SPLAT_L12], l22 = (splat)[SPLAT_L22];                            \
  const float log2o = (splat)[SPLAT_LOG2O];                                                                            \
  const float mx = FROM_TILE(splat, X, tile_x), my = FROM_TILE(splat, Y, tile_y);
#define LOG2_ALPHA(splat, cell, k)                                                                                     \
  log2_alpha(whitened_u(l11, l12, mx - AT_X(cell), my - AT_Y(cell)), (l22) * (my - AT_Y(cell)), log2o)
#endif

// log2 of alpha before the cap, from the mean's offset in (u, v).
static inline floatL log2_alpha(floatL u, floatL v, float log2o) { return fmaL(-u, u, fmaL(-v, v, (floatL)(log2o))); }

// Alpha from its log2 before the cap, 0 in the lanes that do not take the Gaussian.
static inline floatL alpha_where(intL taken, floatL power) {
  floatL alpha = exp2L(power);
  alpha = alpha < ALPHA_MAX ? alpha : (floatL)(ALPHA_MAX);
  return AS_FLOATL(AS_INTL(alpha) & taken);
}

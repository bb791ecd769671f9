// A Gaussian's alpha in a tile's pixels. blend.cl and blend_grad.cl must compute the same bits, because the gradient
// recovers the image's transmittance by division. The limits ALPHA_MIN and ALPHA_MAX are in math.h.

// A Gaussian's nearness, 1 / depth, is blended like a colour (equation (120) of docs/gradients.md).
#ifdef NEARNESS
#define NEAR_PARAMETER , float c_near
#define NEAR_ARGUMENT , c_near
#define NEAR_HERE(nearness) const float c_near = nearness;
#else
#define NEAR_PARAMETER
#define NEAR_ARGUMENT
#define NEAR_HERE(nearness)
#endif

// The whitened coordinate u of a pixel; (dx, dy) is the mean minus the pixel.
static inline floatL whitened_u(float l11, float l12, floatL dx, floatL dy) {
  return fmaL((floatL)(l12), dy, l11 * dx);
}

// Adds g = alpha * dL/dalpha and its moments in (u, v) to the first fields of a slot's sums. by_u, by_v: the values
// that are added to the two first-order moments; g * u and g * v, except along rays.
static inline void add_moments_by(floatS g, floatS u, floatS v, floatS by_u, floatS by_v, floatS *sums) {
  const floatS gu = g * u, gv = g * v;
  sums[SLOT_G] += g;
  sums[SLOT_GU] += by_u;
  sums[SLOT_GV] += by_v;
  sums[SLOT_GUU] = fmaS(gu, u, sums[SLOT_GUU]);
  sums[SLOT_GUV] = fmaS(gu, v, sums[SLOT_GUV]);
  sums[SLOT_GVV] = fmaS(gv, v, sums[SLOT_GVV]);
}

static inline void add_moments(floatS g, floatS u, floatS v, floatS *sums) {
  add_moments_by(g, u, v, g * u, g * v, sums);
}

// SPLAT_HERE defines the variables of a Gaussian that LOG2_ALPHA reads. LOG2_ALPHA is log2 of the Gaussian's uncapped
// alpha in the pixels of `cell`. With RAYS, RAY_TABLES defines the direction of each pixel.
#ifdef RAYS
#include "shared/camera.h"
#include "shared/rays.h"
#define RAY_TABLES                                                                                                     \
  floatL ray_x[OWNED], ray_y[OWNED], ray_z[OWNED];                                                                     \
  ALL_CELLS(cell) {                                                                                                    \
    const float left = (float)tile_x + camera[CAMERA_WINDOW_X], top = (float)tile_y + camera[CAMERA_WINDOW_Y];         \
    ray_of(left + 0.5f + PIXELS_X(cell), top + 0.5f + PIXELS_Y(cell), camera, ray_x + cell, ray_y + cell,              \
           ray_z + cell);                                                                                              \
  }
#define SPLAT_HERE(splat)
#define LOG2_ALPHA(splat, cell) log2_alpha_of_ray(ray_x[cell], ray_y[cell], ray_z[cell], splat)
#else
#define RAY_TABLES
#define SPLAT_HERE(splat)                                                                                              \
  const float l11 = (splat)[SPLAT_L11], l12 = (splat)[SPLAT_L12], l22 = (splat)[SPLAT_L22];                            \
  const float log2o = (splat)[SPLAT_LOG2O];                                                                            \
  const float mx = FROM_TILE(splat, X, tile_x), my = FROM_TILE(splat, Y, tile_y);
#define LOG2_ALPHA(splat, cell)                                                                                        \
  log2_alpha(whitened_u(l11, l12, mx - AT_X(cell), my - AT_Y(cell)), (l22) * (my - AT_Y(cell)), log2o)
#endif

// log2 of the uncapped alpha from the mean's offset in (u, v).
static inline floatL log2_alpha(floatL u, floatL v, float log2o) { return fmaL(-u, u, fmaL(-v, v, (floatL)(log2o))); }

// The capped alpha from `power`, the log2 of the uncapped alpha; 0 in lanes that are not `taken`.
static inline floatL alpha_where(intL taken, floatL power) {
  floatL alpha = exp2L(power);
  alpha = alpha < ALPHA_MAX ? alpha : (floatL)(ALPHA_MAX);
  return AS_FLOATL(AS_INTL(alpha) & taken);
}

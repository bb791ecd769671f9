// The alpha of a Gaussian in a tile's pixels: blend and blend_grad must agree to the last bit, or the transmittance that
// the gradient recovers by division is another one.

// Whether a vector has a pixel that takes the Gaussian (RasterizerConfig.vector_skip).
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
#define ADD_MOMENTS(g, u, v)                                                                                          \
  do {                                                                                                                \
    const floatL gu = (g) * (u), gv = (g) * (v);                                                                      \
    sum_g += g;                                                                                                       \
    sum_gu += gu;                                                                                                     \
    sum_gv += gv;                                                                                                     \
    sum_guu = fmaL(gu, u, sum_guu);                                                                                   \
    sum_guv = fmaL(gu, v, sum_guv);                                                                                   \
    sum_gvv = fmaL(gv, v, sum_gvv);                                                                                   \
  } while (0)

// log2 of alpha before the cap, from the mean's offset in (u, v).
static inline floatL log2_alpha(floatL u, floatL v, float log2o) {
  return fmaL(-u, u, fmaL(-v, v, (floatL)(log2o)));
}

// Units of splats and slots, and the number of floats per slot. Their columns are in layouts.h.

// A splat's L11, L12 and L22 are the whitening W (equation (44) of docs/gradients.md) times WHITEN = sqrt(log2(e) / 2).
// Moments in slots use WHITEN W too.
#define WHITEN 0.84932180028801904f
#define INVERSE_WHITEN2 1.38629436111989062f // 1 / WHITEN^2 = 2 ln 2

// The larger eigenvalue of the covariance whose whitening is (l11, l12, l22).
static inline float larger_eigenvalue(float l11, float l12, float l22) {
  const float syy = 1.0f / (l22 * l22);
  const float sxy = -(l12 / l11) * syy;
  const float sxx = 1.0f / (l11 * l11) + sxy * sxy / syy;
  const float middle = 0.5f * (sxx + syy), half_difference = 0.5f * (sxx - syy);
  return middle + sqrt(fma1(half_difference, half_difference, sxy * sxy));
}

// SLOT_STRIDE: number of floats per slot. The gradients come first, then the contribution with CONTRIBUTIONS, then the
// gradient with respect to nearness, 1 / depth, with NEARNESS.
#ifdef ABSOLUTE_GRADIENTS
#define SLOT_GRADIENTS SLOT_SIZE
#else
#define SLOT_GRADIENTS SLOT_PLAIN
#endif
#ifdef CONTRIBUTIONS
#define SLOT_WEIGHT SLOT_GRADIENTS
#define SLOT_KEPT (SLOT_GRADIENTS + 1)
#else
#define SLOT_KEPT SLOT_GRADIENTS
#endif
#ifdef NEARNESS
#define SLOT_NEAR SLOT_KEPT
#define SLOT_STRIDE (SLOT_KEPT + 1)
#else
#define SLOT_STRIDE SLOT_KEPT
#endif

// A mean's coordinate relative to the centre of the tile's first pixel. Whole pixels and fraction are subtracted
// separately, because their sum in float32 would lose digits.
#define FROM_TILE(splat, axis, origin)                                                                                 \
  ((splat[SPLAT_PIXEL_##axis] - (float)(origin)) + (splat[SPLAT_SUB_##axis] - 0.5f))

// The light behind a pair in a pixel, reduced to one number by the pixel's gradient. With ITEMS == 1 this is R of
// equation (48) in docs/gradients.md. A group of several items keeps D . B of equation (22), which takes fewer
// instructions and is more precise.

// BEHIND: the light behind all pairs of a pixel, which is the background's. t: the final transmittance; at_end: the
// loss's gradient with respect to t.
#if ITEMS == 1
#define BEHIND(t, at_end) ((t) * (at_end))
#else
#define BEHIND(t, at_end) (at_end)

// t / x for x in [0.01, 1]; exactly t for x = 1. A division would take twice as many instructions, and its rounding
// depends on the driver. The bits of x give an estimate of 1 / x, which is off by up to 5 %. A polynomial step, with
// e^2 + 1.001926 e + 1 for 1 / (1 - e), reduces the error to 3.3e-5. Then the remainder of the quotient corrects the
// quotient. The result is the correctly rounded quotient in all but 0.7 % of cases. On average it is too small by only
// 6e-10, so that errors do not add up over a long list.
static inline float quotient(float t, float x) {
  const float estimate = as_float(0x7ef331c7 - as_int(x));
  const float d = fma1(-x, estimate, 1.500963f);
  const float inverse = estimate * fma1(d, d, 0.74903727f), near = t * inverse;
  return fma1(fma1(-near, x, t), inverse, near);
}

// Undoes the blending of a pair in a pixel, and returns the pair's g = alpha * dL/dalpha and blending weight. *t: the
// transmittance, behind the pair before the call and in front of it afterwards; *behind: likewise D . B, the pixel's
// gradient D times the light B behind; difference: D . c - *behind, with the pair's colour c; uncapped: the pair's
// alpha before the cap. If `uncapped` is 0, nothing changes.
static inline Share take_out_of(float *t, float *behind, float uncapped, float difference) {
  const float alpha = uncapped < ALPHA_MAX ? uncapped : ALPHA_MAX;
  const float before = quotient(*t, 1.0f - alpha), weight = alpha * before;
  const Share share = {uncapped < ALPHA_MAX ? weight * difference : 0.0f, weight};
  *behind = fma1(alpha, difference, *behind);
  *t = before;
  return share;
}
#endif

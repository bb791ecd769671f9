// The light behind a pair in a pixel, as a scalar. A single item keeps R of (48) in docs/gradients.md. A group of items
// keeps D . B of (22), which takes fewer instructions and is more precise.

// BEHIND: the light behind all pairs. t: final transmittance; at_end: gradient with respect to it.
#if ITEMS == 1
#define BEHIND(t, at_end) ((t) * (at_end))
#else
#define BEHIND(t, at_end) (at_end)

// t / x for x in [0.01, 1], and t itself for x = 1. An estimate of 1 / x by its bits is off by up to 5 %, and by 3.3e-5
// after a step with e^2 + 1.001926 e + 1 for 1 / (1 - e). The quotient by it is then corrected by its own remainder. A
// division takes twice as many instructions, and its rounding depends on the driver. The result is the rounded quotient
// in all but 0.7 % of cases, and on average too small by 6e-10, so that a long list's errors do not add up.
static inline float quotient(float t, float x) {
  const float estimate = as_float(0x7ef331c7 - as_int(x));
  const float d = fma1(-x, estimate, 1.500963f);
  const float inverse = estimate * fma1(d, d, 0.74903727f), near = t * inverse;
  return fma1(fma1(-near, x, t), inverse, near);
}

// Removes a pair from a pixel. *t: transmittance; *behind: D . B; difference: D . c - *behind; uncapped: the pair's
// alpha before the cap. Where that is 0, nothing changes.
static inline Share take_out_of(float *t, float *behind, float uncapped, float difference) {
  const float alpha = uncapped < ALPHA_MAX ? uncapped : ALPHA_MAX;
  const float before = quotient(*t, 1.0f - alpha), weight = alpha * before;
  const Share share = {uncapped < ALPHA_MAX ? weight * difference : 0.0f, weight};
  *behind = fma1(alpha, difference, *behind);
  *t = before;
  return share;
}
#endif

// Elementary functions and two-float sums in the lanes of a vector, with the same bits on every driver.

// e^x, with x clamped to [-87, 87], to about 1 ulp: Cody-Waite reduction and a polynomial of degree 6.
static inline floatL expL(floatL x) {
  x = x < -87.0f ? (floatL)(-87.0f) : x;
  x = x > 87.0f ? (floatL)(87.0f) : x;
  const floatL k = fmaL(x, (floatL)(LOG2E), (floatL)(12582912.0f)) - 12582912.0f;
  floatL r = fmaL(k, (floatL)(-0.693359375f), x);
  r = fmaL(k, (floatL)(2.12194440e-4f), r);
  floatL p = fmaL(r, (floatL)(1.9841270e-4f), (floatL)(1.3888889e-3f));
  p = fmaL(r, p, (floatL)(8.3333333e-3f));
  p = fmaL(r, p, (floatL)(4.16666667e-2f));
  p = fmaL(r, p, (floatL)(1.66666667e-1f));
  p = fmaL(r, p, (floatL)(0.5f));
  p = fmaL(r * r, p, r) + 1.0f;
  return AS_FLOATL(AS_INTL(p) + (TO_INTL(k) << 23));
}

// log2(x) for normal x > 0: the exponent plus the atanh series of the mantissa in [sqrt(1/2), sqrt(2)).
static inline floatL log2L(floatL x) {
  const intL bits = AS_INTL(x) - 0x3f3504f3;
  const floatL m = AS_FLOATL((bits & 0x007fffff) + 0x3f3504f3);
  const floatL s = (m - 1.0f) / (m + 1.0f);
  const floatL s2 = s * s;
  floatL p = fmaL(s2, (floatL)(0.3205989f), (floatL)(0.41219858f)); // 2/(9 ln 2), 2/(7 ln 2)
  p = fmaL(s2, p, (floatL)(0.57707802f));
  p = fmaL(s2, p, (floatL)(0.96179669f));
  p = fmaL(s2, p, (floatL)(2.88539008f));
  return fmaL(s, p, TO_FLOATL(bits >> 23));
}

static inline floatL sigmoidL(floatL x) { return 1.0f / (1.0f + expL(-x)); }

// floor(x), which is a function call in some drivers. Floats from 2^23 on are integers already.
static inline floatL floorL(floatL x) {
  const floatL cut = TO_FLOATL(TO_INTL(x));
  const floatL whole = cut > x ? cut - 1.0f : cut;
  const floatL below = x < 8388608.0f ? whole : x;
  return x > -8388608.0f ? below : x;
}

// A number in two floats: the sum high + low has twice the precision of one float (Dekker 1971).
typedef struct {
  floatL high, low;
} Double;

static inline Double sum2(floatL a, floatL b) {
  const floatL high = a + b;
  const floatL rest = high - a;
  const Double sum = {high, (a - (high - rest)) + (b - rest)};
  return sum;
}

// s + (a + a_low) * b in two floats; b has no low part.
static inline Double multiply_add2(float a, float a_low, floatL b, Double s) {
  const floatL product = a * b;
  const Double sum = sum2(s.high, product);
  const floatL low = s.low + sum.low + fmaL((floatL)(a_low), b, fmaL((floatL)(a), b, -product));
  return sum2(sum.high, low);
}

static inline Double add2(Double a, Double b) {
  const Double sum = sum2(a.high, b.high);
  return sum2(sum.high, sum.low + (a.low + b.low));
}

static inline Double subtract2(Double a, Double b) {
  const Double sum = sum2(a.high, -b.high);
  return sum2(sum.high, sum.low + (a.low - b.low));
}

static inline Double twice2(Double a) {
  const Double result = {2.0f * a.high, 2.0f * a.low};
  return result;
}

// The exact product a * b in two floats.
static inline Double product2(floatL a, floatL b) {
  const floatL high = a * b;
  const Double product = {high, fmaL(a, b, -high)};
  return product;
}

static inline Double multiply2(Double a, Double b) {
  Double product = product2(a.high, b.high);
  product.low += fmaL(a.high, b.low, a.low * b.high);
  return product;
}

static inline Double scaled2(float a, float a_low, Double b) {
  const Double factor = {(floatL)(a), (floatL)(a_low)};
  return multiply2(factor, b);
}

// The difference s1 - s2 of two scales; x is the difference of their logarithms. For close scales it is computed as s2
// times a series for exp(x) - 1. Without the series, rounding errors in the difference of nearly equal scales would
// rotate every spherical Gaussian.
static inline floatL scale_difference(floatL x, floatL s1, floatL s2) {
  floatL series = fmaL(x, (floatL)(1.0f / 720.0f), (floatL)(1.0f / 120.0f));
  series = fmaL(x, series, (floatL)(1.0f / 24.0f));
  series = fmaL(x, series, (floatL)(1.0f / 6.0f));
  series = fmaL(x, series, (floatL)(0.5f));
  series = fmaL(x * x, series, x) * s2;
  return x * x < 0.0625f ? series : s1 - s2;
}

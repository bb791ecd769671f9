// Scalar arithmetic with the same bits on every driver: no contraction but where fma1 asks for it, and no
// elementary function of the driver's. Every kernel includes this file first.
#pragma OPENCL FP_CONTRACT OFF

#define LOG2E 1.44269504088896341f
#define LOW_PASS 0.3f               // px^2 added to the projected covariance
#define ALPHA_MAX 0.99f
#ifndef ALPHA_MIN // these two can be set by RasterizerConfig
#define ALPHA_MIN (1.0f / 255.0f)
#define LOG2_ALPHA_MIN -7.99435344f // log2(1/255)
#endif
#ifndef TRANSMITTANCE_MIN
#define TRANSMITTANCE_MIN 1e-4f
#endif

// a*b + c with one rounding. FMA_BY_CONTRACTION is set where a probe found that the driver's compiler fuses this
// expression; its fma() is then a slower way to the same bits (and aborts some drivers at 16 lanes).
static inline float fma1(float a, float b, float c) {
#ifdef FMA_BY_CONTRACTION
#pragma OPENCL FP_CONTRACT ON
  return a * b + c;
#else
  return fma(a, b, c);
#endif
}

// e^x for x in [-87, 87] (clamped), about 1 ulp: Cody-Waite reduction and a degree 6 polynomial.
static inline float exp1(float x) {
  x = x < -87.0f ? -87.0f : (x > 87.0f ? 87.0f : x);
  const float k = fma1(x, LOG2E, 12582912.0f) - 12582912.0f;
  float r = fma1(k, -0.693359375f, x);
  r = fma1(k, 2.12194440e-4f, r);
  float p = fma1(r, 1.9841270e-4f, 1.3888889e-3f);
  p = fma1(r, p, 8.3333333e-3f);
  p = fma1(r, p, 4.16666667e-2f);
  p = fma1(r, p, 1.66666667e-1f);
  p = fma1(r, p, 0.5f);
  p = fma1(r * r, p, r) + 1.0f;
  return as_float(as_int(p) + ((int)k << 23));
}

// log2(x) for normal x > 0: exponent, then the atanh series of the mantissa in [sqrt(1/2), sqrt(2)).
static inline float log2_1(float x) {
  int bits = as_int(x) - 0x3f3504f3;
  const int e = bits >> 23;
  const float m = as_float((bits & 0x007fffff) + 0x3f3504f3);
  const float s = (m - 1.0f) / (m + 1.0f);
  const float s2 = s * s;
  float p = fma1(s2, 0.3205989f, 0.41219858f); // 2/(9 ln 2), 2/(7 ln 2)
  p = fma1(s2, p, 0.57707802f);
  p = fma1(s2, p, 0.96179669f);
  p = fma1(s2, p, 2.88539008f);
  return fma1(s, p, (float)e);
}

static inline float sigmoid1(float x) { return 1.0f / (1.0f + exp1(-x)); }

// A number as the unevaluated sum of two floats (Dekker 1971): 48 bits where a position needs them.
typedef struct {
  float high, low;
} Double;

static inline Double sum2(float a, float b) {
  const float high = a + b;
  const float rest = high - a;
  const Double sum = {high, (a - (high - rest)) + (b - rest)};
  return sum;
}

// s + (a + a_low) * b, with b exact.
static inline Double multiply_add2(float a, float a_low, float b, Double s) {
  const float product = a * b;
  const Double sum = sum2(s.high, product);
  const float low = s.low + sum.low + fma1(a_low, b, fma1(a, b, -product));
  return sum2(sum.high, low);
}

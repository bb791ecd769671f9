// Scalar arithmetic with the same bits on every driver: no contraction but where fma1 asks for it, and no
// elementary function of the driver's. Every kernel includes this file first.
#pragma OPENCL FP_CONTRACT OFF

#define LOG2E 1.44269504088896341f
#define LN2 0.693147180559945f
#ifndef ALPHA_MAX // the library sets another one, as its callers ask for it
#define ALPHA_MAX 0.99f
#endif
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

// sum + x, for a loop over neighbouring floats: Intel's CPU runtime adds these up in another order where there is
// AVX-512, if it sees a sum.
static inline float added(float sum, float x) { return fma(x, 1.0f, sum); }

// Scalar arithmetic with the same bits on every driver. Multiply-adds fuse only in fma1, and the driver's elementary
// functions are not used. Every kernel includes this file first.
#pragma OPENCL FP_CONTRACT OFF
#include "shared/layouts.h"

#define LOG2E 1.44269504088896341f
#define LN2 0.693147180559945f
#ifndef ALPHA_MAX // a build may have another cap of alpha
#define ALPHA_MAX 0.99f
#endif
#ifndef ALPHA_MIN // RasterizerConfig can set ALPHA_MIN, LOG2_ALPHA_MIN and, below, TRANSMITTANCE_MIN
#define ALPHA_MIN (1.0f / 255.0f)
#define LOG2_ALPHA_MIN -7.99435344f // log2(1/255)
#endif
#ifndef TRANSMITTANCE_MIN
#define TRANSMITTANCE_MIN 1e-4f
#endif

// a*b + c with one rounding. FMA_BY_CONTRACTION is set if a test has shown that the driver's compiler fuses the
// expression a * b + c. On such drivers fma() would give the same bits more slowly, and it crashes some of them with 16
// lanes.
static inline float fma1(float a, float b, float c) {
#ifdef FMA_BY_CONTRACTION
#pragma OPENCL FP_CONTRACT ON
  return a * b + c;
#else
  return fma(a, b, c);
#endif
}

// sum + x, for a loop that adds adjacent floats. With AVX-512, Intel's CPU runtime would otherwise recognise a sum in
// such a loop and reorder its additions.
static inline float added(float sum, float x) { return fma(x, 1.0f, sum); }

// The type, with address space, of elements of the model's arrays. With OWN_ROW a work-item has a copy of its own row.
#ifdef OWN_ROW
#define PARAMETER const float
#else
#define PARAMETER __global const float
#endif

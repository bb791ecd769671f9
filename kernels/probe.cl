// One wrapper for each shared function, so that tests can call it alone.
#include "shared/math.h"
#include "shared/lanes.h"

// out[LANES], out[LANES..2 LANES): what fma1 and fmaL make of factor * factor + addend.
__kernel void probe_fma(__global float *out, const float factor, const float addend) {
  STOREL(fmaL((floatL)(factor), (floatL)(factor), (floatL)(addend)), out);
  for (int lane = 0; lane < LANES; ++lane) out[LANES + lane] = fma1(factor, factor, addend);
}

// out[0, 1, 2] += exp1, log2_1, sigmoid1 of x[i] at i, n + i, 2n + i; exp2L in the fourth quarter.
__kernel void probe_elementary(__global const float *x, __global float *out, const uint n) {
  const uint i = get_global_id(0);
  out[i] = exp1(x[i]);
  out[n + i] = log2_1(x[i]);
  out[2 * n + i] = sigmoid1(x[i]);
  const floatL power = exp2L((floatL)(x[i]));
#if LANES == 1
  out[3 * n + i] = power;
#else
  out[3 * n + i] = power.s0;
#endif
}

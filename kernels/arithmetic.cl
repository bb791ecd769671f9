// What the other kernels take for granted of a device's arithmetic, for `clsplat selftest`.
#include "shared/math.h"
#include "shared/lanes.h"

// a, b, c (n), n a multiple of LANES -> out (4, n): a / b, sqrt(b), a b + c with one rounding, and 2^-100 a times 2^-40,
// which is denormal where denormals are kept.
__kernel void arithmetic(const uint n, __global const float *a, __global const float *b, __global const float *c,
                         __global float *out) {
  const uint i = get_global_id(0) * LANES;
  if (i >= n) return;
  const floatL x = LOADL(a + i), y = LOADL(b + i);
  STOREL(x / y, out + i);
  STOREL(sqrt(y), out + n + i);
  STOREL(fmaL(x, y, LOADL(c + i)), out + 2 * n + i);
  STOREL((x * 7.8886090522e-31f) * 9.0949470177e-13f, out + 3 * n + i);
}

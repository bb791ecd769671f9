// Division, square root, fused multiply-add and denormals as the device computes them, for `clsplat selftest`: the
// other kernels rely on their rounding.
//
// Owner: A work-item owns LANES consecutive elements.
// Launch: One work-item for each LANES elements, in groups of 64; work-items past the end do nothing.
// Buffers: a, b, c (n), n a multiple of LANES, without units -> out (4, n): a / b, sqrt(b), a b + c with one rounding,
//   and 2^-100 a times 2^-40, which is denormal if the device keeps denormals.
// Equations: none.
#include "shared/math.h"
#include "shared/lanes.h"

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

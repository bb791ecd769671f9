// Kernels through which tests call single functions of shared/. probe_fma also runs when a device is opened.
//
// Owner: A work-item owns an element; in probe_fma one work-item owns all.
// Launch: One work-item for each element; for probe_fma, a single work-item.
// Buffers: Described above each kernel, without units.
// Equations: none.
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/sh.h"

// Computes factor * factor + addend: by fmaL in the first LANES elements of out, by fma1 in the next LANES.
__kernel void probe_fma(__global float *out, const float factor, const float addend) {
  STOREL(fmaL((floatL)(factor), (floatL)(factor), (floatL)(addend)), out);
  for (int lane = 0; lane < LANES; ++lane) out[LANES + lane] = fma1(factor, factor, addend);
}

// Computes elementary functions: x (n) -> out (4, n): expL, log2L, sigmoidL and exp2L, each from the first lane.
__kernel void probe_elementary(__global const float *x, __global float *out, const uint n) {
  const uint i = get_global_id(0);
  Lanes values[4];
  values[0].all = expL((floatL)(x[i]));
  values[1].all = log2L((floatL)(x[i]));
  values[2].all = sigmoidL((floatL)(x[i]));
  values[3].all = exp2L((floatL)(x[i]));
  for (uint k = 0; k < 4; ++k) out[k * n + i] = values[k].lane[0];
}

// Converts 16-bit floats: bits (n) -> out (n, 4): each value as a float in all four lanes.
__kernel void probe_half(__global const ushort *bits, __global float *out) {
  const uint i = get_global_id(0);
  const float4 value = float_from_half((int4)(bits[i]));
  out[4 * i] = value.x;
  out[4 * i + 1] = value.y;
  out[4 * i + 2] = value.z;
  out[4 * i + 3] = value.w;
}

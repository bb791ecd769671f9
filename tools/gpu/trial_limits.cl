// SPDX-License-Identifier: Apache-2.0
// Kernels that measure one limit of a device each, for trial_limits.py.

// to (n) = from (n), with WIDE float4s per item. In each access, the items of a group have neighbouring float4s.
__kernel void copy(__global const float4 *from, __global float4 *to) {
  const size_t first = get_group_id(0) * get_local_size(0) * WIDE + get_local_id(0);
  float4 held[WIDE];
  for (int k = 0; k < WIDE; ++k) held[k] = from[first + k * get_local_size(0)];
  for (int k = 0; k < WIDE; ++k) to[first + k * get_local_size(0)] = held[k];
}

// to (n) = from (n), with one float per item.
__kernel void copy_floats(__global const float *from, __global float *to) {
  to[get_global_id(0)] = from[get_global_id(0)];
}

// Does nothing, so that only starting groups and launches takes time.
__kernel void nothing(__global uint *sums) {
  if (get_global_size(0) == 0) sums[0] = 1;
}

// Loads that wait for each other: next (n) leads through all its elements in one cycle.
__kernel void chase(const uint steps, __global const uint *next, __global uint *sums) {
  uint at = 0;
  for (uint i = 0; i < steps; ++i) at = next[at];
  sums[0] = at;
}

// Barriers of a group.
__kernel void barriers(const uint steps, __global uint *sums) {
  __local uint turn[1];
  for (uint i = 0; i < steps; ++i) {
    if (get_local_id(0) == i % get_local_size(0)) turn[0] = i;
    barrier(CLK_LOCAL_MEM_FENCE);
  }
  if (get_local_id(0) == 0) sums[get_group_id(0)] = turn[0];
}

// Atomic increments of 256 counters in local memory, at places that differ from item to item and step to step.
__kernel void local_atomics(const uint steps, __global uint *sums) {
  __local uint counters[256];
  for (uint i = get_local_id(0); i < 256; i += get_local_size(0)) counters[i] = 0;
  barrier(CLK_LOCAL_MEM_FENCE);
  for (uint i = 0; i < steps; ++i) atomic_inc(counters + ((get_local_id(0) * 37 + i * 101) & 255));
  barrier(CLK_LOCAL_MEM_FENCE);
  if (get_local_id(0) == 0) sums[get_group_id(0)] = counters[0];
}

// Atomic increments of `many` counters in global memory, one increment per item.
__kernel void global_atomics(const uint many, __global uint *counters) {
  const uint i = get_global_id(0);
  atomic_inc(counters + (i * 2654435761u >> 8) % many);
}

// Fused multiply-adds on eight independent sums per item.
__kernel void multiply_adds(const uint steps, __global float *sums) {
  float8 sum = (float8)(0, 1, 2, 3, 4, 5, 6, 7) + (float)get_local_id(0);
  for (uint i = 0; i < steps; ++i) sum = fma(sum, (float8)(0.999f), (float8)(0.5f));
  sums[get_global_id(0)] = sum.s0 + sum.s1 + sum.s2 + sum.s3 + sum.s4 + sum.s5 + sum.s6 + sum.s7;
}

// native_recip of each float in [1, 2) -> counters (3): number of wrong results, largest error, number of results that
// are wrong after two steps of Newton's method.
__kernel void reciprocals(__global uint *counters) {
  const float x = as_float(0x3f800000u + (uint)get_global_id(0));
  const float start = native_recip(x);
  const float once = fma(start, fma(-x, start, 1.0f), start), twice = fma(once, fma(-x, once, 1.0f), once);
  const float quotient = 1.0f / x;
  const uint off = abs((int)as_uint(start) - (int)as_uint(quotient));
  if (off) {
    atomic_inc(counters);
    atomic_max(counters + 1, off);
  }
  if (as_uint(twice) != as_uint(quotient)) atomic_inc(counters + 2);
}

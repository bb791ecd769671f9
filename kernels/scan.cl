// Exclusive prefix sum of unsigned integers in three launches: the sum of each chunk, the scan of those sums, the scan
// inside each chunk.
//
// Owner: A group owns one chunk; the one of scan_top the sums of all.
// Launch: One group of ITEMS work-items for each chunk; scan_top a single group.
// Buffers: values (n), sums (groups), total (1), out (n): counts; as_flags != 0 takes every nonzero value as 1.
// Equations: out[i] is the sum of values[0] to values[i - 1].
#include "shared/math.h"
#include "shared/group.h"

#define VALUE(x) (as_flags ? (uint)((x) != 0) : (x))

// values (n) -> sums (groups)
GROUP __kernel void scan_sums(const uint n, const uint chunk, const int as_flags, __global const uint *values,
                              __global uint *sums) {
  __local uint scratch[ITEMS];
  const uint begin = get_group_id(0) * chunk;
  const uint end = min(begin + chunk, n);
  uint sum = 0, total;
  for (uint i = begin + get_local_id(0); i < end; i += ITEMS) sum += VALUE(values[i]);
  group_exclusive_scan(sum, scratch, &total);
  if (get_local_id(0) == 0) sums[get_group_id(0)] = total;
}

// One group. sums (groups) -> the same, scanned; total[0] their sum, or 0xffffffff where that does not fit 32 bits.
GROUP __kernel void scan_top(const uint groups, __global uint *sums, __global uint *total) {
  __local uint scratch[ITEMS];
  __local int overflow;
  if (get_local_id(0) == 0) overflow = 0;
  BARRIER_LOCAL();
  uint running = 0;
  for (uint base = 0; base < groups; base += ITEMS) {
    const uint i = base + get_local_id(0);
    uint all;
    const uint sum = i < groups ? sums[i] : 0;
    const uint before = running + group_exclusive_scan(sum, scratch, &all);
    if (i < groups) sums[i] = before;
    if (before + sum < before) overflow = 1; // one item sees the wrap; all that do write the same
    running += all;
  }
  BARRIER_LOCAL();
  if (get_local_id(0) == 0) total[0] = overflow ? 0xffffffff : running;
}

// values (n), scanned sums (groups) -> out (n)
GROUP __kernel void scan_chunks(const uint n, const uint chunk, const int as_flags, __global const uint *values,
                                __global const uint *sums, __global uint *out) {
  __local uint scratch[ITEMS];
  const uint begin = get_group_id(0) * chunk;
  const uint end = min(begin + chunk, n);
  uint running = sums[get_group_id(0)];
  for (uint base = begin; base < end; base += ITEMS) {
    const uint i = base + get_local_id(0);
    uint all;
    const uint before = group_exclusive_scan(i < end ? VALUE(values[i]) : 0, scratch, &all);
    if (i < end) out[i] = running + before;
    running += all;
  }
}

// Exclusive prefix sum (scan) of unsigned integers in two launches. scan_sums computes the sum of each chunk. In
// scan_chunks each group adds up the sums of the earlier chunks, then scans its own chunk. A single chunk needs only
// scan_chunks.
//
// Owner: A group owns one chunk.
// Launch: One group of ITEMS work-items for each chunk.
// Buffers: values (n), sums (groups), total (1), out (n), all without units.
// Equations: out[i] is the sum of values[0] to values[i - 1].
#include "shared/math.h"
#include "shared/group.h"
#include "shared/count.h"

// Sums each chunk: values (n) -> sums (groups).
GROUP __kernel void scan_sums(ELEMENTS(n), const uint chunk, __global const uint *values, __global uint *sums) {
  FIND_ELEMENTS(n)
  __local uint scratch[ITEMS];
  const uint begin = get_group_id(0) * chunk;
  const uint sum = group_sum(values + begin, begin < n ? min(chunk, n - begin) : 0, scratch);
  if (get_local_id(0) == 0) sums[get_group_id(0)] = sum;
}

// Scans each chunk: values (n), sums (groups) -> out (n); total[0]: the sum of all values, or 0xffffffff if it does not
// fit in 32 bits.
GROUP __kernel void scan_chunks(ELEMENTS(n), const uint chunk, __global const uint *values, __global const uint *sums,
                                __global uint *out, __global uint *total) {
  FIND_ELEMENTS(n)
  __local uint scratch[ITEMS];
  const uint begin = get_group_id(0) * chunk;
  const uint end = min(begin + chunk, n);
  ulong running = group_sum(sums, get_group_id(0), scratch);
  for (uint base = begin; base < end; base += ITEMS) {
    const uint i = base + get_local_id(0);
    const uint value = i < end ? values[i] : 0;
    uint all;
    const uint before = group_exclusive_scan(value, scratch, &all);
    if (i < end) out[i] = (uint)running + before;
    running += all;
  }
  if (get_local_id(0) == 0 && get_group_id(0) + 1 == get_num_groups(0)) total[0] = CAPPED(running);
}

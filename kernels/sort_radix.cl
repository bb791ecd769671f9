// One pass of a stable least-significant-digit radix sort: digit histogram of each chunk, (scan.cl over the digit-major
// histograms), scatter. Reduce-then-scan: it needs no forward progress between groups.
//
// Owner: A group owns a chunk and an item a contiguous run of it, so that order within a digit is order of position.
// Launch: One group of ITEMS work-items for each chunk.
// Buffers: keys, values (n), histograms (digits, groups) -> keys_out, values_out (n); counters (digits, ITEMS) in local
//   memory.
// Equations: none; docs/decisions/0001-split-sort.md.
#include "shared/math.h"
#include "shared/group.h"

// Keys count from `base`, which is no larger than any of them.
#define DIGIT(key) ((((key) - base) >> shift) & (digits - 1))

// counters[digit * ITEMS + item]: how many of the item's keys have the digit.
static inline void count_digits(uint begin, uint end, uint base, uint shift, uint digits, __global const uint *keys,
                                __local uint *counters) {
  const uint item = get_local_id(0);
  for (uint i = item; i < digits * ITEMS; i += ITEMS) counters[i] = 0;
  BARRIER_LOCAL();
  for (uint i = begin; i < end; ++i) counters[DIGIT(keys[i]) * ITEMS + item] += 1;
  BARRIER_LOCAL();
}

#define RUN(begin, end)                                                                                                \
  const uint run = (chunk + ITEMS - 1) / ITEMS;                                                                        \
  const uint chunk_end = min((uint)(get_group_id(0) + 1) * chunk, n);                                                  \
  const uint begin = min((uint)get_group_id(0) * chunk + (uint)get_local_id(0) * run, chunk_end);                      \
  const uint end = min(begin + run, chunk_end);

// keys (n) -> histograms (digits, groups)
GROUP __kernel void radix_histogram(const uint n, const uint chunk, const uint base, const uint shift,
                                    const uint digits, __global const uint *keys, __global uint *histograms,
                                    __local uint *counters) {
  RUN(begin, end)
  count_digits(begin, end, base, shift, digits, keys, counters);
  for (uint digit = get_local_id(0); digit < digits; digit += ITEMS) {
    uint sum = 0;
    for (uint item = 0; item < ITEMS; ++item) sum += counters[digit * ITEMS + item];
    histograms[digit * get_num_groups(0) + get_group_id(0)] = sum;
  }
}

// keys, values (n), scanned histograms -> keys_out, values_out (n); identity != 0 takes positions for values.
GROUP __kernel void radix_scatter(const uint n, const uint chunk, const uint base, const uint shift, const uint digits,
                                  const int identity, __global const uint *keys, __global const uint *values,
                                  __global const uint *histograms, __global uint *keys_out, __global uint *values_out,
                                  __local uint *counters) {
  RUN(begin, end)
  count_digits(begin, end, base, shift, digits, keys, counters);
  for (uint digit = get_local_id(0); digit < digits; digit += ITEMS) {
    uint place = histograms[digit * get_num_groups(0) + get_group_id(0)];
    for (uint item = 0; item < ITEMS; ++item) {
      const uint count = counters[digit * ITEMS + item];
      counters[digit * ITEMS + item] = place;
      place += count;
    }
  }
  BARRIER_LOCAL();
  for (uint i = begin; i < end; ++i) {
    const uint key = keys[i];
    const uint place = counters[DIGIT(key) * ITEMS + get_local_id(0)]++;
    keys_out[place] = key;
    values_out[place] = identity ? i : values[i];
  }
}

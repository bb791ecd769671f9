// Bitonic sort of a short array in a single launch, by one group in local memory. For short arrays this is quicker than
// the dozen launches of a radix sort. Equal keys are ordered by value; values are positions, so the sort is stable.
//
// Owner: The group owns the array; a work-item compares every ITEMS-th pair.
// Launch: One group of ITEMS work-items.
// Buffers: keys (n).
//   -> keys_out, values_out (n): sorted; a value is the position in keys.
//   k, v (padded): in local memory; padded is a power of two, at least n.
// Equations: none; Batcher's bitonic network.
#include "shared/math.h"
#include "shared/group.h"
#include "shared/count.h"

GROUP __kernel void bitonic_sort(ELEMENTS(n), const uint padded, __global const uint *keys, __global uint *keys_out,
                                 __global uint *values_out, __local uint *k, __local uint *v) {
  FIND_ELEMENTS(n)
  const uint item = get_local_id(0);
  for (uint i = item; i < padded; i += ITEMS) {
    k[i] = i < n ? keys[i] : 0xffffffff;
    v[i] = i;
  }
  BARRIER_LOCAL();
  for (uint block = 2; block <= padded; block *= 2) {
    for (uint step = block / 2; step > 0; step /= 2) {
      for (uint pair = item; pair < padded / 2; pair += ITEMS) {
        const uint a = 2 * pair - (pair & (step - 1));
        const uint b = a + step;
        const int descending = (a & block) != 0;
        const int greater = k[a] > k[b] || (k[a] == k[b] && v[a] > v[b]);
        if (greater != descending) {
          const uint key = k[a], value = v[a];
          k[a] = k[b];
          v[a] = v[b];
          k[b] = key;
          v[b] = value;
        }
      }
      BARRIER_LOCAL();
    }
  }
  for (uint i = item; i < n; i += ITEMS) {
    keys_out[i] = k[i];
    values_out[i] = v[i];
  }
}

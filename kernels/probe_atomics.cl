// Tests integer atomics in global and in local memory: append.cl needs a driver that counts correctly.
//
// Owner: A work-item owns an element.
// Launch: Any number of groups of ITEMS work-items.
// Buffers: counters (PROBED): zeroed before.
//   -> counters; places (2, items of all groups): the values that each item got from a global counter, and from a local
//     counter of its group. Item i uses counter i % PROBED.
// Equations: none.
#include "shared/group.h"

GROUP __kernel void probe_atomics(__global uint *counters, __global uint *places) {
  __local uint own[PROBED];
  const uint item = get_local_id(0), i = get_global_id(0);
  for (uint k = item; k < PROBED; k += ITEMS) own[k] = 0;
  BARRIER_LOCAL();
  places[i] = atomic_inc(counters + i % PROBED);
  places[get_global_size(0) + i] = atomic_inc(own + item % PROBED);
}

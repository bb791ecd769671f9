// Tests the exchange within sub-groups: a driver's shuffles must work as shared/subgroup.h expects.
//
// Owner: A group of ITEMS work-items; each item has an element of every row.
// Launch: One group.
// Buffers: out (log2 SUBGROUP, ITEMS): row k holds, for each item i, the number of the item from which it received a
//   value; the two numbers differ in bit k.
// Equations: none.
#include "shared/group.h"
#include "shared/subgroup.h"

GROUP SUBGROUPED __kernel void probe_subgroup(__global float *out) {
  const int item = get_local_id(0);
  for (int step = 1; step < SUBGROUP; step *= 2, out += ITEMS) out[item] = EXCHANGED((float)item, step);
}

// What the items of a sub-group exchange: whether a driver's shuffles are those that subgroup.h counts on.
//
// Owner: A group of ITEMS work-items, of which each has a place in every row.
// Launch: One group.
// Buffers: out (log2 SUBGROUP, ITEMS): in row k the number of the item that item i got from, by bit k.
// Equations: none.
#include "shared/group.h"
#include "shared/subgroup.h"

GROUP SUBGROUPED __kernel void probe_subgroup(__global float *out) {
  const int item = get_local_id(0);
  for (int step = 1; step < SUBGROUP; step *= 2, out += ITEMS) out[item] = EXCHANGED((float)item, step);
}

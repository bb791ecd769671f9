// Finds each tile's range of pairs in the sorted list, and writes the slot and the Gaussian of each sorted pair.
//
// Owner: A work-item owns a pair of the sorted list. It writes the start or end of a range where the neighbouring pair
//   has another tile.
// Launch: One work-item for each pair, in groups of 64; work-items past the end do nothing.
// Buffers: tile_keys, pair_from_sorted (pairs): in sorted order.
//   pair_ids (pairs): slot and Gaussian, by depth.
//   -> ranges (tiles, 2), zeroed before; slot_from_sorted, gaussian_from_sorted (pairs). All are indices.
// Equations: none.
#include "shared/math.h"
#include "shared/count.h"

__kernel void ranges(ELEMENTS(pairs), __global const uint *tile_keys, __global const uint *pair_from_sorted,
                     __global const uint2 *pair_ids, __global uint *ranges, __global uint *slot_from_sorted,
                     __global uint *gaussian_from_sorted) {
  FIND_ELEMENTS(pairs)
  const uint i = get_global_id(0);
  if (i >= pairs) return;
  const uint tile = tile_keys[i];
  if (i == 0 || tile_keys[i - 1] != tile) ranges[2 * tile] = i;
  if (i + 1 == pairs || tile_keys[i + 1] != tile) ranges[2 * tile + 1] = i + 1;
  const uint2 id = pair_ids[pair_from_sorted[i]];
  slot_from_sorted[i] = id.x;
  gaussian_from_sorted[i] = id.y;
}

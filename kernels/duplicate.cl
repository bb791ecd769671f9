// Emits one (tile, Gaussian) pair for each tile that the ellipse of a visible Gaussian reaches, in order of depth. A
// stable sort by tile alone then leaves each tile's Gaussians front to back.
//
// Owner: In visible_sums and compact_visible a group owns a chunk of consecutive Gaussians. In order_pairs a work-item
//   owns a pair, in the other kernels a Gaussian.
// Launch: visible_sums and compact_visible: one group of ITEMS work-items for each chunk; the others: one work-item for
//   each Gaussian or pair, in groups of 64.
// Buffers: splats (n, SPLAT_SIZE) in pixels, depth in world units; tile_counts, slots (n): the number of pairs of each
//   Gaussian, and the exclusive scan of these numbers. The other shapes are above each kernel.
// Equations: docs/gradients.md, (47), through shared/tile.h, which project.cl uses to count.
#include "shared/math.h"
#include "shared/group.h"
#include "shared/count.h"
#include "shared/tile.h"
#include "shared/prefetch.h"

// The tiles [*x0, *x1) of tile row ty that the ellipse reaches (tile_span in shared/tile.h), if they are in the band of
// tiles [first_tile, end_tile) in row-major order.
static inline void band_span(const Ellipse *e, int ty, int part, int tiles_x, int first_tile, int end_tile, int *x0,
                             int *x1) {
  tile_span(e, ty, part, tiles_x, x0, x1);
  *x0 = max(*x0, first_tile - ty * tiles_x);
  *x1 = max(*x0, min(*x1, end_tile - ty * tiles_x));
}

// Counts the visible Gaussians and the pairs of each chunk. shown, tile_counts (n) -> sums (2, groups): the two numbers
// of each chunk, at most 0xffffffff; the entries of readback before READBACK_STOPPED become zero. A group owns a chunk.
GROUP __kernel void visible_sums(const uint n, const uint chunk, __global const uint *shown,
                                 __global const uint *tile_counts, __global uint *sums, __global uint *readback) {
  __local uint scratch[ITEMS];
  const uint item = get_local_id(0), group = get_group_id(0);
  const uint begin = group * chunk, end = min(begin + chunk, n);
  uint visible = 0, all;
  for (uint i = begin + item; i < end; i += ITEMS) visible += shown[i] != 0;
  group_exclusive_scan(visible, scratch, &all);
  const uint pairs = group_sum(tile_counts + begin, end - begin, scratch);
  if (item != 0) return;
  sums[group] = all;
  sums[get_num_groups(0) + group] = pairs;
  if (group != 0) return;
  readback[READBACK_VISIBLE] = readback[READBACK_PAIRS] = 0;
  readback[READBACK_KEY_COMPLEMENT] = readback[READBACK_LARGEST_KEY] = readback[READBACK_LONGEST] = 0;
}

// Lists the visible Gaussians with their depths as sort keys. shown, tile_counts (n), sums (2, groups) -> slots (n):
// exclusive scan of the tile counts; gaussian_from_visible, depth_keys (visible). The first four entries of readback,
// zero before, become the numbers of visible Gaussians and of pairs, the complement of the smallest key, and the
// largest key. A key has the bits of a depth, because the bits of positive floats, as integers, have the order of the
// floats. A group owns a chunk.
//
// With BY_CAPACITY, a pass stops if it has more than `capacity` pairs, or if Adam has refused an element in an earlier
// step. All later passes stop too, until the host has reacted. A stopped pass has no visible Gaussians, and its step
// does not change the model.
GROUP __kernel void compact_visible(const uint n, const uint chunk, __global const uint *shown,
                                    __global const uint *tile_counts, __global const float *splats,
                                    __global const uint *sums, __global uint *slots,
                                    __global uint *gaussian_from_visible, __global uint *depth_keys,
                                    __global uint *readback
#ifdef BY_CAPACITY
                                    ,
                                    const uint capacity
#endif
) {
  __local uint scratch[ITEMS], extremes[2];
  if (get_local_id(0) == 0) extremes[0] = 0xffffffff, extremes[1] = 0;
  BARRIER_LOCAL();
  const uint group = get_group_id(0), groups = get_num_groups(0);
  const uint begin = group * chunk, end = min(begin + chunk, n);
  uint visible = group_sum(sums, group, scratch);
  ulong pairs = group_sum(sums + groups, group, scratch);
  // `least` is a minimum of keys, not a maximum of ~key: in groups of 2 to 8 items, Intel's CPU runtime computes ~key
  // with a vector register that it never sets.
  uint least = 0xffffffff, largest = 0;
  for (uint first = begin; first < end; first += ITEMS) {
    const uint i = first + get_local_id(0);
    const uint is_shown = i < end && shown[i] != 0, count = i < end ? tile_counts[i] : 0;
    uint all_shown, all_pairs;
    const uint rank = visible + group_exclusive_scan(is_shown, scratch, &all_shown);
    const uint slot = (uint)pairs + group_exclusive_scan(count, scratch, &all_pairs);
    visible += all_shown;
    pairs += all_pairs;
    if (i < end) slots[i] = slot;
    if (is_shown) {
      const uint key = as_uint(splats[(size_t)SPLAT_SIZE * i + SPLAT_DEPTH]);
      gaussian_from_visible[rank] = i;
      depth_keys[rank] = key;
      least = min(least, key);
      largest = max(largest, key);
    }
  }
  atomic_min(extremes, least);
  atomic_max(extremes + 1, largest);
  BARRIER_LOCAL();
  if (get_local_id(0) != 0) return;
  atomic_max(readback + READBACK_KEY_COMPLEMENT, ~extremes[0]);
  atomic_max(readback + READBACK_LARGEST_KEY, extremes[1]);
  if (group + 1 == groups) {
    int goes_on = 1;
#ifdef BY_CAPACITY
    goes_on = pairs <= capacity;
    for (uint k = READBACK_STOPPED; k < READBACK_SIZE; ++k) goes_on &= readback[k] == 0;
    readback[READBACK_STOPPED] = !goes_on;
#endif
    readback[READBACK_VISIBLE] = goes_on ? visible : 0;
    readback[READBACK_PAIRS] = goes_on ? CAPPED(pairs) : 0;
  }
}

// Puts Gaussians and their tile counts in order of depth. order (visible): indices into gaussian_from_visible, sorted
// by depth -> gaussian_from_rank, counts (visible). With BY_CAPACITY, the tile_counts (n) of a stopped pass become
// zero, so that the pass adds nothing to statistics.
__kernel void order_counts(ELEMENTS(visible), __global const uint *order, __global const uint *gaussian_from_visible,
                           __global uint *tile_counts, __global uint *gaussian_from_rank, __global uint *counts
#ifdef BY_CAPACITY
                           ,
                           const uint n
#endif
) {
  FIND_ELEMENTS(visible)
  const uint rank = get_global_id(0);
#ifdef BY_CAPACITY
  if (rank < n && visible_counts[READBACK_STOPPED]) tile_counts[rank] = 0;
#endif
  if (rank >= visible) return;
  const uint i = gaussian_from_visible[order[rank]];
  gaussian_from_rank[rank] = i;
  counts[rank] = tile_counts[i];
}

// Counts the Gaussians of each tile. tile_counts (n): the number of tiles of the whole image that each Gaussian reaches
// -> counts (tiles), which the caller has set to zero: the length of each tile's list. Integer sums do not depend on
// the order of the atomics.
__kernel void count_by_tile(const uint n, const int tiles_x, const int tiles_y, __global const uint *tile_counts,
                            __global const float *splats, __global uint *counts) {
  const uint i = get_global_id(0);
  if (i >= n || tile_counts[i] == 0) return;
  const Ellipse e = ellipse_of(splats + (size_t)SPLAT_SIZE * i, tiles_x, tiles_y);
  for (int ty = e.tile_y0; ty < e.tile_y1; ++ty) {
    for (int part = 0; part < SPANS; ++part) {
      int x0, x1;
      tile_span(&e, ty, part, tiles_x, &x0, &x1);
      for (int tx = x0; tx < x1; ++tx) atomic_inc(counts + ty * tiles_x + tx);
    }
  }
}

// Counts each Gaussian's tiles in the band [first_tile, end_tile). tile_counts (n): the number of tiles in the whole
// image -> band_counts (n): the number of tiles in the band.
__kernel void band_counts(const uint n, const int tiles_x, const int tiles_y, const int first_tile, const int end_tile,
                          __global const uint *tile_counts, __global const float *splats, __global uint *band_counts) {
  const uint i = get_global_id(0);
  if (i >= n) return;
  uint count = 0;
  if (tile_counts[i] > 0) {
    const Ellipse e = ellipse_of(splats + (size_t)SPLAT_SIZE * i, tiles_x, tiles_y);
    const int y0 = max(e.tile_y0, first_tile / tiles_x), y1 = min(e.tile_y1, (end_tile - 1) / tiles_x + 1);
    for (int ty = y0; ty < y1; ++ty) {
      for (int part = 0; part < SPANS; ++part) {
        int x0, x1;
        band_span(&e, ty, part, tiles_x, first_tile, end_tile, &x0, &x1);
        count += x1 - x0;
      }
    }
  }
  band_counts[i] = count;
}

// Writes the pairs in order of depth. offsets (visible): exclusive scan of the tile counts in order of depth; slots
// (n): exclusive scan of the tile counts in order of the Gaussians -> tile_keys (pairs); pair_ids (pairs): slot and
// Gaussian. A Gaussian's slots are consecutive, and slots follow the order of the Gaussians, so that sums over slots
// stream through memory. Only the band of tiles [first_tile, end_tile) gets pairs; keys count from first_tile.
__kernel void duplicate(ELEMENTS(visible), const int tiles_x, const int tiles_y, const int first_tile,
                        const int end_tile, __global const uint *gaussian_from_rank, __global const uint *offsets,
                        __global const uint *slots, __global const float *splats, __global uint *tile_keys,
                        __global uint2 *pair_ids) {
  FIND_ELEMENTS(visible)
  const uint rank = get_global_id(0);
  if (rank >= visible) return;
  const uint ahead = gaussian_from_rank[min(rank + AHEAD, visible - 1)];
  PREFETCH(splats + (size_t)SPLAT_SIZE * ahead);
  PREFETCH(slots + ahead);
  const uint i = gaussian_from_rank[rank];
  const Ellipse e = ellipse_of(splats + (size_t)SPLAT_SIZE * i, tiles_x, tiles_y);
  uint pair = offsets[rank], slot = slots[i];
  const int y0 = max(e.tile_y0, first_tile / tiles_x), y1 = min(e.tile_y1, (end_tile - 1) / tiles_x + 1);
  for (int ty = y0; ty < y1; ++ty) {
    for (int part = 0; part < SPANS; ++part) {
      int x0, x1;
      band_span(&e, ty, part, tiles_x, first_tile, end_tile, &x0, &x1);
      for (int tx = x0; tx < x1; ++tx, ++pair, ++slot) {
        tile_keys[pair] = ty * tiles_x + tx - first_tile;
        pair_ids[pair] = (uint2)(slot, i);
      }
    }
  }
}

// Writes the pairs in the order of the Gaussians, one per slot. gaussian_from_visible (visible), slots as in duplicate
// -> tile_keys, depth_keys, gaussian_from_slot (pairs).
__kernel void duplicate_slots(const uint visible, const int tiles_x, const int tiles_y, const int first_tile,
                              const int end_tile, __global const uint *gaussian_from_visible,
                              __global const uint *slots, __global const float *splats, __global uint *tile_keys,
                              __global uint *depth_keys, __global uint *gaussian_from_slot) {
  const uint index = get_global_id(0);
  if (index >= visible) return;
  const uint i = gaussian_from_visible[index];
  __global const float *splat = splats + (size_t)SPLAT_SIZE * i;
  const Ellipse e = ellipse_of(splat, tiles_x, tiles_y);
  const uint depth = as_uint(splat[SPLAT_DEPTH]);
  uint slot = slots[i];
  const int y0 = max(e.tile_y0, first_tile / tiles_x), y1 = min(e.tile_y1, (end_tile - 1) / tiles_x + 1);
  for (int ty = y0; ty < y1; ++ty) {
    for (int part = 0; part < SPANS; ++part) {
      int x0, x1;
      band_span(&e, ty, part, tiles_x, first_tile, end_tile, &x0, &x1);
      for (int tx = x0; tx < x1; ++tx, ++slot) {
        tile_keys[slot] = ty * tiles_x + tx - first_tile;
        depth_keys[slot] = depth;
        gaussian_from_slot[slot] = i;
      }
    }
  }
}

// Reorders the pairs from the order of slots to the order of depth. slot_from_pair (pairs), in order of depth; tiles,
// gaussian_from_slot (pairs), in order of slots -> tile_keys, pair_ids (pairs), in order of depth.
__kernel void order_pairs(const uint pairs, __global const uint *slot_from_pair, __global const uint *tiles,
                          __global const uint *gaussian_from_slot, __global uint *tile_keys, __global uint2 *pair_ids) {
  const uint pair = get_global_id(0);
  if (pair >= pairs) return;
  const uint slot = slot_from_pair[pair];
  tile_keys[pair] = tiles[slot];
  pair_ids[pair] = (uint2)(slot, gaussian_from_slot[slot]);
}

// Builds the tile lists by appending, for groups of several items. Every Gaussian is appended to the lists of its
// tiles, in any order. A group then sorts a tile's list by (depth, slot). Slots follow the order of the Gaussians. So
// the lists have the same order as those of duplicate.cl and ranges.cl: by depth, then by the Gaussian's index.
//
// Owner: In append_pairs a work-item owns a Gaussian; the items of a group share a Gaussian whose box of tiles is
//   large. In list_offsets one group owns all tiles, and a second group owns the array `sums`. In sort_lists a group
//   owns a tile.
// Launch: append_pairs: one work-item for each Gaussian, in groups of ITEMS; list_offsets: two groups; sort_lists: one
//   group for each tile.
// Buffers: splats (n, SPLAT_SIZE): in pixels, depth in world units. tile_counts (n). counts, slots and sums: of the
//   projection (`lengths`, slots and sums in shared/list_counts.h).
//   -> slots (n): each Gaussian's first slot; ranges (tiles, 2): a list's begin and end; gaussian_from_sorted,
//     slot_from_sorted (pairs): the lists.
//   The other shapes are above each kernel.
// Equations: docs/gradients.md, (47), through shared/tile.h; Batcher's bitonic network.
#include "shared/math.h"
#include "shared/group.h"
#include "shared/tile.h"
#include "shared/list_counts.h"

// Number of loads that an item starts before it waits for the first.
#define AHEAD 4
#define EACH_AHEAD(i) _Pragma("unroll") for (uint i = 0; i < AHEAD; ++i)

// A pair of a tile and a Gaussian: .x is its slot, .y the bits of its depth. Lists are sorted by depth, then by slot.
typedef uint2 Pair;
// Filler for the unused end of a list in local memory; it sorts after every pair.
#define NO_PAIR ((Pair)(0xffffffff))

// Swaps two pairs if the first sorts after the second, by one comparison of 64 bits and four selections.
static inline void order_two(Pair *one, Pair *other) {
  const Pair a = *one, b = *other;
  const int after = ((ulong)a.y << 32 | a.x) > ((ulong)b.y << 32 | b.x);
  *one = (Pair)(after ? b.x : a.x, after ? b.y : a.y);
  *other = (Pair)(after ? a.x : b.x, after ? a.y : b.y);
}

// The index in local memory of a list's pair `number`. The indices within each run of 16 pairs are permuted, so that
// neighbouring items use different banks of local memory in every step of the sorting network. PLACE(a ^ b) is PLACE(a)
// ^ PLACE(b).
#define PLACE(number) ((number) ^ ((number) >> 4 & 3) ^ ((number) >> 2 & 12))

// Takes two steps of the sorting network over `pairs` (count) in local memory. The first step compares pairs that are
// `step` apart. If `mirrored`, it compares pairs at equal distances from the two ends of a block of 2 * step pairs. The
// second step compares pairs that are step / 2 apart. An item does both steps for four pairs in registers; these may
// lie past `count`, up to the next power of two.
//
// If `step` is 1, the two steps compare pairs that are 2 and 1 apart. The first is then redundant: it repeats an
// earlier step, or it comes before all others, when the pairs may be in any order.
static inline void order_steps(__local Pair *pairs, uint count, uint step, int mirrored) {
  const uint apart = max(step / 2, 1u), within = apart - 1;
  const uint near = PLACE(apart), far = PLACE(mirrored ? 3 * apart - 1 : 2 * apart), turned = mirrored ? near : 0;
  for (uint k = get_local_id(0); 4 * k - 3 * (k & within) < count; k += ITEMS) {
    const uint number = 4 * k - 3 * (k & within), place = PLACE(number);
    Pair one = pairs[place], two = pairs[place ^ near];
    Pair three = pairs[place ^ far ^ turned], four = pairs[place ^ far ^ near ^ turned];
    order_two(&one, &three);
    order_two(&two, &four);
    order_two(&one, &two);
    order_two(&three, &four);
    pairs[place] = one;
    pairs[place ^ near] = two;
    pairs[place ^ far] = three;
    pairs[place ^ far ^ near] = four;
  }
  BARRIER_LOCAL();
}

// Takes one step of the sorting network over `list` (count) in global memory. Every comparison puts the lesser pair
// first. So the list needs no filler up to a power of two: the filler would stay at the end.
static inline void order_step_far(__global Pair *list, uint count, uint step, int mirrored) {
  for (uint k = get_local_id(0); 2 * k - (k & (step - 1)) + 1 < count; k += ITEMS) {
    const uint a = 2 * k - (k & (step - 1));
    const uint b = mirrored ? (a | (2 * step - 1)) - (a & (step - 1)) : a + step;
    if (b < count) {
      Pair one = list[a], other = list[b];
      order_two(&one, &other);
      list[a] = one;
      list[b] = other;
    }
  }
  BARRIER_GLOBAL();
}

// Copies `list` (count) to `pairs` (whole) in local memory, and fills the rest of `pairs` with NO_PAIR. An item reads
// only the elements that it also writes in store_pairs, because the barriers in between do not order global memory.
static inline void fetch_pairs(__global const Pair *list, uint count, uint whole, __local Pair *pairs) {
  for (uint k = get_local_id(0); k < whole; k += AHEAD * ITEMS) {
    Pair ahead[AHEAD];
    EACH_AHEAD(i) if (k + i * ITEMS < count) ahead[i] = list[k + i * ITEMS];
    EACH_AHEAD(i) {
      const uint place = k + i * ITEMS;
      if (place < whole) pairs[PLACE(place)] = place < count ? ahead[i] : NO_PAIR;
    }
  }
  BARRIER_LOCAL();
}

// Writes `pairs` (count) in local memory back to `list` in global memory.
static inline void store_pairs(__global Pair *list, uint count, __local const Pair *pairs) {
  for (uint k = get_local_id(0); k < count; k += ITEMS) list[k] = pairs[PLACE(k)];
  BARRIER_GLOBAL();
  BARRIER_LOCAL();
}

// Computes where each tile's list begins. counts (tiles + 1), sums (groups) of the projection -> counts: the index at
// which each list begins; sums: the exclusive scan of `sums`; ranges (tiles, 2); order (tiles): the tiles sorted by
// floor(log2) of their lists' lengths, longest first, because these take longest to sort.
//
// readback gets the same entries as from compact_visible in duplicate.cl, except that the two entries for keys are 0,
// and in addition the length of the longest list. A pass stops under the conditions that the comment of compact_visible
// names. A stopped pass has empty lists.
GROUP __kernel void list_offsets(const uint tiles, const uint groups, const uint capacity, __global uint *counts,
                                 __global uint *sums, __global uint *ranges, __global uint *order,
                                 __global uint *readback) {
  __local uint scratch[ITEMS], places[33], longest;
  __local int stopped;
  const uint item = get_local_id(0), has_tiles = get_group_id(0) == 0, number = has_tiles ? tiles : groups;
  const uint run = (number + ITEMS - 1) / ITEMS, begin = min(item * run, number), end = min(begin + run, number);
  const uint end_of_tiles = has_tiles ? end : begin;
  __global uint *values = has_tiles ? counts : sums;
  ulong sum = 0;
  uint all, most = 0;
  for (uint k = begin; k < end; k += AHEAD) {
    uint ahead[AHEAD];
    EACH_AHEAD(i) ahead[i] = k + i < end ? values[k + i] : 0;
    EACH_AHEAD(i) {
      sum += ahead[i];
      most = max(most, ahead[i]);
    }
  }
  for (uint k = item; k < 33; k += ITEMS) places[k] = 0;
  if (item == 0) longest = 0;
  uint before = group_exclusive_scan(CAPPED(sum), scratch, &all);
  BARRIER_LOCAL();
  atomic_max(&longest, most);
  BARRIER_LOCAL();
  if (item == 0) {
    stopped = all > capacity;
    if (has_tiles) {
      for (uint k = READBACK_STOPPED; k < READBACK_SIZE; ++k) stopped |= readback[k] != 0;
      readback[READBACK_VISIBLE] = stopped ? 0 : counts[tiles];
      readback[READBACK_PAIRS] = stopped ? 0 : all;
      readback[READBACK_KEY_COMPLEMENT] = readback[READBACK_LARGEST_KEY] = 0;
      readback[READBACK_LONGEST] = stopped ? 0 : longest;
      readback[READBACK_STOPPED] = stopped;
    }
  }
  BARRIER_LOCAL();
  for (uint first = begin; first < end; first += AHEAD) {
    uint ahead[AHEAD];
    EACH_AHEAD(i) ahead[i] = first + i < end ? values[first + i] : 0;
    EACH_AHEAD(i) if (first + i < end) {
      const uint tile = first + i, length = ahead[i];
      values[tile] = before;
      if (has_tiles) {
        const int listed = length > 0 && !stopped;
        ranges[2 * tile] = listed ? before : 0;
        ranges[2 * tile + 1] = listed ? before + length : 0;
        atomic_inc(places + clz(listed ? length : 0));
      }
      before += length;
    }
  }
  BARRIER_LOCAL();
  if (item == 0) {
    uint place = 0;
    for (uint k = 0; k < 33; ++k) {
      const uint lists = places[k];
      places[k] = place;
      place += lists;
    }
  }
  BARRIER_LOCAL();
  for (uint k = begin; k < end_of_tiles; k += AHEAD) {
    uint ahead[AHEAD];
    EACH_AHEAD(i) if (k + i < end_of_tiles) ahead[i] = ranges[2 * (k + i) + 1] - ranges[2 * (k + i)];
    EACH_AHEAD(i) if (k + i < end_of_tiles) order[atomic_inc(places + clz(ahead[i]))] = k + i;
  }
}

// Appends the pair of `slot` and the local variable `depth` to the list of `tile`. gaussian: the Gaussian's index.
#define APPEND(tile, slot, gaussian)                                                                                   \
  {                                                                                                                    \
    pairs[atomic_inc(cursors + (tile))] = (Pair)(slot, depth);                                                         \
    gaussian_from_slot[slot] = gaussian;                                                                               \
  }

// Appends every Gaussian to the lists of its tiles. sums (groups) and cursors (tiles), which are the `sums` and
// `counts` of list_offsets; slots (n) of the projection -> slots (n): each Gaussian's first slot; pairs (pairs): slot
// and depth, grouped by tile, in any order within a tile; gaussian_from_slot (pairs). In a stopped pass, tile_counts
// (n) become zero, so that the pass adds nothing to statistics.
GROUP __kernel void append_pairs(const uint n, const int tiles_x, const int tiles_y, __global const float *splats,
                                 __global const uint *sums, __global const uint *readback, __global uint *cursors,
                                 __global uint *tile_counts, __global uint *slots, __global Pair *pairs,
                                 __global uint *gaussian_from_slot) {
  __local uint wide[ITEMS], wide_slots[ITEMS], wides;
  const uint i = get_global_id(0), item = get_local_id(0), stopped = readback[READBACK_STOPPED];
  if (item == 0) wides = 0;
  BARRIER_LOCAL();
  if (i < n) {
    uint slot = sums[i / ITEMS] + slots[i];
    slots[i] = slot;
    if (stopped) {
      tile_counts[i] = 0;
    } else if (tile_counts[i] > 0) {
      __global const float *splat = splats + (size_t)SPLAT_SIZE * i;
      const Ellipse e = ellipse_of(splat, tiles_x, tiles_y);
      if (e.box > OWN_BOX) {
        const uint place = atomic_inc(&wides);
        wide[place] = i;
        wide_slots[place] = slot;
      } else {
        const uint depth = as_uint(splat[SPLAT_DEPTH]);
        for (int ty = e.tile_y0; ty < e.tile_y1; ++ty) {
          for (int part = 0; part < SPANS; ++part) {
            int x0, x1;
            tile_span(&e, ty, part, tiles_x, &x0, &x1);
            for (int tx = x0; tx < x1; ++tx, ++slot) APPEND(ty * tiles_x + tx, slot, i)
          }
        }
      }
    }
  }
  BARRIER_LOCAL();
  for (uint k = 0; k < wides; ++k) {
    __global const float *splat = splats + (size_t)SPLAT_SIZE * wide[k];
    const Ellipse e = ellipse_of(splat, tiles_x, tiles_y);
    const uint depth = as_uint(splat[SPLAT_DEPTH]);
    uint slot = wide_slots[k];
    for (int row = e.tile_y0; row < e.tile_y1; ++row) {
      for (int part = 0; part < SPANS; ++part) {
        int x0, x1;
        tile_span(&e, row, part, tiles_x, &x0, &x1);
        if ((row - e.tile_y0) % (ITEMS / SIDE) == (int)item / SIDE) {
          for (int tx = x0 + (int)item % SIDE; tx < x1; tx += SIDE) {
            APPEND(row * tiles_x + tx, slot + (tx - x0), wide[k])
          }
        }
        slot += x1 - x0;
      }
    }
  }
}

// Sorts each tile's list. order and ranges of list_offsets; pairs and gaussian_from_slot (pairs) of append_pairs ->
// gaussian_from_sorted, slot_from_sorted (pairs). `near` in local memory has room for `fit` pairs, a power of two and
// at least 16. A longer list is sorted in parts of `fit` pairs; then the parts are merged in ever larger blocks, in
// `pairs`.
GROUP __kernel void sort_lists(const uint fit, __global const uint *order, __global const uint *ranges,
                               __global const uint *gaussian_from_slot, __global Pair *pairs,
                               __global uint *gaussian_from_sorted, __global uint *slot_from_sorted,
                               __local Pair *near) {
  const uint tile = order[get_group_id(0)], begin = ranges[2 * tile], count = ranges[2 * tile + 1] - begin;
  __global Pair *list = pairs + begin;
  // One loop handles the parts and the larger blocks, because PoCL compiles two loops with barriers inside to wrong
  // code.
  for (uint stage = fit / 2; stage == fit / 2 || stage < count; stage *= 2) {
    for (uint step = stage; step >= fit; step /= 2) order_step_far(list, count, step, step == stage);
    for (uint first = 0; first < count; first += fit) {
      const uint here = min(fit, count - first), sorts = stage < fit;
      const uint whole = sorts && here < fit ? max(4u, 1u << (32 - clz(here - 1))) : fit;
      fetch_pairs(list + first, here, whole, near);
      for (uint half_block = sorts ? 1 : fit / 2; half_block < (sorts ? here : fit); half_block *= 2) {
        for (uint step = half_block; step > 0; step /= 4) {
          order_steps(near, here, step, sorts && step == half_block);
        }
      }
      store_pairs(list + first, count > fit ? here : 0, near);
    }
  }
  for (uint k = get_local_id(0); k < count; k += AHEAD * ITEMS) {
    uint slot[AHEAD], gaussian[AHEAD];
    EACH_AHEAD(i) {
      const uint place = min(k + i * ITEMS, count - 1);
      slot[i] = count > fit ? list[place].x : near[PLACE(place)].x;
    }
    EACH_AHEAD(i) gaussian[i] = gaussian_from_slot[slot[i]];
    EACH_AHEAD(i) {
      const uint place = k + i * ITEMS;
      if (place < count) {
        gaussian_from_sorted[begin + place] = gaussian[i];
        slot_from_sorted[begin + place] = slot[i];
      }
    }
  }
}

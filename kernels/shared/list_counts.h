// Counts the pairs of a tile and a Gaussian for lists by append (append.cl). With COUNTS_LISTS a projection kernel
// counts the pairs of the Gaussians that it projects. Each work-item then has one Gaussian, and a group has ITEMS
// items. The items of a group share the tiles of a Gaussian whose box of tiles is wide.

// Number of tiles in the largest box that an item processes alone. A larger box is wide.
#define OWN_BOX 32
// Number of items that share a row of tiles of a wide box.
#define SIDE (ITEMS < 8 ? ITEMS : 8)

// A projection kernel has the attribute COUNTING_GROUP and COUNT_PARAMETERS at its end, begins with BEGIN_COUNTS and
// ends with COUNT_LISTS. In between it uses LEAVE in place of `return`, because all items of a group must reach the
// barriers of COUNT_LISTS. The kernel calls SET_TILE_COUNT for each Gaussian, and KEEP_ELLIPSE for each visible one.
#ifndef COUNTS_LISTS
#define COUNTING_GROUP
#define COUNT_PARAMETERS
#define BEGIN_COUNTS
#define LEAVE return
#define SET_TILE_COUNT(row, count) tile_counts[row] = count
#define KEEP_ELLIPSE(e)
#define COUNT_LISTS
#else
#include "shared/group.h"
#define COUNTING_GROUP GROUP
#define COUNT_PARAMETERS , __global uint *lengths, __global uint *slots, __global uint *sums
#define BEGIN_COUNTS                                                                                                   \
  __local GroupCounts group;                                                                                           \
  Ellipse own_ellipse;                                                                                                 \
  uint own_count = 0;                                                                                                  \
  int own_visible = 0;
#define LEAVE goto counting
#define SET_TILE_COUNT(row, count) own_count = count // its address would take two registers
#define KEEP_ELLIPSE(e) own_ellipse = e, own_visible = 1
#define COUNT_LISTS                                                                                                    \
  counting:                                                                                                            \
  count_lists(n, own_count, &own_ellipse, own_visible, tiles_x, tiles_y, splats, tile_counts, lengths, slots, sums,    \
              &group);

// A group's local memory. wide: indices of Gaussians with wide boxes; wides: their number; visible: number of visible
// Gaussians; scratch: for the prefix sum.
typedef struct {
  uint scratch[ITEMS], wide[ITEMS], wides, visible;
} GroupCounts;

// Counts the pairs of each tile and of each group of Gaussians. count: the number of tiles of the item's Gaussian; e:
// its ellipse, read if count is not 0; visible: 1 if the Gaussian is visible, otherwise 0.
//   -> tile_counts (n): `count`; lengths (tiles + 1), zeroed before: the length of each tile's list, then the number of
//     visible Gaussians; slots (n): the number of pairs of earlier Gaussians in the same group; sums (groups): the
//     number of all pairs of a group. Integer sums do not depend on the order of the atomics.
static inline void count_lists(uint n, uint count, const Ellipse *e, int visible, int tiles_x, int tiles_y,
                               __global const float *splats, __global uint *tile_counts, __global uint *lengths,
                               __global uint *slots, __global uint *sums, __local GroupCounts *group) {
  // Of get_global_id, which has 64 bits, the compiler would keep both halves in registers.
  const uint item = get_local_id(0), i = (uint)get_group_id(0) * ITEMS + item;
  uint pairs;
  if (item == 0) group->wides = group->visible = 0;
  const uint before = group_exclusive_scan(count, group->scratch, &pairs);
  BARRIER_LOCAL();
  if (i < n) {
    tile_counts[i] = count;
    slots[i] = before;
  }
  if (visible) atomic_inc(&group->visible);
  if (count > 0) {
    if (e->box > OWN_BOX) {
      group->wide[atomic_inc(&group->wides)] = i;
    } else {
      for (int ty = e->tile_y0; ty < e->tile_y1; ++ty) {
        for (int part = 0; part < SPANS; ++part) {
          int x0, x1;
          tile_span(e, ty, part, tiles_x, &x0, &x1);
          for (int tx = x0; tx < x1; ++tx) atomic_inc(lengths + ty * tiles_x + tx);
        }
      }
    }
  }
  barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE); // other items read the splats of wide boxes
  for (uint k = 0; k < group->wides; ++k) {
    const Ellipse wide = ellipse_of(splats + (size_t)SPLAT_SIZE * group->wide[k], tiles_x, tiles_y);
    for (int row = wide.tile_y0 + (int)item / SIDE; row < wide.tile_y1; row += ITEMS / SIDE) {
      for (int part = 0; part < SPANS; ++part) {
        int x0, x1;
        tile_span(&wide, row, part, tiles_x, &x0, &x1);
        for (int tx = x0 + (int)item % SIDE; tx < x1; tx += SIDE) atomic_inc(lengths + row * tiles_x + tx);
      }
    }
  }
  if (item == 0) {
    sums[get_group_id(0)] = pairs;
    atomic_add(lengths + tiles_x * tiles_y, group->visible);
  }
}
#endif

// Operations of a whole work-group: barriers, maximum, prefix sum and sum. With ITEMS == 1 a group is one work-item,
// and the operations compile to nothing.
#ifndef ITEMS
#error "ITEMS must be defined: work-items per group, 1 on CPUs"
#endif
#if ITEMS == 1
#define BARRIER_LOCAL()
#define BARRIER_GLOBAL()
#else
#define BARRIER_LOCAL() barrier(CLK_LOCAL_MEM_FENCE)
#define BARRIER_GLOBAL() barrier(CLK_GLOBAL_MEM_FENCE)
#endif
#define GROUP __attribute__((reqd_work_group_size(ITEMS, 1, 1)))

// Sets the int `value` of every item to the group's maximum. Use this once, in the outermost scope of a kernel, because
// it declares local memory.
#if ITEMS == 1
#define RAISE_TO_GROUP_MAX(value)
#else
#define RAISE_TO_GROUP_MAX(value)                                                                                      \
  __local int group_max;                                                                                               \
  if (get_local_id(0) == 0) group_max = value;                                                                         \
  barrier(CLK_LOCAL_MEM_FENCE);                                                                                        \
  atomic_max(&group_max, value);                                                                                       \
  barrier(CLK_LOCAL_MEM_FENCE);                                                                                        \
  value = group_max;
#endif

// A 64-bit sum as 32 bits, or 0xffffffff if it does not fit. Such a saturating sum does not depend on the order of
// addition.
#define CAPPED(sum) ((sum) > 0xffffffff ? 0xffffffff : (uint)(sum))

// Keeps the rounds of group_exclusive_scan from being unrolled. Intel's CPU runtime would unroll five rounds. A pass of
// its compiler (sycl-kernel-reduce-cross-barrier-values) then reads freed memory in kernels with barriers and about 50
// basic blocks.
#if ITEMS < 64
#define ROUNDS _Pragma("unroll 1")
#else
#define ROUNDS
#endif

// The exclusive prefix sum over the group: returns the sum of the values of all items before this item, and sets *total
// to the sum over all items. Sums saturate at 0xffffffff. scratch: ITEMS elements.
static inline uint group_exclusive_scan(uint value, __local uint *scratch, uint *total) {
#if ITEMS == 1
  *total = value;
  return 0;
#else
  const uint item = get_local_id(0);
  scratch[item] = value;
  barrier(CLK_LOCAL_MEM_FENCE);
  ROUNDS for (uint step = 1; step < ITEMS; step *= 2) {
    const uint add = item >= step ? scratch[item - step] : 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    scratch[item] = CAPPED((ulong)scratch[item] + add);
    barrier(CLK_LOCAL_MEM_FENCE);
  }
  *total = scratch[ITEMS - 1];
  const uint before = item > 0 ? scratch[item - 1] : 0;
  barrier(CLK_LOCAL_MEM_FENCE);
  return before;
#endif
}

// The number of a group's tile within the launch: the group's number, or tile_order[group's number] with TILE_ORDER.
// tile_order (tiles) lists the tiles in the order in which groups process them.
#ifdef TILE_ORDER
#define TILE_ORDER_PARAMETER , __global const uint *tile_order
#define LISTED_TILE(group) tile_order[group]
#else
#define TILE_ORDER_PARAMETER
#define LISTED_TILE(group) (group)
#endif

// Defines the group's tile, from the kernel's arguments first_tile, tiles_x, height and ranges: (tile_x, tile_y), the
// tile's first pixel; [begin, end), the tile's pairs; stride and plane, the distances of rows and of planes in floats.
#define TILE_OF_GROUP                                                                                                  \
  const int listed_tile = LISTED_TILE(get_group_id(0));                                                                \
  TILE_OF_LIST(begin, end)
#define TILE_OF_LIST(begin, end)                                                                                       \
  const int tile = first_tile + listed_tile;                                                                           \
  const int tile_x = (tile % tiles_x) * TILE, tile_y = (tile / tiles_x) * TILE;                                        \
  const int begin = ranges[2 * listed_tile], end = ranges[2 * listed_tile + 1];                                        \
  const size_t stride = (size_t)tiles_x * TILE;                                                                        \
  const size_t plane = stride * ((height + TILE - 1) / TILE * TILE);

// The sum of values (count), returned to every item of the group; it saturates at 0xffffffff. scratch: ITEMS elements.
static inline uint group_sum(__global const uint *values, uint count, __local uint *scratch) {
  ulong sum = 0;
  uint total;
  for (uint i = get_local_id(0); i < count; i += ITEMS) sum += values[i];
  group_exclusive_scan(CAPPED(sum), scratch, &total);
  return total;
}

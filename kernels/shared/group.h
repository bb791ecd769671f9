// Tasks that a work-group does together. At ITEMS == 1 a group is one sequential work-item and nothing is left of this.
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

// Raises `value`, an int that every item has, to the largest of the group's. In a kernel's own scope and once in it, as
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

// A sum of 64 bits in 32, 0xffffffff where it does not fit. So a sum of many is the same in every order of addition.
#define CAPPED(sum) ((sum) > 0xffffffff ? 0xffffffff : (uint)(sum))

// Intel's runtime for CPUs unrolls five rounds, and one of its compiler's passes
// (sycl-kernel-reduce-cross-barrier-values) reads memory that it has freed where a kernel with barriers has some 50
// basic blocks.
#if ITEMS < 64
#define ROUNDS _Pragma("unroll 1")
#else
#define ROUNDS
#endif

// The sum of the values of the items before this one; *total gets the sum of all. Sums stop at 0xffffffff. scratch
// holds ITEMS elements.
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

// Where a group is, from a kernel's first_tile, tiles_x, height and ranges: the first pixel of its tile; its list, the
// pairs from `begin` to before `end`; floats from a row of a plane to the next, and from plane to plane.
#define TILE_OF_GROUP                                                                                                  \
  const int tile = first_tile + get_group_id(0);                                                                       \
  const int tile_x = (tile % tiles_x) * TILE, tile_y = (tile / tiles_x) * TILE;                                        \
  const int begin = ranges[2 * get_group_id(0)], end = ranges[2 * get_group_id(0) + 1];                                \
  const size_t stride = (size_t)tiles_x * TILE;                                                                        \
  const size_t plane = stride * ((height + TILE - 1) / TILE * TILE);

// The sum of values (count), for every item; it stops at 0xffffffff. scratch holds ITEMS elements.
static inline uint group_sum(__global const uint *values, uint count, __local uint *scratch) {
  ulong sum = 0;
  uint total;
  for (uint i = get_local_id(0); i < count; i += ITEMS) sum += values[i];
  group_exclusive_scan(CAPPED(sum), scratch, &total);
  return total;
}

// Sums over ADDENDS items, those of a group or of a warp, by a binary tree: sums of two neighbours, then of four, of
// eight and so on. The order and the bits are the same whether items leave their addends in local memory or exchange
// them in sub-groups of SUBGROUP items. ADDEND: the item's number among the ADDENDS items.
#ifndef ADDENDS
#define ADDENDS ITEMS
#define ADDEND ITEM
#endif
// Number of items that add up values by exchange, and then store one sum in each row of local memory.
#define EXCHANGING (SUBGROUP < ADDENDS ? SUBGROUP : ADDENDS)
#define PARTS (ADDENDS / EXCHANGING) // number of sums that local memory holds per row

// Rows are padded so that they begin in different banks of local memory.
#define ROW (PARTS < 4 ? PARTS : PARTS + 4)

static inline float sum_of_1(__local const float *row) { return row[0]; }
static inline float sum_of_4(__local const float *row) {
  const float4 four = *(__local const float4 *)row;
  return (four.x + four.y) + (four.z + four.w);
}
#define DOUBLED(half, whole)                                                                                           \
  static inline float sum_of_##whole(__local const float *row) {                                                       \
    return sum_of_##half(row) + sum_of_##half(row + half);                                                             \
  }
DOUBLED(1, 2)
DOUBLED(4, 8)
DOUBLED(8, 16)
DOUBLED(16, 32)
DOUBLED(32, 64)
DOUBLED(64, 128)
DOUBLED(128, 256)

// The sum of the PARTS numbers of a row in local memory.
static inline float row_sum(__local const float *row) {
  return PARTS == 1     ? sum_of_1(row)
         : PARTS == 2   ? sum_of_2(row)
         : PARTS == 4   ? sum_of_4(row)
         : PARTS == 8   ? sum_of_8(row)
         : PARTS == 16  ? sum_of_16(row)
         : PARTS == 32  ? sum_of_32(row)
         : PARTS == 64  ? sum_of_64(row)
         : PARTS == 128 ? sum_of_128(row)
                        : sum_of_256(row);
}

#if SUBGROUP > 1
// Adds up the fields of a pair over a sub-group, and stores each field's sum in the field's row, in the sub-group's
// element; `rows` is the first row. In each step two items exchange values: each gives half of its fields away, and
// adds the values that it gets to the fields that it keeps. At the end an item has one field, or a few.
static inline void leave_sums(const float *sums, __local float *rows) {
  float held[SLOT_STRIDE];
  int n = SLOT_STRIDE, begin = 0, end = SLOT_STRIDE; // the item holds the fields [begin, end)
  _Pragma("unroll") for (int field = 0; field < SLOT_STRIDE; ++field) held[field] = sums[field];
  _Pragma("unroll") for (int step = 1; step < EXCHANGING; step *= 2) {
    const int upper = (ADDEND & step) != 0;
    if (n > 1) {
      const int kept = (n + 1) / 2;
      _Pragma("unroll") for (int k = 0; k < kept; ++k) {
        const float low = held[k], high = k + kept < n ? held[k + kept] : 0.0f;
        const float given = upper ? low : high;
        held[k] = (upper ? high : low) + EXCHANGED(given, step);
      }
      end = upper ? end : min(begin + kept, end);
      begin = upper ? begin + kept : begin;
      n = kept;
    } else {
      held[0] += EXCHANGED(held[0], step);
      end = upper ? begin : end;
    }
  }
  _Pragma("unroll") for (int k = 0; k < n; ++k) if (begin + k < end) rows[(begin + k) * ROW + ADDEND / EXCHANGING] =
      held[k];
}
#else
static inline void leave_sums(const float *sums, __local float *rows) {
  for (int field = 0; field < SLOT_STRIDE; ++field) rows[field * ROW + ADDEND] = sums[field];
}
#endif

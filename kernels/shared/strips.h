// Sums over a tile's pixels for blend_grad.cl, in a group of work-items. From 32 items on, the order of addition does
// not depend on their number. A strip is a row of blocks, half of the tile. Each of its 32 lanes adds its pixels from
// left to right, and applies v, which is the same for all of them. A tree then adds the lanes, and the strips are added
// from top to bottom.
//
// A team of items owns a strip, or several one after the other, and walks TOGETHER of the strip's pairs at a time. Its
// items leave their sums in rows of local memory, one row for each field. Then each item adds up a row.
#define STRIP_CELLS (OWNED < BLOCK_COLUMNS ? OWNED : BLOCK_COLUMNS) // cells of an item in a strip
#define OWN_STRIPS (OWNED / STRIP_CELLS)
#define TEAMS (BLOCK_ROWS / OWN_STRIPS)
#define TEAM_WARPS (WARPS / TEAMS)
#define TEAM_ITEM (ITEM % (ITEMS / TEAMS))
#define TEAM (ITEM / (ITEMS / TEAMS))
#define TEAM_WARP (WARP % TEAM_WARPS)

#define ADDENDS BLOCK_ITEMS
#define ADDEND LANE
#if TEAM_WARPS > 1 // items of several warps exchange nothing
#undef SUBGROUP
#undef SUBGROUPED
#define SUBGROUP 1
#define SUBGROUPED
#endif
#include "shared/item_sums.h"
#define ACROSS_TEAMS (SUBGROUP > BLOCK_ITEMS) // a sub-group has items of two teams, which then go on together
#define ABREAST (ITEMS < SLOT_STRIDE ? ITEMS : SLOT_STRIDE) // items that write a slot

// True if a pair reaches all blocks of a strip. It is then quicker to take all of the item's pixels without a branch.
#define IS_WHOLE(reach) (!ALL_REACHED && ((reach) & FIRST_BLOCKS(BLOCK_COLUMNS)) == FIRST_BLOCKS(BLOCK_COLUMNS))

#define FOR_FIELDS(field) _Pragma("unroll") for (int field = 0; field < SLOT_STRIDE; ++field)
#define FOR_STRIP(c) _Pragma("unroll") for (int c = 0; c < STRIP_CELLS; ++c)

// The fields that finish_row computes; the others have sums over pixels. With RAYS each pixel has its own v.
#ifdef RAYS
#define OF_ROW(field) 0
#define CELL_FIELDS SLOT_STRIDE
#define PLACE_IN_CELL(field) (field)
#else
#define OF_ROW(field) ((field) == SLOT_GV || (field) == SLOT_GUV || (field) == SLOT_GVV)
#define CELL_FIELDS (SLOT_STRIDE - 3)
#define PLACE_IN_CELL(field) ((field) - ((field) > SLOT_GV) - ((field) > SLOT_GUV) - ((field) > SLOT_GVV))
#endif

// Rows of a pair: one for each field, or first one for each block and field if several warps share the strip.
#define PAIR_ROWS (TEAM_WARPS == 1 ? SLOT_STRIDE : BLOCK_COLUMNS * CELL_FIELDS)
#if TEAM_WARPS > 1
#define TOGETHER (SLOT_STRIDE > 9 ? 1 : 2)
#else
#define TOGETHER (BLOCK_ITEMS < SLOT_STRIDE ? 1 : BLOCK_ITEMS / SLOT_STRIDE)
#endif
#define TOTALS (BATCH + 1) // pairs of which a strip's totals are kept, padded: a pair's totals are in different banks

// Computes the fields of a lane that follow from the others.
static inline void finish_row(float v, float *sums) {
#ifndef RAYS
  sums[SLOT_GV] = v * sums[SLOT_G];
  sums[SLOT_GUV] = v * sums[SLOT_GU];
  sums[SLOT_GVV] = v * sums[SLOT_GV];
#endif
}

// Leaves a lane's sums over one block.
static inline void leave_block(const float *sums, __local float *block_rows) {
  FOR_FIELDS(field) if (!OF_ROW(field)) block_rows[PLACE_IN_CELL(field) * ROW + LANE] = sums[field];
}

// Adds up what the lane's items have left for a pair that reaches these blocks, and leaves it in the first rows.
static inline void join_blocks(uint blocks, float v, __local float *pair_rows) {
  float sums[SLOT_STRIDE];
  FOR_FIELDS(field) sums[field] = 0.0f;
  _Pragma("unroll") for (int c = 0; c < BLOCK_COLUMNS; ++c) if (blocks >> c & 1) FOR_FIELDS(field) if (!OF_ROW(field))
      sums[field] += pair_rows[(c * CELL_FIELDS + PLACE_IN_CELL(field)) * ROW + LANE];
  finish_row(v, sums);
  FOR_FIELDS(field) pair_rows[field * ROW + LANE] = sums[field];
}

// Adds the gradients of a pixel to a pair's sums, without the fields that finish_row computes. Products are rounded
// before they are added, as items may leave them in local memory first. `begins`: the sums are those of this pixel
// alone.
static inline void add_pixel(float *sums, const Pixels *p, uint cell, float g, float weight, float u, float v,
                             float l11, float l12, float l22, int begins) {
  float own[SLOT_STRIDE];
  FOR_FIELDS(field) own[field] = 0.0f;
  own[SLOT_RED] = weight * p->red[cell];
  own[SLOT_GREEN] = weight * p->green[cell];
  own[SLOT_BLUE] = weight * p->blue[cell];
#ifdef RAYS
  add_ray_moments(g, u, v, l11, l12, l22, own);
#else
  own[SLOT_G] = g;
  own[SLOT_GU] = g * u;
  own[SLOT_GUU] = own[SLOT_GU] * u;
#ifdef ABSOLUTE_GRADIENTS
  own[SLOT_ABSX] = fabs(g * (l11 * u));
  own[SLOT_ABSY] = fabs(g * fma1(l12, u, l22 * v));
#endif
#endif
#ifdef CONTRIBUTIONS
  own[SLOT_WEIGHT] = weight;
#endif
#ifdef NEARNESS
  own[SLOT_NEAR] = weight * p->near[cell];
#endif
  FOR_FIELDS(field) if (!OF_ROW(field)) sums[field] = begins ? own[field] : sums[field] + own[field];
}

#define TAKE_PIXEL(cell, begins, where)                                                                                \
  {                                                                                                                    \
    ALPHA_IN(cell)                                                                                                     \
    if (where) {                                                                                                       \
      const float alpha = as_float(as_int(exp2_by(power, zero)) & taken);                                              \
      const Share share = take_out(&pixels, cell, alpha, c_red, c_green, c_blue NEAR_ARGUMENT);                        \
      add_pixel(sums, &pixels, cell, share.g, share.weight, u, v, W11, W12, W22, begins);                              \
    }                                                                                                                  \
  }

// Loads the Gaussian and the slot of an item's fetch number `fetch`. A batch's pairs run backwards from `batch` - 1.
#define FETCH_INDICES(fetch, batch)                                                                                    \
  {                                                                                                                    \
    const int from = max((batch) - 1 - ITEM - fetch * ITEMS, begin);                                                   \
    gaussian_of[fetch] = gaussian_from_sorted[from];                                                                   \
    slot_of[fetch] = slot_from_sorted[from];                                                                           \
  }

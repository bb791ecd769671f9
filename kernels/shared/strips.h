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

// Rows of a pair: one for each field. If several warps share the strip, the same memory first holds LEFT rows for each
// block.
#ifdef RAYS
#define LEFT 4 // g, weight, u and v
#else
#define LEFT 3 // g, weight and u
#endif
#define LEFT_ROWS(block) ((block) * (LEFT * ROW))
#define PAIR_ROWS (TEAM_WARPS == 1 || BLOCK_COLUMNS * LEFT < SLOT_STRIDE ? SLOT_STRIDE : BLOCK_COLUMNS * LEFT)
#if TEAM_WARPS > 1
#define TOGETHER (SLOT_STRIDE > 9 ? 1 : 2)
#else
#define TOGETHER (BLOCK_ITEMS < SLOT_STRIDE ? 1 : BLOCK_ITEMS / SLOT_STRIDE)
#endif
#define TOTALS (BATCH + 1) // pairs of which a strip's totals are kept, padded: a pair's totals are in different banks

// A lane's sums begin at -0. As x + -0 is x for every x, a compiler leaves the first addition out; x + 0 is not -0.
#define BEGIN_SUMS(sums) FOR_FIELDS(field) sums[field] = -0.0f;

// Computes the fields of a lane that follow from the others. With RAYS each pixel has its own v.
static inline void finish_row(float v, float *sums) {
#ifndef RAYS
  sums[SLOT_GV] = v * sums[SLOT_G];
  sums[SLOT_GUV] = v * sums[SLOT_GU];
  sums[SLOT_GVV] = v * sums[SLOT_GV];
#endif
}

#define SHARE_IN(cell)                                                                                                 \
  take_out(&pixels, cell, as_float(as_int(exp2_by(power, zero)) & taken), c_red, c_green, c_blue NEAR_ARGUMENT)

// Adds a pixel of a lane to its sums.
#define ADD_PIXEL(cell, where)                                                                                         \
  {                                                                                                                    \
    ALPHA_IN(cell)                                                                                                     \
    if (where) {                                                                                                       \
      const Share share = SHARE_IN(cell);                                                                              \
      add_gradients(sums, &pixels, cell, share.g, share.weight, u, v, W11, W12, W22);                                  \
    }                                                                                                                  \
  }

#if TEAM_WARPS > 1
// Leaves what another lane needs to add a pixel to its sums.
#define LEAVE_PIXEL(cell, block_rows)                                                                                  \
  {                                                                                                                    \
    ALPHA_IN(cell)                                                                                                     \
    Share share = {0.0f, 0.0f};                                                                                        \
    if (taken) share = SHARE_IN(cell);                                                                                 \
    leave_pixel(share, u, v, block_rows);                                                                              \
  }
static inline void leave_pixel(Share share, float u, float v, __local float *block_rows) {
  block_rows[LANE] = share.g;
  block_rows[ROW + LANE] = share.weight;
  block_rows[2 * ROW + LANE] = u;
#ifdef RAYS
  block_rows[3 * ROW + LANE] = v;
#endif
}

// Adds up what lanes have left for a pair that reaches these blocks, and leaves the sums in the pair's first rows.
// strip: the image's gradient in the lane's pixel of each block.
static inline void join_blocks(uint blocks, const Pixels *strip, float v, float l11, float l12, float l22,
                               __local float *pair_rows) {
  float sums[SLOT_STRIDE];
  BEGIN_SUMS(sums)
  _Pragma("unroll") for (int c = 0; c < BLOCK_COLUMNS; ++c) if (blocks >> c & 1) {
    __local const float *left = pair_rows + LEFT_ROWS(c) + LANE;
#ifdef RAYS
    v = left[3 * ROW];
#endif
    add_gradients(sums, strip + c, 0, left[0], left[ROW], left[2 * ROW], v, l11, l12, l22);
  }
  finish_row(v, sums);
  FOR_FIELDS(field) pair_rows[field * ROW + LANE] = sums[field];
}

// Loads the image's gradient in the lane's pixel of each block of a strip; first_pixel: that of the first block.
static inline void load_strip(__global const float *image_gradient, __global const int *stops, size_t first_pixel,
                              size_t plane, Pixels *strip) {
  _Pragma("unroll") for (int c = 0; c < BLOCK_COLUMNS; ++c) {
    const size_t pixel = first_pixel + c * BLOCK_W;
    const int inside = stops[pixel] >= 0; // in padding, which lanes add too, the gradient is not written
    strip[c].red[0] = inside ? image_gradient[pixel] : 0.0f;
    strip[c].green[0] = inside ? image_gradient[plane + pixel] : 0.0f;
    strip[c].blue[0] = inside ? image_gradient[2 * plane + pixel] : 0.0f;
#ifdef NEARNESS
    strip[c].near[0] = inside ? image_gradient[NEAR_PLANE * plane + pixel] : 0.0f;
#endif
  }
}
#endif

// Loads the Gaussian and the slot of an item's fetch number `fetch`. A batch's pairs run backwards from `batch` - 1.
#define FETCH_INDICES(fetch, batch)                                                                                    \
  {                                                                                                                    \
    const int from = max((batch) - 1 - ITEM - fetch * ITEMS, begin);                                                   \
    gaussian_of[fetch] = gaussian_from_sorted[from];                                                                   \
    slot_of[fetch] = slot_from_sorted[from];                                                                           \
  }

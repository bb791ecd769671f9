// Sums over a tile's pixels for blend_grad.cl, in a group of several work-items. From 32 items on, the order of
// addition does not depend on the number of items. A strip is a row of blocks (blocks.h); with 32 items or more it is
// half of the tile. Each of the 32 lanes of a strip adds its pixels from left to right, then multiplies by the whitened
// coordinate v, which is the same for all of them. A tree then adds the lanes, and the strips are added from top to
// bottom.
//
// A team of items owns one strip, or several strips one after the other, and processes TOGETHER of the strip's pairs at
// a time. The items of the team leave their sums in rows of local memory, one row for each field. Then each item adds
// up a row.
#define STRIP_CELLS (OWNED < BLOCK_COLUMNS ? OWNED : BLOCK_COLUMNS) // number of an item's cells in a strip
#define OWN_STRIPS (OWNED / STRIP_CELLS)
#define TEAMS (BLOCK_ROWS / OWN_STRIPS)
#define TEAM_WARPS (WARPS / TEAMS)
#define TEAM_ITEM (ITEM % (ITEMS / TEAMS))
#define TEAM (ITEM / (ITEMS / TEAMS))
#define TEAM_WARP (WARP % TEAM_WARPS)

#define ADDENDS BLOCK_ITEMS
#define ADDEND LANE
#if TEAM_WARPS > 1 // items of several warps add up a strip's lanes through local memory
#undef SUBGROUP
#undef SUBGROUPED
#define SUBGROUP 1
#define SUBGROUPED
#endif
#include "shared/item_sums.h"
// True if a sub-group has items of two teams, which own different strips. The teams then run the same number of
// iterations.
#define ACROSS_TEAMS (SUBGROUP > BLOCK_ITEMS)
#define ABREAST (ITEMS < SLOT_STRIDE ? ITEMS : SLOT_STRIDE) // number of items that write a slot together

// True if a pair reaches all blocks of a strip. It is then quicker to process all of the item's pixels without a
// branch.
#define IS_WHOLE(reach) (!ALL_REACHED && ((reach) & FIRST_BLOCKS(BLOCK_COLUMNS)) == FIRST_BLOCKS(BLOCK_COLUMNS))

#define FOR_FIELDS(field) _Pragma("unroll") for (int field = 0; field < SLOT_STRIDE; ++field)
#define FOR_STRIP(c) _Pragma("unroll") for (int c = 0; c < STRIP_CELLS; ++c)

// Rows of a pair in local memory: one for each field of its slot. If several warps share the strip, the same memory
// first holds LEFT rows for each block: the values of the block's pixels, which are not added up yet.
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
// Number of pairs for which `totals` has space, plus 1 so that the totals of a pair are in different banks.
#define TOTALS (BATCH + 1)

// Starts a lane's sums at -0. Because x + -0 is x for every x, a compiler can leave the first addition out. With a
// start of 0 it could not, because -0 + 0 is 0.
#define BEGIN_SUMS(sums) FOR_FIELDS(field) sums[field] = -0.0f;

// Computes those fields of a lane's sums that equal v times other fields, so that they are not added pixel by pixel.
// With RAYS the fields stay as add_gradients added them, because each pixel has its own v.
static inline void finish_row(float v, float *sums) {
#ifndef RAYS
  sums[SLOT_GV] = v * sums[SLOT_G];
  sums[SLOT_GUV] = v * sums[SLOT_GU];
  sums[SLOT_GVV] = v * sums[SLOT_GV];
#endif
}

#define SHARE_IN(cell)                                                                                                 \
  take_out(&pixels, cell, as_float(as_int(exp2_by(power, zero)) & taken), c_red, c_green, c_blue NEAR_ARGUMENT)

// Adds a pixel to the lane's sums, if `where` is true.
#define ADD_PIXEL(cell, where)                                                                                         \
  {                                                                                                                    \
    ALPHA_IN(cell)                                                                                                     \
    if (where) {                                                                                                       \
      const Share share = SHARE_IN(cell);                                                                              \
      add_gradients(sums, &pixels, cell, share.g, share.weight, u, v, W11, W12, W22);                                  \
    }                                                                                                                  \
  }

#if TEAM_WARPS > 1
// Stores a pixel's g, weight and whitened coordinates in local memory, from which a lane adds up several pixels.
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

// Adds up a pair's gradients in the lane's pixel of each block, from the values that LEAVE_PIXEL has stored. The sums
// overwrite these values in local memory: each of the pair's first SLOT_STRIDE rows gets one field. blocks: the set of
// blocks that the pair reaches; strip: the image's gradient in the lane's pixel of each block.
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

// Loads the image's gradient in the lane's pixel of each block of a strip; first_pixel: the index of the lane's pixel
// in the first block.
static inline void load_strip(__global const float *image_gradient, __global const int *stops, size_t first_pixel,
                              size_t plane, Pixels *strip) {
  _Pragma("unroll") for (int c = 0; c < BLOCK_COLUMNS; ++c) {
    const size_t pixel = first_pixel + c * BLOCK_W;
    const int inside = stops[pixel] >= 0; // lanes add padding too, and its gradient is uninitialised
    strip[c].red[0] = inside ? image_gradient[pixel] : 0.0f;
    strip[c].green[0] = inside ? image_gradient[plane + pixel] : 0.0f;
    strip[c].blue[0] = inside ? image_gradient[2 * plane + pixel] : 0.0f;
#ifdef NEARNESS
    strip[c].near[0] = inside ? image_gradient[NEAR_PLANE * plane + pixel] : 0.0f;
#endif
  }
}
#endif

// Loads the Gaussian's index and the slot of a pair of a batch. Each item fetches several pairs; `fetch` counts them.
// The pairs of a batch run backwards from index `batch` - 1.
#define FETCH_INDICES(fetch, batch)                                                                                    \
  {                                                                                                                    \
    const int from = max((batch) - 1 - ITEM - fetch * ITEMS, begin);                                                   \
    gaussian_of[fetch] = gaussian_from_sorted[from];                                                                   \
    slot_of[fetch] = slot_from_sorted[from];                                                                           \
  }

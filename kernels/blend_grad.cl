// The gradient of alpha blending, back to front: sums over a tile's pixels, for each pair of a tile and a Gaussian.
//
// Owner: A group owns a tile, with PART_PAIRS a part of the tile's list. It writes a slot for each pair, and no two
//   pairs share a slot. An item owns pixels; with BY_GAUSSIAN it owns one Gaussian after another.
// Launch: As in blend.cl; with PART_PAIRS, groups for the states (shared/parts.h) come before those for the tiles.
// Buffers: blend.cl's inputs and outputs (image, nearness and states only with PART_PAIRS); slot_from_sorted (pairs).
//   image_gradient (3, height, width): the loss's gradient with respect to colour. ALPHA_GRADIENT adds a fourth plane,
//     with respect to the final transmittance. NEARNESS adds a last plane, with respect to nearness.
//   -> slots (pairs, SLOT_STRIDE): sums over the tile's pixels, in the whitened units of (49); every slot is written.
// Equations: docs/gradients.md, (14), (22) to (26), (48), (49), (55) and (122); with RAYS docs/cameras.md, (21).
//
// Each pixel visits its Gaussians from the last to the first, and recovers the transmittance by division. `behind` is
// the light behind the current Gaussian, background included, dotted with the pixel's gradient (shared/behind.h). The
// sums are moments of g = alpha * dL/dalpha in whitened (u, v), and with CONTRIBUTIONS of the blending weights (55).
#include "shared/widened.h"
#include "shared/math.h"
#include "shared/splat.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/subgroup.h"
#include "shared/tile.h"
#if ITEMS > 1 // larger batches would take more local memory
#define BATCH 64
#endif
#include "shared/cells.h"
#include "shared/alpha.h"
#include "shared/prefetch.h"
#include "shared/parts.h"

#ifdef CONTRIBUTIONS // contributions are summed over all cells, also over cells without a gradient
#define LIVE(cells, live) (cells)
#else
#define LIVE(cells, live) ((cells) & (live))
#endif
#ifdef RECORD_CELLS // blend.cl recorded the cells in which some pixel takes the Gaussian, and only these are visited
#define CONTRIBUTES(mask) 1
#define REACHED_AT_FIRST recorded
#define ADD_REACHED(mask, cell)
#else
#define CONTRIBUTES(mask) ANYL(mask)
#define REACHED_AT_FIRST 0
#define ADD_REACHED(mask, cell) reached |= RECORDED(mask) << FIRST_RECORDED(cell);
#endif

// A work-item's pixels, by cell. t, behind: the transmittance and the light behind the current pair; near: the gradient
// with respect to nearness; stop: the pixel's entry of `stops`; red, green, blue: the image's gradient.
typedef struct {
  floatL t[OWNED], behind[OWNED], red[OWNED], green[OWNED], blue[OWNED];
  intL stop[OWNED];
#ifdef NEARNESS
  floatL near[OWNED];
#endif
} Pixels;

// A pair's g = alpha * dL/dalpha and its blending weight in a cell's pixels.
typedef struct {
  floatL g, weight;
} Share;

#include "shared/behind.h"

// Undoes the blending of a pair in a cell. uncapped: the pair's alpha before the cap, 0 in pixels without the pair.
static inline Share take_out(Pixels *p, uint cell, floatL uncapped, float c_red, float c_green,
                             float c_blue NEAR_PARAMETER) {
#if ITEMS == 1
  const floatL alpha = uncapped < ALPHA_MAX ? uncapped : (floatL)(ALPHA_MAX);
  const floatL inverse = 1.0f / (1.0f - alpha);
  const floatL before = p->t[cell] * inverse;
  const floatL colour =
      fmaL(p->red[cell], (floatL)(c_red), fmaL(p->green[cell], (floatL)(c_green), p->blue[cell] * c_blue));
#ifdef NEARNESS
  const floatL shade = fmaL(p->near[cell], (floatL)(c_near), colour);
#else
  const floatL shade = colour;
#endif
  const floatL weight = alpha * before;
  const floatL d_alpha = fmaL(before, shade, -(p->behind[cell] * inverse));
  const floatL g = AS_FLOATL(AS_INTL(alpha * d_alpha) & MASKL(uncapped < ALPHA_MAX));
  p->behind[cell] = fmaL(weight, shade, p->behind[cell]);
  p->t[cell] = before;
  const Share share = {g, weight};
  return share;
#else
  float difference = -p->behind[cell];
#ifdef NEARNESS
  difference = fma1(p->near[cell], c_near, difference);
#endif
  difference = fma1(p->green[cell], c_green, fma1(p->blue[cell], c_blue, difference));
  difference = fma1(p->red[cell], c_red, difference);
  return take_out_of(p->t + cell, p->behind + cell, uncapped, difference);
#endif
}

#include "shared/pair_sums.h"

// AT_END: the gradient with respect to the final transmittance, the background's part plus by_t, the fourth plane.
#ifdef ALPHA_GRADIENT
#define AT_END(background) ((background) + by_t)
#define NEAR_PLANE 4
#else
#define AT_END(background) (background)
#define NEAR_PLANE 3
#endif

#if ITEMS > 1 && !defined(BY_GAUSSIAN)
#include "shared/strips.h"
#endif

// ALPHA_IN defines for pair i and a cell: (u, v); power: log2 of alpha; taken: the pixels to which the pair was added.
#ifdef RAYS
#define WHITENING_HERE                                                                                                 \
  float whitening[3];                                                                                                  \
  whitening_of_ray(splat, whitening, whitening + 1, whitening + 2);
#define W11 whitening[0]
#define W12 whitening[1]
#define W22 whitening[2]
#define ALPHA_IN(cell)                                                                                                 \
  floatL u, v;                                                                                                         \
  const floatL power = offset_of_ray(ray_x[cell], ray_y[cell], ray_z[cell], splat, &u, &v);                            \
  const intL taken = MASKL(power >= LOG2_ALPHA_MIN) & MASKL((intL)(i) < pixels.stop[cell]);                            \
  u = AS_FLOATL(AS_INTL(u) & taken); /* u and v are undefined for rays that point away from the mean */                \
  v = AS_FLOATL(AS_INTL(v) & taken);
#else
#define WHITENING_HERE
#define W11 l11
#define W12 l12
#define W22 l22
#define ALPHA_IN(cell)                                                                                                 \
  const floatL dy = my - AT_Y(cell);                                                                                   \
  const floatL u = whitened_u(l11, l12, mx - AT_X(cell), dy), v = l22 * dy;                                            \
  const floatL power = log2_alpha(u, v, log2o);                                                                        \
  const intL taken = MASKL(power >= LOG2_ALPHA_MIN) & MASKL((intL)(i) < pixels.stop[cell]);
#endif

// Processes a pair in the cells that it reaches. With 8 lanes or more a work-item runs three short loops, not one, as
// short dependency chains and few registers keep more cells in flight (docs/performance.md).
#if LANES >= 8 && !defined(RAYS)
#define TAKE_PAIR(reach)                                                                                               \
  floatL alpha_of[CELLS], u_of[CELLS], g_of[CELLS], weight_of[CELLS];                                                  \
  uint reached = REACHED_AT_FIRST;                                                                                     \
  FOR_CELLS(cell, reach) {                                                                                             \
    ALPHA_IN(cell)                                                                                                     \
    alpha_of[cell] = AS_FLOATL(AS_INTL(exp2L(power)) & taken);                                                         \
    u_of[cell] = u;                                                                                                    \
    ADD_REACHED(taken, cell)                                                                                           \
  }                                                                                                                    \
  FOR_CELLS(cell, CELLS_OF(reached)) {                                                                                 \
    const Share share = take_out(&pixels, cell, alpha_of[cell], c_red, c_green, c_blue NEAR_ARGUMENT);                 \
    g_of[cell] = share.g;                                                                                              \
    weight_of[cell] = share.weight;                                                                                    \
  }                                                                                                                    \
  FOR_CELLS(each, reached) {                                                                                           \
    const uint place = PLACE_OF(each);                                                                                 \
    const floatS v = l22 * (my - IN_PLACE(table_y, place));                                                            \
    add_gradients(sums, &pixels, place, IN_PLACE(g_of, place), IN_PLACE(weight_of, place), IN_PLACE(u_of, place), v,   \
                  l11, l12, l22);                                                                                      \
  }
#else
#define TAKE_PAIR(reach)                                                                                               \
  WHITENING_HERE                                                                                                       \
  FOR_CELLS(cell, reach) {                                                                                             \
    ALPHA_IN(cell)                                                                                                     \
    if (CONTRIBUTES(taken)) {                                                                                          \
      const floatL alpha = AS_FLOATL(AS_INTL(exp2_by(power, zero)) & taken);                                           \
      const Share share = take_out(&pixels, cell, alpha, c_red, c_green, c_blue NEAR_ARGUMENT);                        \
      add_gradients(sums, &pixels, cell, share.g, share.weight, u, v, W11, W12, W22);                                  \
    }                                                                                                                  \
  }
#endif

#ifdef BY_GAUSSIAN
#include "shared/walk.h"
#endif

GROUP SUBGROUPED __kernel void blend_grad(const int first_tile, const int tiles_x, const int height,
                                          __global const uint *ranges, __global const uint *gaussian_from_sorted,
                                          __global const uint *slot_from_sorted, __global const float *splats,
                                          __global const float *background, __global const float *image_gradient,
                                          __global const float *transmittance, __global const int *stops,
                                          __global float *slots
#ifdef RECORD_CELLS
                                          ,
                                          __global const uint *cells_from_sorted
#endif
#ifdef PART_PAIRS
                                          ,
                                          const int most_states, ELEMENTS(pairs), __global const float *image,
                                          __global const float *states, __global const uint *tile_of_state
#ifdef NEARNESS
                                          ,
                                          __global const float *nearness
#endif
#endif
#ifdef RAYS
                                          ,
                                          __constant float *camera
#endif
                                              TILE_ORDER_PARAMETER) {
#ifdef PART_PAIRS
  FIND_ELEMENTS(pairs)
  PART_OF_GROUP
#else
  TILE_OF_GROUP
#endif
  int last = begin;
#ifdef BY_GAUSSIAN
  __local Passing passing[TILE * TILE];
  __local Fixed fixed[TILE * TILE];
#ifdef NEARNESS
  __local float near[TILE * TILE];
#endif
  for (int k = ITEM; k < TILE * TILE; k += ITEMS) {
    const int x = k % TILE, y = k / TILE;
    const size_t pixel = stride * (tile_y + y) + tile_x + x;
    const int stop = stops[pixel];
    float t = 0.0f;
    Fixed f = {0.0f, 0.0f, 0.0f, as_float(stop)};
    if (stop >= 0) { // in padding the gradient is uninitialised
      t = transmittance[pixel];
      f.x = image_gradient[pixel];
      f.y = image_gradient[plane + pixel];
      f.z = image_gradient[2 * plane + pixel];
    }
#ifdef ALPHA_GRADIENT
    const float by_t = stop >= 0 ? image_gradient[3 * plane + pixel] : 0.0f;
#endif
    passing[PLACE(x, y)] = (Passing)(t, AT_END(f.x * background[0] + f.y * background[1] + f.z * background[2]));
    fixed[PLACE(x, y)] = f;
#ifdef NEARNESS
    near[PLACE(x, y)] = stop >= 0 ? image_gradient[NEAR_PLANE * plane + pixel] : 0.0f;
#endif
    last = max(last, stop);
  }
#else
  PIXEL_TABLES
  RAY_TABLES
  Pixels pixels;
  uint live = 0; // recorded cells in which some pixel has a gradient
  ALL_CELLS(cell) {
    const size_t pixel = CELL_IN_PLANE(cell);
    const intL stop = LOAD_CELL(int, stops + pixel, stride);
    const intL inside = MASKL(stop >= 0); // in padding the gradient is uninitialised, and 0 * NaN is not 0
    const floatL t = LOAD_CELL(float, transmittance + pixel, stride);
    const floatL red = AS_FLOATL(LOAD_CELL(int, (__global const int *)image_gradient + pixel, stride) & inside);
    const floatL green =
        AS_FLOATL(LOAD_CELL(int, (__global const int *)image_gradient + plane + pixel, stride) & inside);
    const floatL blue =
        AS_FLOATL(LOAD_CELL(int, (__global const int *)image_gradient + 2 * plane + pixel, stride) & inside);
#ifdef ALPHA_GRADIENT
    const floatL by_t =
        AS_FLOATL(LOAD_CELL(int, (__global const int *)image_gradient + 3 * plane + pixel, stride) & inside);
#endif
    const floatL behind = BEHIND(t, AT_END(red * background[0] + green * background[1] + blue * background[2]));
    pixels.t[cell] = t;
    pixels.behind[cell] = behind;
#ifdef PART_PAIRS
    if (stop > end) { // the pixel goes on past the boundary at which the group begins
#ifdef ALPHA_GRADIENT
      float light = by_t * t;
#else
      float light = 0.0f;
#endif
#ifdef NEARNESS
      light =
          fma1(image_gradient[NEAR_PLANE * plane + pixel], nearness[pixel] - IN_STATE(state, STATE_NEAR, cell), light);
#endif
      light = fma1(blue, image[2 * plane + pixel] - IN_STATE(state, STATE_BLUE, cell), light);
      light = fma1(green, image[plane + pixel] - IN_STATE(state, STATE_GREEN, cell), light);
      light = fma1(red, image[pixel] - IN_STATE(state, STATE_RED, cell), light);
      pixels.t[cell] = IN_STATE(state, STATE_T, cell);
      pixels.behind[cell] = quotient(light, pixels.t[cell]);
    }
#endif
    pixels.red[cell] = red;
    pixels.green[cell] = green;
    pixels.blue[cell] = blue;
    pixels.stop[cell] = stop;
    last = max(last, maxL(stop));
    intL alive = (red != 0.0f) | (green != 0.0f) | (blue != 0.0f);
#ifdef ALPHA_GRADIENT
    alive |= by_t != 0.0f;
#endif
#ifdef NEARNESS
    pixels.near[cell] =
        AS_FLOATL(LOAD_CELL(int, (__global const int *)image_gradient + NEAR_PLANE * plane + pixel, stride) & inside);
    alive |= pixels.near[cell] != 0.0f;
#endif
#ifdef RECORD_CELLS
    live |= RECORDED(alive) << FIRST_RECORDED(cell);
#endif
  }
#endif
  RAISE_TO_GROUP_MAX(last)
#ifdef PART_PAIRS
  last = min(last, end);
#endif

  // Every pair from `last` on contributes to no pixel, and its slot becomes 0. There is no early exit, because Intel's
  // runtime reads memory for idle items too.
  for (int first = last; first < end; first += ITEMS) {
    const int i = first + (int)get_local_id(0);
    __global float *slot = slots + (size_t)SLOT_STRIDE * slot_from_sorted[min(i, end - 1)];
    if (i < end)
      for (int field = 0; field < SLOT_STRIDE; ++field) slot[field] = 0.0f;
  }

#if ITEMS == 1
  const int zero = 0;
  for (int i = last - 1; i >= begin; --i) {
    PREFETCH(splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i - AHEAD > begin ? i - AHEAD : begin]);
    PREFETCH(slots + (size_t)SLOT_STRIDE * slot_from_sorted[i - AHEAD > begin ? i - AHEAD : begin]);
    __global const float *splat = splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i];
    __global float *slot = slots + (size_t)SLOT_STRIDE * slot_from_sorted[i];
    SPLAT_HERE(splat)
    const float c_red = splat[SPLAT_RED], c_green = splat[SPLAT_GREEN], c_blue = splat[SPLAT_BLUE];
    NEAR_HERE(1.0f / splat[SPLAT_DEPTH])
#ifdef RECORD_CELLS
    const uint recorded = LIVE(cells_from_sorted[i], live), reach = CELLS_OF(recorded);
    if (recorded == 0) {
      for (int field = 0; field < SLOT_STRIDE; ++field) slot[field] = 0.0f;
      continue;
    }
#else
    const Reach reach = reach_of(splat, tile_x, tile_y);
#endif
    floatS sums[SLOT_STRIDE] = {(floatS)(0.0f)};
    TAKE_PAIR(reach)
#if LANES >= 8
    typedef float8 float8U __attribute__((aligned(4)));
    *(__global float8U *)slot = sums8(sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7]);
#else
    for (int field = 0; field < 8; ++field) slot[field] = sumS(sums[field]);
#endif
    slot[SLOT_BLUE] = sumS(sums[SLOT_BLUE]);
#ifdef ABSOLUTE_GRADIENTS
    slot[SLOT_ABSX] = sumS(sums[SLOT_ABSX]);
    slot[SLOT_ABSY] = sumS(sums[SLOT_ABSY]);
#endif
#ifdef CONTRIBUTIONS
    slot[SLOT_WEIGHT] = sumS(sums[SLOT_WEIGHT]);
#endif
#ifdef NEARNESS
    slot[SLOT_NEAR] = sumS(sums[SLOT_NEAR]);
#endif
  }
#elif defined(BY_GAUSSIAN)
  __local Staged staged[ITEMS]; // each item uses only the entry that it stages itself
  float sums[SLOT_STRIDE];
  for (int field = 0; field < SLOT_STRIDE; ++field) sums[field] = 0.0f;
  Walker walker = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, begin - 1, 0, 0};
  // In the last iteration, the items only finish the pairs that they have begun.
  for (int turn = last; turn > (last > begin ? begin - ITEMS : begin); turn -= ITEMS) {
    const int next = max(turn - 1 - ITEM, begin);
    stage(staged + ITEM, gaussian_from_sorted[next], next, slot_from_sorted[next], ALL_BLOCKS, splats, tile_x, tile_y);
    for (int round = 0; round < ITEMS; ++round) {
      if (round == ITEM) {
        if (walker.i >= begin) {
          __global float *slot = slots + (size_t)SLOT_STRIDE * walker.slot;
          for (int field = 0; field < SLOT_STRIDE; ++field) slot[field] = sums[field];
        }
        const Staged s = staged[ITEM];
        const int i = turn - 1 - ITEM;
        const Walker w = {s.mx,
                          s.my,
                          s.l11,
                          s.l12,
                          s.l22,
                          s.log2o,
                          s.red,
                          s.green,
                          s.blue,
                          i,
                          i >= begin ? s.blocks : 0,
                          s.slot NEAR_OF_STAGED};
        walker = w;
        for (int field = 0; field < SLOT_STRIDE; ++field) sums[field] = 0.0f;
      }
      const int chunk = (round - ITEM) & (ITEMS - 1);
      if (walker.blocks >> CHUNK_BLOCK(chunk) & FIRST_BLOCKS(CHUNK_BLOCKS))
        take_chunk(&walker, chunk, passing, fixed, sums NEAR_PIXELS);
      BARRIER_LOCAL();
    }
  }
#else
  const int zero = min(pixels.stop[0] + 1, 0); // always 0, but unknown to the compiler: see exp2_by
  __local Staged staged[BATCH];
  __local uint marks[BLOCK_ROWS * BATCH / 4] __attribute__((aligned(16)));
  __local uchar lists[BLOCK_ROWS * LIST];
  __local int counts[BLOCK_ROWS]; // number of pairs listed for each strip
  __local int lasts[BLOCKS];      // the largest entry of `stops` in each block
  __local float rows[TEAMS * TOGETHER * PAIR_ROWS * ROW] __attribute__((aligned(16)));
  __local float totals[BLOCK_ROWS * SLOT_STRIDE * TOTALS]; // sums of each strip, by field and pair
#if TEAM_WARPS > 1
  Pixels strip_pixels[BLOCK_COLUMNS];
  load_strip(image_gradient, stops, stride * (tile_y + TEAM * BLOCK_H + LANE / BLOCK_W) + tile_x + LANE % BLOCK_W,
             plane, strip_pixels);
#endif
  for (int block = ITEM; block < BLOCKS; block += ITEMS) lasts[block] = begin;
  BARRIER_LOCAL();
  ALL_CELLS(cell) atomic_max(lasts + OWN_BLOCK(cell), pixels.stop[cell]);
  BARRIER_LOCAL();
  // The indices for the next batch are loaded early, so that the loads of its splats need not wait for them.
  uint gaussian_of[FETCHES], slot_of[FETCHES];
  if (last > begin) {
    FOR_FETCHES(fetch) { FETCH_INDICES(fetch, last) }
  }
  for (int batch = last; batch > begin; batch -= BATCH) {
    const int count = min(BATCH, batch - begin); // number of pairs in this batch, which ends before index `batch`
    FOR_FETCHES(fetch) {
      const int j = ITEM + fetch * ITEMS;
      if (j < BATCH) {
        const uint above = blocks_above(max(batch - 1 - j, begin), lasts), live = j < count ? above : 0;
        const uint gaussian = gaussian_of[fetch], slot = slot_of[fetch];
        FETCH_INDICES(fetch, batch - BATCH)
        const uint blocks =
            stage(staged + j, gaussian, KEPT(gaussian, batch - 1 - j), slot, live, splats, tile_x, tile_y);
        mark(marks, j, blocks, BLOCK_ROWS, BLOCK_COLUMNS);
      }
    }
    BARRIER_LOCAL();
    UNROLLED for (int k = 0; k < OWN_STRIPS; ++k) {
      const int strip = TEAM * OWN_STRIPS + k;
      __local uchar *list = lists + strip * LIST;
      if (TEAM_WARP == 0) {
#define ENTRY(j) (uchar)(j)
        LIST_MARKED(listed, marks + strip * BATCH / 4, list, ENTRY)
        if (LANE == 0) counts[strip] = listed;
        if (LANE < 2) list[listed + LANE] = 0; // read ahead, but not used
      }
      BARRIER_LOCAL();
      int j = list[0], next = list[1]; // the current and the next pair, loaded before their use
      Staged s = staged[j];
      const int own = counts[strip], most = max(counts[k], counts[(TEAMS - 1) * OWN_STRIPS + k]);
      for (int first = 0; first < most; first += TOGETHER) { // both teams run the same number of iterations
        const int stop_at = min(first + TOGETHER, ACROSS_TEAMS ? most : own);
        __local float *pair_rows = rows + TEAM * (TOGETHER * PAIR_ROWS * ROW);
        for (int turn = first; turn < stop_at; ++turn, pair_rows += PAIR_ROWS * ROW) {
          const int absent = ACROSS_TEAMS && turn >= own, i = KEPT(batch - 1 - j, (int)s.kept);
          SPLAT_STAGED(s)
          NEAR_HERE(s.near)
          const uint reach = absent ? 0 : FROM_OWN(s.blocks) >> k * BLOCK_COLUMNS;
          WHITENING_HERE
#if TEAM_WARPS == 1
          float sums[SLOT_STRIDE];
          BEGIN_SUMS(sums)
          // `taken` is not tested here, nor in cell 0 below: alpha is 0 in pixels to which the pair was not added.
          if (IS_WHOLE(reach)) {
            FOR_STRIP(c) ADD_PIXEL(k * BLOCK_COLUMNS + c, 1);
          } else {
            FOR_STRIP(c) if (reach >> c & 1) ADD_PIXEL(k * BLOCK_COLUMNS + c, c == 0 || taken);
          }
          const float v = l22 * (my - AT_Y(k * BLOCK_COLUMNS));
          j = next;
          s = staged[j];
          next = list[ACROSS_TEAMS ? min(turn + 2, own) : turn + 2];
          finish_row(v, sums);
          leave_sums(sums, pair_rows);
#else
          FOR_STRIP(c) if (reach >> c & 1) LEAVE_PIXEL(c, pair_rows + LEFT_ROWS(TEAM_WARP * STRIP_CELLS + c));
          j = next;
          s = staged[j];
          next = list[ACROSS_TEAMS ? min(turn + 2, own) : turn + 2];
#endif
        }
#if TEAM_WARPS > 1
        BARRIER_LOCAL();
        for (int turn = first + TEAM_WARP; turn < stop_at; turn += TEAM_WARPS) {
          const Staged s = staged[list[turn]];
          SPLAT_STAGED(s)
          WHITENING_HERE
          join_blocks(s.blocks >> strip * BLOCK_COLUMNS, strip_pixels, l22 * (my - AT_Y(0)), W11, W12, W22,
                      rows + (TEAM * TOGETHER + turn - first) * (PAIR_ROWS * ROW));
        }
#endif
        BARRIER_LOCAL();
        for (int row = TEAM_ITEM; row < TOGETHER * SLOT_STRIDE; row += ITEMS / TEAMS) {
          const int turn = row / SLOT_STRIDE, field = row % SLOT_STRIDE;
          if (first + turn < own)
            totals[(strip * SLOT_STRIDE + field) * TOTALS + list[first + turn]] =
                row_sum(rows + ((TEAM * TOGETHER + turn) * PAIR_ROWS + field) * ROW);
        }
        BARRIER_LOCAL();
      }
    }
    if (ITEM < ITEMS / ABREAST * ABREAST) {
      ROLLED for (int j = ITEM / ABREAST; j < count; j += ITEMS / ABREAST) {
        for (int field = ITEM % ABREAST; field < SLOT_STRIDE; field += ABREAST) {
          float sum = 0.0f;
          for (int strip = 0; strip < BLOCK_ROWS; ++strip)
            if (staged[j].blocks >> strip * BLOCK_COLUMNS & FIRST_BLOCKS(BLOCK_COLUMNS))
              sum += totals[(strip * SLOT_STRIDE + field) * TOTALS + j];
          slots[SLOT_STRIDE * (size_t)staged[j].slot + field] = sum;
        }
      }
    }
    BARRIER_LOCAL();
  }
#endif
}

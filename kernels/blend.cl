// Front-to-back alpha blending of each tile's list of Gaussians into an image, until a pixel's transmittance is used
// up (TRANSMITTANCE_MIN in shared/math.h).
//
// Owner: A group owns a tile. On a CPU (ITEMS == 1) a work-item loops over the tile's Gaussians; for each it loops over
//   the cells of open pixels that the ellipse reaches. On a GPU (LANES == 1) each work-item owns pixels. The group
//   fetches Gaussians in batches, as in Kerbl et al., and each warp loops over the Gaussians that reach its blocks. CPU
//   and GPU give the same bits.
// Launch: One group of ITEMS work-items for each tile of a band or of the whole image, in row-major order from
//   first_tile on.
// Buffers: ranges (tiles, 2), gaussian_from_sorted (pairs), splats (n, SPLAT_SIZE) in pixels, background (3); with RAYS
//     camera.
//   -> image (3, height, width): colour. transmittance (height, width): after all Gaussians, 0 to 1.
//   stops (height, width): the sorted index of the first pair that is not added to the pixel; -1 in padding.
//   nearness (height, width), with NEARNESS: the sum of weight / depth; 0 in padding.
//   For blend_grad.cl: with RECORD_CELLS cells_from_sorted (pairs), bits of the cells to which the Gaussian
//     contributes; with PART_PAIRS states, tile_of_state (shared/parts.h).
//   Planes are padded with black to whole tiles.
// Equations: docs/gradients.md, (14) to (16), (45) and (120); with RAYS docs/cameras.md, (14); Kerbl et al. 2023,
//   section 6 and algorithm 2.
#include "shared/widened.h"
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/tile.h"
#include "shared/cells.h"
#include "shared/alpha.h"
#include "shared/prefetch.h"
#include "shared/parts.h"

#ifdef NO_EARLY_STOP // RasterizerConfig.early_stop is off: continue past opaque pixels, with the same result
#define GOES_ON(open) 1
#else
#define GOES_ON(open) ((open) != 0)
#endif
#ifdef RECORD_CELLS
#define RECORD(statements) statements
#else
#define RECORD(statements)
#endif
// Nonzero if a vector of pixels should be blended. `mask`: the lanes that the Gaussian reaches. With CELLS_BY_ELLIPSE,
// reach_of already skips most vectors that the Gaussian does not reach, and a test of the mask would cost more than it
// saves.
#if defined(RECORD_CELLS) && VECTORS > 1 // a cell of two vectors stays open while one of them is open
#define CONTRIBUTES(mask) RECORDED((mask) & MASKL(pixels[cell].t > 0.0f))
#elif defined(RECORD_CELLS)
#define CONTRIBUTES(mask) RECORDED(mask)
#elif defined(CELLS_BY_ELLIPSE)
#define CONTRIBUTES(mask) 1
#else
#define CONTRIBUTES(mask) ANYL(mask)
#endif
#ifdef COUNT_PAIRS // set in a build for `clsplat bench`
#define COUNT(statements) statements
#else
#define COUNT(statements)
#endif

// Colour sums and transmittance of a cell's pixels. While a pixel is open, `t` is its transmittance. In a finished
// pixel, `t` makes all further weights 0 without an extra test. On a CPU `t` is then 0, and `kept`, which is rarely
// written, holds the final transmittance. On a GPU `t` is then minus the final transmittance, to save instructions: it
// fails the test against TRANSMITTANCE_MIN.
typedef struct {
  floatL t;
#if ITEMS == 1
  floatL kept;
#endif
  floatL red, green, blue;
  intL stop;
#ifdef NEARNESS
  floatL near;
#endif
} Pixels;
#if ITEMS == 1
#define T_AT_FIRST(inside) (inside) ? one : zero, one
#define T_AT_END(p) ((p).t > 0.0f ? (p).t : (p).kept)
#else
#define T_AT_FIRST(inside) (inside) ? one : -one
#define T_AT_END(p) fabs((p).t)
#endif

// Adds the tile's i-th pair to a cell. On a CPU, returns true if the pair finishes the cell's last open pixel. power:
// log2 of the uncapped alpha; zero: an operand of exp2_by (lanes.h).
static inline int add_gaussian(Pixels *p, floatL power, int i, int zero, float c_red, float c_green,
                               float c_blue NEAR_PARAMETER) {
  const floatL before = p->t;
  floatL alpha = exp2_by(power, zero);
  alpha = alpha < ALPHA_MAX ? alpha : (floatL)(ALPHA_MAX);
  alpha = power >= LOG2_ALPHA_MIN ? alpha : (floatL)(0.0f);
  const floatL after = fmaL(-before, alpha, before);
  const intL goes_on = MASKL(after > TRANSMITTANCE_MIN);
  const floatL weight = AS_FLOATL(AS_INTL(before * alpha) & goes_on);
  p->red = fmaL(weight, (floatL)(c_red), p->red);
  p->green = fmaL(weight, (floatL)(c_green), p->green);
  p->blue = fmaL(weight, (floatL)(c_blue), p->blue);
#ifdef NEARNESS
  p->near = fmaL(weight, (floatL)(c_near), p->near);
#endif
#if ITEMS == 1
  p->t = AS_FLOATL(AS_INTL(after) & goes_on);
  const intL ended = AS_INTL(before) & ~goes_on; // nonzero where the pixel is finished by this pair
  if (!ANYL(ended)) return 0;
  p->kept = ended != 0 ? before : p->kept;
  p->stop = ended != 0 ? (intL)(i) : p->stop;
  return !ANYL(p->t > 0.0f);
#else
  p->t = goes_on ? after : -fabs(before);
  p->stop = goes_on ? p->stop : min(p->stop, i); // pairs come in order, so min keeps the first
  return 0;
#endif
}

GROUP __kernel void blend(const int first_tile, const int tiles_x, const int width, const int height,
                          __global const uint *ranges, __global const uint *gaussian_from_sorted,
                          __global const float *splats, __global const float *background, __global float *image,
                          __global float *transmittance, __global int *stops
#ifdef NEARNESS
                          ,
                          __global float *nearness
#endif
#ifdef RECORD_CELLS
                          ,
                          __global uint *cells_from_sorted
#endif
#ifdef PART_PAIRS
                          ,
                          __global float *states, __global uint *tile_of_state
#endif
#ifdef RAYS
                          ,
                          __constant float *camera
#endif
#ifdef COUNT_PAIRS
                          ,
                          __global uint *counts // (items, 2): pairs that contribute, pairs evaluated
#endif
                              TILE_ORDER_PARAMETER) {
  TILE_OF_GROUP
  PIXEL_TABLES
  RAY_TABLES
  Pixels pixels[OWNED];
  COUNT(intL added = (intL)(0); uint evaluated = 0;)

  Open open = 0;
  ALL_CELLS(cell) {
    const floatL x = (floatL)(tile_x) + PIXELS_X(cell), y = (floatL)(tile_y) + PIXELS_Y(cell);
    const intL inside = MASKL(x < (floatL)(width)) & MASKL(y < (floatL)(height));
    const floatL zero = (floatL)(0.0f), one = (floatL)(1.0f);
    const Pixels p = {T_AT_FIRST(inside), zero, zero, zero, inside ? (intL)(end) : (intL)(-1)};
    pixels[cell] = p;
#ifdef NEARNESS
    pixels[cell].near = zero;
#endif
    if (ANYL(inside)) OPEN_CELL(open, cell);
  }

#if ITEMS == 1
  int i = begin;
  // The cells that two Gaussians reach are computed together, before both are blended. So no load of a splat waits for
  // the blending of earlier cells.
  Reach reach, second;
  for (; i < end && GOES_ON(open); ++i) {
    const int turn = (i - begin) & 1;
    if (!turn) {
      reach = reach_of(splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i], tile_x, tile_y);
      second = reach_of(splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[min(i + 1, end - 1)], tile_x, tile_y);
    } else reach = second;
    PREFETCH(splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i + AHEAD < end ? i + AHEAD : end - 1]);
    __global const float *splat = splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i];
    SPLAT_HERE(splat)
    const float c_red = splat[SPLAT_RED], c_green = splat[SPLAT_GREEN], c_blue = splat[SPLAT_BLUE];
    NEAR_HERE(1.0f / splat[SPLAT_DEPTH])
    RECORD(uint cells = 0;)
    FOR_CELLS(cell, IN_OPEN(reach, open)) {
      const floatL power = LOG2_ALPHA(splat, cell);
      COUNT(evaluated += LANES;)
      const intL reached = MASKL(power >= LOG2_ALPHA_MIN);
      const uint contributes = CONTRIBUTES(reached);
      if (contributes) {
        RECORD(cells |= contributes << FIRST_RECORDED(cell);)
        if (add_gaussian(pixels + cell, power, i, 0, c_red, c_green, c_blue NEAR_ARGUMENT)) CLOSE_CELL(open, cell);
        COUNT(added -= reached & MASKL(pixels[cell].t > 0.0f);)
      }
    }
    RECORD(cells_from_sorted[i] = cells;)
  }
  RECORD(for (; i < end; ++i) cells_from_sorted[i] = 0;)
#else
#if OWNED == 1 // the loop over pairs is short and has no branches
#define OF_PAIRS _Pragma("unroll 4")
#else
#define OF_PAIRS ROLLED
#endif
#define BLEND(cell, power)                                                                                             \
  add_gaussian(pixels + cell, power, i, zero, c_red, c_green, c_blue NEAR_ARGUMENT);                                   \
  COUNT(added += power >= LOG2_ALPHA_MIN && pixels[cell].t > 0.0f;)
#define FETCH_INDEX(fetch, batch)                                                                                      \
  gaussian_of[fetch] = gaussian_from_sorted[min((batch) + ITEM + fetch * ITEMS, end - 1)];
  __local Staged staged[BATCH];
  __local uint marks[WARPS * BATCH / 4] __attribute__((aligned(16))), lists[WARPS * LIST];
  __local int open_in[BLOCKS]; // number of open pixels in each block
  __local uint *list = lists + WARP * LIST;
  const int zero = min(pixels[0].stop + 1, 0); // always 0, but unknown to the compiler: see exp2_by
  for (int block = ITEM; block < BLOCKS; block += ITEMS) open_in[block] = 0;
#ifdef PART_PAIRS
  for (int state = FIRST_STATE(begin) + ITEM; state < FIRST_STATE(end); state += ITEMS)
    tile_of_state[state] = listed_tile;
#endif
  BARRIER_LOCAL();
  // The indices for the next batch are loaded early, so that the loads of its splats need not wait for them.
  uint gaussian_of[FETCHES];
  if (begin < end) {
    FOR_FETCHES(fetch) { FETCH_INDEX(fetch, begin) }
  }
  // For each batch: count open pixels, fetch splats, list the pairs of each warp, then blend without barriers.
  for (int batch = begin; batch < end; batch += BATCH) {
    ALL_CELLS(cell) if (GOES_ON(pixels[cell].t > 0.0f)) atomic_inc(open_in + OWN_BLOCK(cell));
    BARRIER_LOCAL();

    const uint live = blocks_above(0, open_in);
    if (live == 0) break;
#ifdef PART_PAIRS
    if (batch > begin && (batch - begin) % PART_PAIRS == 0) {
      const int state = FIRST_STATE(begin) + (batch - begin) / PART_PAIRS - 1;
      ALL_CELLS(cell) {
        IN_STATE(state, STATE_T, cell) = pixels[cell].t;
        IN_STATE(state, STATE_RED, cell) = pixels[cell].red;
        IN_STATE(state, STATE_GREEN, cell) = pixels[cell].green;
        IN_STATE(state, STATE_BLUE, cell) = pixels[cell].blue;
#ifdef NEARNESS
        IN_STATE(state, STATE_NEAR, cell) = pixels[cell].near;
#endif
      }
    }
#endif
    FOR_FETCHES(fetch) {
      const int j = ITEM + fetch * ITEMS;
      const uint gaussian = gaussian_of[fetch], among = batch + j < end ? live : 0;
      FETCH_INDEX(fetch, batch + BATCH)
      const uint blocks = stage(staged + j, gaussian, KEPT(gaussian, batch + j), 0, among, splats, tile_x, tile_y);
      mark(marks, j, blocks, WARPS, OWNED);
    }
    BARRIER_LOCAL();

#define ENTRY(j) ENTRY_OF(j, SPARSE(OWNED) - (int)popcount(FROM_OWN(staged[j].blocks) & OF_FIRST_WARP))
    LIST_MARKED(count, marks + WARP * BATCH / 4, list, ENTRY)
    for (int block = ITEM; block < BLOCKS; block += ITEMS) open_in[block] = 0;
    BARRIER_LOCAL();

    uint next = list[0];
    OF_PAIRS for (int k = 1; k <= count; ++k) {
      const uint entry = next;
      next = list[k]; // loaded one iteration before its use
      const Staged s = staged[PAIR_OF(entry)];
      const int i = KEPT(batch + PAIR_OF(entry), (int)s.kept);
      SPLAT_STAGED(s)
      NEAR_HERE(s.near)
      const uint reach = FROM_OWN(s.blocks);
      COUNT(evaluated += IS_DENSE(entry, OWNED) ? OWNED : popcount(reach & OF_FIRST_WARP);)
      if (IS_DENSE(entry, OWNED)) {
        ALL_CELLS(cell) { BLEND(cell, LOG2_ALPHA(splat, cell)) } // alpha is 0 in pixels that are not reached
      } else {
        FOR_CELLS(cell, reach) {
          const floatL power = LOG2_ALPHA(splat, cell);
          if (power >= LOG2_ALPHA_MIN && pixels[cell].t > 0.0f) {
            BLEND(cell, power)
          }
        }
      }
    }
  }
#endif

#ifdef COUNT_PAIRS
#if LANES == 1
  counts[2 * get_global_id(0)] = added;
#else
  int lane_added[LANES];
  CAT(vstore, LANES)(added, 0, lane_added);
  counts[2 * get_global_id(0)] = 0;
  for (int lane = 0; lane < LANES; ++lane) counts[2 * get_global_id(0)] += lane_added[lane];
#endif
  counts[2 * get_global_id(0) + 1] = evaluated;
#endif

  ALL_CELLS(cell) {
    const size_t pixel = CELL_IN_PLANE(cell);
    const Pixels p = pixels[cell];
    const floatL at_end = T_AT_END(p);
    const floatL left = p.stop >= 0 ? at_end : (floatL)(0.0f);
    STORE_CELL(float, fmaL(left, (floatL)(background[0]), p.red), image + pixel, stride);
    STORE_CELL(float, fmaL(left, (floatL)(background[1]), p.green), image + plane + pixel, stride);
    STORE_CELL(float, fmaL(left, (floatL)(background[2]), p.blue), image + 2 * plane + pixel, stride);
#ifdef NEARNESS
    STORE_CELL(float, p.near, nearness + pixel, stride);
#endif
    STORE_CELL(float, at_end, transmittance + pixel, stride);
    STORE_CELL(int, p.stop, stops + pixel, stride);
  }
}

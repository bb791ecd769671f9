// Blending front to back until alpha saturates: the image from each tile's list of Gaussians.
//
// Owner: A group owns a tile. On a CPU (ITEMS == 1) one work-item walks the tile's Gaussians, and for each only the
//   cells that its ellipse reaches and that have a pixel left to fill. On a GPU (LANES == 1) each work-item has pixels
//   of its own. The bits are the same.
// Launch: One group of ITEMS work-items for each tile, the first for first_tile, in row-major order (a band of tiles,
//   or all).
// Buffers: ranges (tiles, 2), gaussian_from_sorted (pairs), splats (n, SPLAT_SIZE) in pixels, background (3), camera
//   with RAYS -> image (3, height, width) of colour; transmittance (height, width): what is left at the end, 0 to 1;
//   stops (height, width): the sorted index from which on the pixel takes no more, -1 in padding. Sizes are padded to
//   whole tiles, and padding is black. cells_from_sorted (pairs): the cells of the tile, as bits, in which the Gaussian
//   contributes, for the gradient to go through.
// Equations: docs/gradients.md, (14) to (16) and (45); with RAYS docs/cameras.md, (14); Kerbl et al. 2023, section 6
//   and algorithm 2.
//
// `t` is the transmittance of pixels that go on and 0 in those that are finished, whose own is put aside in `kept`:
// there no alpha has a weight, and no test is needed.
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/tile.h"
#include "shared/cells.h"
#include "shared/alpha.h"
#include "shared/prefetch.h"

#ifdef NO_EARLY_STOP // RasterizerConfig.early_stop: go on behind an opaque tile, to no effect
#define GOES_ON(open) 1
#else
#define GOES_ON(open) ((open) != 0)
#endif
#ifdef RECORD_CELLS
#define RECORD(statements) statements
#else
#define RECORD(statements)
#endif
// By ellipse few vectors are visited in vain: the test costs more than they.
#if defined(CELLS_BY_ELLIPSE) && !defined(RECORD_CELLS)
#define CONTRIBUTES(mask) 1
#else
#define CONTRIBUTES(mask) REACHES(mask)
#endif
#ifdef COUNT_PAIRS // a build for `clsplat bench`
#define COUNT(statements) statements
#else
#define COUNT(statements)
#endif

GROUP __kernel void blend(const int first_tile, const int tiles_x, const int width, const int height,
                          __global const uint *ranges, __global const uint *gaussian_from_sorted,
                          __global const float *splats, __global const float *background, __global float *image,
                          __global float *transmittance, __global int *stops
#ifdef RECORD_CELLS
                          ,
                          __global uint *cells_from_sorted
#endif
#ifdef RAYS
                          ,
                          __constant float *camera
#endif
#ifdef COUNT_PAIRS
                          ,
                          __global uint *counts // (items, 2): pairs that contribute, pairs evaluated
#endif
) {
  TILE_OF_GROUP
  PIXEL_TABLES
  RAY_TABLES
  floatL t[OWNED], kept[OWNED], red[OWNED], green[OWNED], blue[OWNED];
  intL stop[OWNED];
  COUNT(intL added = (intL)(0); uint evaluated = 0;)

  Open open = 0;
  for (int k = 0; k < OWNED; ++k) {
    const int cell = OWN_CELL(k);
    const floatL y = (floatL)(tile_y) + PIXELS_Y(cell);
    t[k] = (floatL)(tile_x) + PIXELS_X(cell) < (floatL)(width) ? (floatL)(1.0f) : (floatL)(0.0f);
    t[k] = y < (floatL)(height) ? t[k] : (floatL)(0.0f);
    kept[k] = (floatL)(1.0f);
    red[k] = green[k] = blue[k] = (floatL)(0.0f);
    stop[k] = t[k] > 0.0f ? (intL)(end) : (intL)(-1);
    if (ANYL(t[k] > 0.0f)) OPEN_CELL(open, cell);
  }

  int i = begin;
  Reach reach, second; // two at a time, ahead of their use: else each waits for the end of the last one's cells
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
    RECORD(uint cells = 0;)
    FOR_CELLS(cell, IN_OPEN(reach, open)) {
      const int k = cell / ITEMS;
      const floatL power = LOG2_ALPHA(splat, cell, k);
      COUNT(evaluated += LANES;)
      const intL reached = MASKL(power >= LOG2_ALPHA_MIN);
      if (CONTRIBUTES(reached)) {
        RECORD(cells |= 1u << cell;)
        const floatL before = t[k];
        floatL alpha = exp2L(power);
        alpha = alpha < ALPHA_MAX ? alpha : (floatL)(ALPHA_MAX);
        alpha = power >= LOG2_ALPHA_MIN ? alpha : (floatL)(0.0f);
        const floatL after = fmaL(-before, alpha, before);
        const intL goes_on = MASKL(after > TRANSMITTANCE_MIN);
        const floatL weight = AS_FLOATL(AS_INTL(before * alpha) & goes_on);
        COUNT(added += weight > 0.0f ? (intL)(1) : (intL)(0);)
        red[k] = fmaL(weight, (floatL)(c_red), red[k]);
        green[k] = fmaL(weight, (floatL)(c_green), green[k]);
        blue[k] = fmaL(weight, (floatL)(c_blue), blue[k]);
        t[k] = AS_FLOATL(AS_INTL(after) & goes_on);
        const intL ended = AS_INTL(before) & ~goes_on; // a positive number's bits, or none
        if (ANYL(ended)) {
          kept[k] = ended > 0 ? before : kept[k];
          stop[k] = ended > 0 ? (intL)(i) : stop[k];
          if (!ANYL(t[k] > 0.0f)) CLOSE_CELL(open, cell);
        }
      }
    }
    RECORD(cells_from_sorted[i] = cells;)
  }
  RECORD(for (; i < end; ++i) cells_from_sorted[i] = 0;)

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

  for (int k = 0; k < OWNED; ++k) {
    const int cell = OWN_CELL(k);
    const size_t pixel = CELL_IN_PLANE(cell);
    const floatL at_end = t[k] > 0.0f ? t[k] : kept[k];
    const floatL left = stop[k] >= 0 ? at_end : (floatL)(0.0f);
    STORE_CELL(float, fmaL(left, (floatL)(background[0]), red[k]), image + pixel, stride);
    STORE_CELL(float, fmaL(left, (floatL)(background[1]), green[k]), image + plane + pixel, stride);
    STORE_CELL(float, fmaL(left, (floatL)(background[2]), blue[k]), image + 2 * plane + pixel, stride);
    STORE_CELL(float, at_end, transmittance + pixel, stride);
    STORE_CELL(int, stop[k], stops + pixel, stride);
  }
}

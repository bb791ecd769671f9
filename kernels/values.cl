// Blends any number of values per Gaussian with the image's weights, VALUES of them per pass.
//
// Owner: A group owns a tile, as in blend.cl; the transmittance has the same bits as in blend.cl.
// Launch: One group of ITEMS work-items for each tile from first_tile on, as in blend.cl.
// Buffers: blend's ranges, gaussian_from_sorted, splats and stops, with RECORD_CELLS blend's cells_from_sorted;
//   value_rows (n, depth), background (depth) -> pixels (height, width, depth): VALUES values of each pixel, from
//   `first` on.
// Equations: docs/gradients.md, (177), with (14) to (16).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/tile.h"
#include "shared/cells.h"
#include "shared/alpha.h"
#include "shared/prefetch.h"
#include "shared/values.h"

// Adds the i-th pair's values to the sums of a cell's pixels. power: log2 of the uncapped alpha; own (VALUES): the
// Gaussian's values.
static inline void add_values(floatL power, intL stop, int i, __global const float *own, floatL *t, floatL *sums) {
  const intL taken = MASKL(power >= LOG2_ALPHA_MIN) & MASKL((intL)(i) < stop);
  if (!ANYL(taken)) return;
  const floatL before = *t, alpha = alpha_where(taken, power), weight = before * alpha;
  *t = fmaL(-before, alpha, before);
  FOR_VALUES(k) sums[k] = fmaL(weight, (floatL)(own[k]), sums[k]);
}

GROUP __kernel void values(const int first_tile, const int tiles_x, const int width, const int height, const int depth,
                           const int first, __global const uint *ranges, __global const uint *gaussian_from_sorted,
                           __global const float *splats, __global const float *value_rows,
                           __global const float *background, __global const int *stops, __global float *pixels
#ifdef RECORD_CELLS
                           ,
                           __global const uint *cells_from_sorted
#endif
) {
  TILE_OF_GROUP
  PIXEL_TABLES
  floatL t[OWNED], sums[OWNED][VALUES];
  intL stop[OWNED];
  int last = begin;
  ALL_CELLS(cell) {
    stop[cell] = LOAD_CELL(int, stops + CELL_IN_PLANE(cell), stride);
    t[cell] = (floatL)(1.0f);
    FOR_VALUES(k) sums[cell][k] = (floatL)(0.0f);
    last = max(last, maxL(stop[cell]));
  }
  RAISE_TO_GROUP_MAX(last)

#if ITEMS == 1
  for (int i = begin; i < last; ++i) {
    const uint ahead = gaussian_from_sorted[i + AHEAD < last ? i + AHEAD : last - 1];
    PREFETCH(splats + (size_t)SPLAT_SIZE * ahead);
    PREFETCH(value_rows + (size_t)depth * ahead + first);
    __global const float *splat = splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i];
    __global const float *own = value_rows + (size_t)depth * gaussian_from_sorted[i] + first;
    SPLAT_HERE(splat)
    FOR_CELLS(cell, CELLS_OF_PAIR(i, splat))
    add_values(LOG2_ALPHA(splat, cell), stop[cell], i, own, t + cell, sums[cell]);
  }
#else
  __local Staged staged[BATCH];
  for (int batch = begin; batch < last; batch += BATCH) {
    const int count = min(BATCH, last - batch);
    for (int j = ITEM; j < BATCH; j += ITEMS) {
      const uint gaussian = gaussian_from_sorted[min(batch + j, last - 1)];
      stage(staged + j, gaussian, gaussian, 0, ALL_BLOCKS, splats, tile_x, tile_y);
    }
    BARRIER_LOCAL();
    for (int j = 0; j < count; ++j) {
      const Staged s = staged[j];
      SPLAT_STAGED(s)
      __global const float *own = value_rows + (size_t)depth * s.kept + first;
      FOR_CELLS(cell, FROM_OWN(s.blocks))
      add_values(LOG2_ALPHA(splat, cell), stop[cell], batch + j, own, t + cell, sums[cell]);
    }
    BARRIER_LOCAL();
  }
#endif

  ALL_CELLS(cell) {
    Lanes left, value;
    left.all = t[cell];
    FOR_VALUES(k) {
      value.all = fmaL(left.all, (floatL)(background[first + k]), sums[cell][k]);
      for (int lane = 0; lane < LANES; ++lane) {
        const int x = tile_x + CELL_X(cell) + LANE_PIXEL_X(lane), y = tile_y + CELL_Y(cell) + LANE_PIXEL_Y(lane);
        if (x < width && y < height) pixels[(size_t)depth * ((size_t)width * y + x) + first + k] = value.lane[lane];
      }
    }
  }
}

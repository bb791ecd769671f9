// A picture in slices by depth: the Gaussians of each bin of depths blended as if they were alone, up to where the
// pixel ends in blend.cl. A tile's list is in order of depth, so that the bins come one after the other.
//
// Owner: A group owns a tile, as in blend.cl.
// Launch: One group of ITEMS work-items for each tile, the first for first_tile, as blend's.
// Buffers: blend's ranges, gaussian_from_sorted, splats and stops; bounds (bins - 1): the depths at which the next bin
//   begins, rising, in world units; camera with RAYS -> planes (bins, DEEP_SIZE, height, width): colour associated with
//   alpha, alpha, least and largest depth in world units. All 0 where nothing is added.
// Equations: docs/pictures.md, (70) to (73).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/tile.h"
#include "shared/cells.h"
#include "shared/alpha.h"
#include "shared/prefetch.h"

GROUP __kernel void deep(const int first_tile, const int tiles_x, const int height, const int bins,
                         __constant float *bounds, __global const uint *ranges,
                         __global const uint *gaussian_from_sorted, __global const float *splats,
                         __global const int *stops, __global float *planes
#ifdef RAYS
                         ,
                         __constant float *camera
#endif
) {
  TILE_OF_GROUP
  PIXEL_TABLES
  RAY_TABLES
  floatL values[DEEP_SIZE][OWNED]; // of the bin; DEEP_ALPHA: its transmittance
  intL stop[OWNED];
  int last = begin;
  ALL_CELLS(cell) {
    stop[cell] = LOAD_CELL(int, stops + CELL_IN_PLANE(cell), stride);
    for (int field = 0; field < DEEP_SIZE; ++field) values[field][cell] = (floatL)(field == DEEP_ALPHA ? 1.0f : 0.0f);
    last = max(last, maxL(stop[cell]));
  }
  RAISE_TO_GROUP_MAX(last)

  int i = begin;
  for (int bin = 0; bin < bins; ++bin) {
    for (; i < last; ++i) {
      const uint gaussian = gaussian_from_sorted[i];
      PREFETCH(splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i + AHEAD < last ? i + AHEAD : last - 1]);
      __global const float *splat = splats + (size_t)SPLAT_SIZE * gaussian;
      const float depth = splat[SPLAT_DEPTH];
      if (bin < bins - 1 && depth >= bounds[bin]) break;
      SPLAT_HERE(splat)
      const Reach reach = reach_of(splat, tile_x, tile_y);
      FOR_CELLS(cell, reach) {
        const floatL power = LOG2_ALPHA(splat, cell);
        const intL taken = MASKL(power >= LOG2_ALPHA_MIN) & MASKL((intL)(i) < stop[cell]);
        if (ANYL(taken)) {
          const floatL before = values[DEEP_ALPHA][cell];
          const floatL alpha = alpha_where(taken, power);
          const floatL weight = before * alpha;
          values[DEEP_ALPHA][cell] = fmaL(-before, alpha, before);
          for (int channel = 0; channel < 3; ++channel)
            values[DEEP_RED + channel][cell] =
                fmaL(weight, (floatL)(splat[SPLAT_RED + channel]), values[DEEP_RED + channel][cell]);
          const intL opening = taken & MASKL(before == 1.0f);
          values[DEEP_FIRST][cell] = opening ? (floatL)(depth) : values[DEEP_FIRST][cell];
          values[DEEP_LAST][cell] = taken ? (floatL)(depth) : values[DEEP_LAST][cell];
        }
      }
    }
    ALL_CELLS(cell) {
      const size_t pixel = CELL_IN_PLANE(cell);
      for (int field = 0; field < DEEP_SIZE; ++field) {
        const floatL value = values[field][cell];
        STORE_CELL(float, field == DEEP_ALPHA ? 1.0f - value : value,
                   planes + plane * (DEEP_SIZE * bin + field) + pixel, stride);
        values[field][cell] = (floatL)(field == DEEP_ALPHA ? 1.0f : 0.0f);
      }
    }
  }
}

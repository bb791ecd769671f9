// A deep picture: divides each pixel into at most `bins` slices by depth. The slices minimise the largest error of the
// transmittance over all depths.
//
// Owner: A group owns a tile, as in blend.cl; the transmittance has the same bits as in blend.cl.
// Launch: One group of ITEMS work-items for each tile from first_tile on, as in blend.cl.
// Buffers: share: 1 / (DEEP_LEVELS * bins), the unit of the slack (shared/slices.h) in a pixel of alpha 1.
//   blend's ranges, gaussian_from_sorted, splats, transmittance and stops; with RAYS camera.
//   -> planes (bins, DEEP_SIZE, height, width): premultiplied colour, alpha, and the slice's depth in world units. All
//     values are 0 after a pixel's last slice.
// Equations: docs/pictures.md, (70) to (74).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/tile.h"
#include "shared/cells.h"
#include "shared/alpha.h"
#include "shared/prefetch.h"
#include "shared/slices.h"

// Writes the current slice of each pixel and begins an empty slice, in the lanes that are set in `which`. values: the
// sums of the current slices; slices: their numbers.
static inline void write_slices(Lanes *values, IntLanes *slices, intL which, __global float *planes, size_t plane,
                                size_t stride) {
  IntLanes written;
  written.all = which;
  for (int lane = 0; lane < LANES; ++lane) {
    if (written.lane[lane] == 0) continue;
    __global float *to = planes + plane * DEEP_SIZE * slices->lane[lane] + LANE_IN_PLANE(lane);
    for (int field = 0; field < DEEP_SIZE; ++field) to[plane * field] = values[field].lane[lane];
    to[plane * DEEP_ALPHA] = 1.0f - values[DEEP_ALPHA].lane[lane];
  }
  for (int field = 0; field < DEEP_SIZE; ++field)
    values[field].all = which ? (floatL)(field == DEEP_ALPHA ? 1.0f : 0.0f) : values[field].all;
  slices->all -= which;
}

GROUP __kernel void deep(const int first_tile, const int tiles_x, const int height, const int bins, const float share,
                         __global const uint *ranges, __global const uint *gaussian_from_sorted,
                         __global const float *splats, __global const float *transmittance, __global const int *stops,
                         __global float *planes
#ifdef RAYS
                         ,
                         __constant float *camera
#endif
) {
  TILE_OF_GROUP
  PIXEL_TABLES
  RAY_TABLES
  floatL t[OWNED], unit[OWNED], level[OWNED], open[OWNED][TRIED];
  intL stop[OWNED], counts[OWNED][TRIED];
  Lanes values[OWNED][DEEP_SIZE]; // sums of the current slice; DEEP_ALPHA holds the slice's transmittance
  IntLanes slices[OWNED];
  int last = begin;
  ALL_CELLS(cell) {
    const size_t pixel = CELL_IN_PLANE(cell);
    stop[cell] = LOAD_CELL(int, stops + pixel, stride);
    unit[cell] = (1.0f - LOAD_CELL(float, transmittance + pixel, stride)) * share;
    level[cell] = (floatL)(0.0f);
    slices[cell].all = (intL)(0);
    last = max(last, maxL(stop[cell]));
    for (int field = 0; field < DEEP_SIZE; ++field)
      values[cell][field].all = (floatL)(field == DEEP_ALPHA ? 1.0f : 0.0f);
    for (int part = 0; part < bins * DEEP_SIZE; ++part)
      STORE_CELL(float, (floatL)(0.0f), planes + plane * part + pixel, stride);
  }
  RAISE_TO_GROUP_MAX(last)

  for (int walk = 0, step = FIRST_STEP; walk < WALKS; ++walk, step /= STEPS) {
    ALL_CELLS(cell) {
      t[cell] = (floatL)(1.0f);
      for (int k = 0; k < TRIED; ++k) {
        open[cell][k] = (floatL)(1.0f);
        counts[cell][k] = (intL)(1);
      }
    }
    for (int i = begin; i < last; ++i) {
      const uint gaussian = gaussian_from_sorted[i];
      PREFETCH(splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i + AHEAD < last ? i + AHEAD : last - 1]);
      __global const float *splat = splats + (size_t)SPLAT_SIZE * gaussian;
      const float depth = splat[SPLAT_DEPTH];
      SPLAT_HERE(splat)
      const Reach reach = reach_of(splat, tile_x, tile_y);
      FOR_CELLS(cell, reach) {
        const floatL power = LOG2_ALPHA(splat, cell);
        const intL taken = MASKL(power >= LOG2_ALPHA_MIN) & MASKL((intL)(i) < stop[cell]);
        if (ANYL(taken)) {
          const floatL alpha = alpha_where(taken, power), before = t[cell];
          const floatL after = fmaL(-before, alpha, before);
          t[cell] = after;
          if (walk < WALKS - 1) {
            for (int k = 0; k < TRIED; ++k) {
              const floatL slack = unit[cell] * (level[cell] + (float)(step * (k + 1)));
              // Adds 1 where a slice begins, because true is -1.
              counts[cell][k] -= begins_slice(open[cell] + k, before, after, slack, taken, taken);
            }
          } else {
            Lanes *slice = values[cell];
            const intL room =
                MASKL(slices[cell].all < (intL)(bins - 1)) & MASKL((floatL)(depth) > slice[DEEP_DEPTH].all);
            const floatL slack = unit[cell] * (level[cell] + 1.0f);
            const intL begins = begins_slice(open[cell], before, after, slack, taken, taken & room);
            if (ANYL(begins)) write_slices(slice, slices + cell, begins, planes + CELL_IN_PLANE(cell), plane, stride);
            const floatL left = slice[DEEP_ALPHA].all, weight = left * alpha;
            slice[DEEP_ALPHA].all = fmaL(-left, alpha, left);
            for (int channel = 0; channel < 3; ++channel)
              slice[DEEP_RED + channel].all =
                  fmaL(weight, (floatL)(splat[SPLAT_RED + channel]), slice[DEEP_RED + channel].all);
            const intL placing = taken & MASKL(open[cell][0] > 0.0f);
            slice[DEEP_DEPTH].all = placing ? (floatL)(depth) : slice[DEEP_DEPTH].all;
          }
        }
      }
    }
    if (walk < WALKS - 1) ALL_CELLS(cell)
    for (int k = 0; k < TRIED; ++k)
      level[cell] += counts[cell][k] > (intL)(bins) ? (floatL)((float)step) : (floatL)(0.0f);
  }
  ALL_CELLS(cell)
  write_slices(values[cell], slices + cell, MASKL(values[cell][DEEP_ALPHA].all < 1.0f), planes + CELL_IN_PLANE(cell),
               plane, stride);
}

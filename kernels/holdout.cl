// Holdout: blends the image of blend.cl again, without the light that surfaces of CG elements absorb.
//
// Owner: A group owns a tile, as in blend.cl; the transmittance has the same bits as in blend.cl.
// Launch: One group of ITEMS work-items for each tile from first_tile on, as in blend.cl.
// Buffers: blend's ranges, gaussian_from_sorted, splats, background and stops; the surfaces of shared/held.h; with RAYS
//     camera.
//   -> image (3, height, width), transmittance (height, width): those of blend, overwritten by the colour and by 1
//     minus the visible alpha. Pixels without a surface in front of a Gaussian keep their bits.
// Equations: docs/pictures.md, (75) to (77).
#define HOLDOUT
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/tile.h"
#include "shared/cells.h"
#include "shared/alpha.h"
#include "shared/prefetch.h"
#include "shared/held.h"

GROUP __kernel void holdout(const int first_tile, const int tiles_x, const int height, __global const uint *ranges,
                            __global const uint *gaussian_from_sorted, __global const float *splats,
                            __global const float *background, __global const int *stops, __global float *image,
                            __global float *transmittance HELD_PARAMETERS
#ifdef RAYS
                            ,
                            __constant float *camera
#endif
) {
  TILE_OF_GROUP
  PIXEL_TABLES
  RAY_TABLES
  floatL t[OWNED], sums[3][OWNED], seen[OWNED];
  intL stop[OWNED], cut[OWNED];
  Held held[OWNED];
  int last = begin;
  ALL_CELLS(cell) {
    const size_t pixel = CELL_IN_PLANE(cell);
    stop[cell] = LOAD_CELL(int, stops + pixel, stride);
    held[cell] = held_of(held_starts + pixel, held_surfaces, stride);
    t[cell] = (floatL)(1.0f);
    seen[cell] = (floatL)(0.0f);
    for (int channel = 0; channel < 3; ++channel) sums[channel][cell] = (floatL)(0.0f);
    cut[cell] = (intL)(0);
    last = max(last, maxL(stop[cell]));
  }
  RAISE_TO_GROUP_MAX(last)

  for (int i = begin; i < last; ++i) {
    const uint gaussian = gaussian_from_sorted[i];
    PREFETCH(splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i + AHEAD < last ? i + AHEAD : last - 1]);
    __global const float *splat = splats + (size_t)SPLAT_SIZE * gaussian;
    SPLAT_HERE(splat)
    const Reach reach = reach_of(splat, tile_x, tile_y);
    FOR_CELLS(cell, reach) {
      const floatL power = LOG2_ALPHA(splat, cell);
      const intL taken = MASKL(power >= LOG2_ALPHA_MIN) & MASKL((intL)(i) < stop[cell]);
      if (ANYL(taken)) {
        const floatL through = let_through(splat[SPLAT_DEPTH], held + cell, held_surfaces);
        const floatL before = t[cell];
        const floatL alpha = alpha_where(taken, power);
        const floatL weight = before * alpha * through;
        t[cell] = fmaL(-before, alpha, before);
        for (int channel = 0; channel < 3; ++channel)
          sums[channel][cell] = fmaL(weight, (floatL)(splat[SPLAT_RED + channel]), sums[channel][cell]);
        seen[cell] += weight;
        cut[cell] |= taken & MASKL(through < 1.0f);
      }
    }
  }

  ALL_CELLS(cell) {
    const size_t pixel = CELL_IN_PLANE(cell);
    const floatL at_end = LOAD_CELL(float, transmittance + pixel, stride);
    const floatL behind = at_end * let_through(INFINITY, held + cell, held_surfaces);
    const floatL left = stop[cell] >= 0 ? behind : (floatL)(0.0f);
    for (int channel = 0; channel < 3; ++channel)
      STORE_CELL(float, fmaL(left, (floatL)(background[channel]), sums[channel][cell]), image + plane * channel + pixel,
                 stride);
    STORE_CELL(float, cut[cell] != 0 ? 1.0f - seen[cell] : at_end, transmittance + pixel, stride);
  }
}

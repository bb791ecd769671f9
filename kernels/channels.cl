// Auxiliary channels of a frame: features blended with the image's weights; first depth (of the first Gaussian), median
// depth (where the transmittance falls to 0.5), the number of Gaussians, and the index of the Gaussian with the largest
// weight.
//
// Owner: A group owns a tile, as in blend.cl; the transmittance has the same bits as in blend.cl.
// Launch: One group of ITEMS work-items for each tile from first_tile on, as in blend.cl.
// Buffers: blend's ranges, gaussian_from_sorted, splats and stops.
//   features (n, FEATURES): of features.cl.
//   camera: with RAYS.
//   -> planes (PLANES, height, width): weighted means of the features, in their units (the three planes from
//     FEATURE_NORMAL on are normalised); then median depth and first depth, in world units.
//   whole (2, height, width): the number of Gaussians, and the index of the Gaussian with the largest weight (the first
//     of equals), or -1 in padding and in pixels without Gaussians, where all other values are 0.
//   With HOLDOUT, weights are multiplied by the fraction of light that passes the surfaces of shared/held.h, and fully
//     hidden Gaussians are left out.
// Equations: docs/channels.md, (60) to (67); with HOLDOUT docs/pictures.md, (75); with RAYS docs/cameras.md, (14).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/tile.h"
#include "shared/cells.h"
#include "shared/alpha.h"
#include "shared/prefetch.h"
#include "shared/held.h"

#define PLANES (FEATURES + 2)
#define MEDIAN FEATURES
#define FIRST (FEATURES + 1)

GROUP __kernel void channels(const int first_tile, const int tiles_x, const int height, __global const uint *ranges,
                             __global const uint *gaussian_from_sorted, __global const float *splats,
                             __global const float *features, __global const int *stops, __global float *planes,
                             __global int *whole HELD_PARAMETERS
#ifdef RAYS
                             ,
                             __constant float *camera
#endif
) {
  TILE_OF_GROUP
  PIXEL_TABLES
  RAY_TABLES
  floatL t[OWNED], sums[FEATURES + 1][OWNED], median[OWNED], nearest[OWNED], largest[OWNED];
  intL stop[OWNED], count[OWNED], heaviest[OWNED];
  int last = begin;
#ifdef HOLDOUT
  floatL cut[OWNED]; // fraction of the pixel's light that the surfaces have absorbed so far
  Held held[OWNED];
  ALL_CELLS(cell) {
    cut[cell] = (floatL)(0.0f);
    held[cell] = held_of(held_starts + CELL_IN_PLANE(cell), held_surfaces, stride);
  }
#endif
  ALL_CELLS(cell) {
    stop[cell] = LOAD_CELL(int, stops + CELL_IN_PLANE(cell), stride);
    t[cell] = (floatL)(1.0f);
    for (int field = 0; field <= FEATURES; ++field) sums[field][cell] = (floatL)(0.0f);
    median[cell] = nearest[cell] = largest[cell] = (floatL)(0.0f);
    count[cell] = (intL)(0);
    heaviest[cell] = (intL)(-1);
    last = max(last, maxL(stop[cell]));
  }
  RAISE_TO_GROUP_MAX(last)

  for (int i = begin; i < last; ++i) {
    const uint gaussian = gaussian_from_sorted[i];
    PREFETCH(splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i + AHEAD < last ? i + AHEAD : last - 1]);
    PREFETCH(features + (size_t)FEATURES * gaussian_from_sorted[i + AHEAD < last ? i + AHEAD : last - 1]);
    __global const float *splat = splats + (size_t)SPLAT_SIZE * gaussian;
    __global const float *own = features + (size_t)FEATURES * gaussian;
    SPLAT_HERE(splat)
    const float depth = splat[SPLAT_DEPTH];
    const Reach reach = reach_of(splat, tile_x, tile_y);
    FOR_CELLS(cell, reach) {
      const floatL power = LOG2_ALPHA(splat, cell);
      intL taken = MASKL(power >= LOG2_ALPHA_MIN) & MASKL((intL)(i) < stop[cell]);
      if (ANYL(taken)) {
        const floatL before = t[cell];
#ifdef HOLDOUT // a Gaussian behind an opaque surface does not count
        const floatL through = let_through(depth, held + cell, held_surfaces);
        taken &= MASKL(through > 0.0f);
#endif
        const floatL alpha = alpha_where(taken, power);
        t[cell] = fmaL(-before, alpha, before);
#ifdef HOLDOUT
        const floatL weight = before * alpha * through, left_before = before + cut[cell];
        cut[cell] += before * alpha * (1.0f - through);
        const floatL left = t[cell] + cut[cell];
#else
        const floatL weight = before * alpha, left_before = before, left = t[cell];
#endif
        for (int field = 0; field < FEATURES; ++field)
          sums[field][cell] = fmaL(weight, (floatL)(own[field]), sums[field][cell]);
        sums[FEATURES][cell] += weight;
        const intL halving = taken & MASKL(left_before > 0.5f) & MASKL(left <= 0.5f);
        median[cell] = halving ? (floatL)(depth) : median[cell];
        const intL opening = taken & MASKL(count[cell] == 0);
        nearest[cell] = opening ? (floatL)(depth) : nearest[cell];
        count[cell] -= taken; // taken is -1 where true
        const intL heavier = taken & MASKL(weight > largest[cell]);
        largest[cell] = heavier ? weight : largest[cell];
        heaviest[cell] = heavier ? (intL)((int)gaussian) : heaviest[cell];
      }
    }
  }

  ALL_CELLS(cell) {
    const size_t pixel = CELL_IN_PLANE(cell);
    const floatL total = sums[FEATURES][cell];
    const floatL divisor = total > 0.0f ? total : (floatL)(1.0f);
#ifdef FEATURE_NORMAL
    floatL length2 = (floatL)(0.0f);
    for (int axis = 0; axis < 3; ++axis)
      length2 = fmaL(sums[FEATURE_NORMAL + axis][cell], sums[FEATURE_NORMAL + axis][cell], length2);
    const floatL length = length2 > 0.0f ? sqrt(length2) : (floatL)(1.0f);
#endif
    for (int field = 0; field < FEATURES; ++field) {
#ifdef FEATURE_NORMAL
      const floatL by = field >= FEATURE_NORMAL && field < FEATURE_NORMAL + 3 ? length : divisor;
#else
      const floatL by = divisor;
#endif
      STORE_CELL(float, sums[field][cell] / by, planes + plane * field + pixel, stride);
    }
    STORE_CELL(float, median[cell], planes + plane * MEDIAN + pixel, stride);
    STORE_CELL(float, nearest[cell], planes + plane * FIRST + pixel, stride);
    STORE_CELL(int, count[cell], whole + pixel, stride);
    STORE_CELL(int, heaviest[cell], whole + plane + pixel, stride);
  }
}

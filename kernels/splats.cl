// Computes splats from arrays of projected Gaussians: the whitening of each conic, and the extent and tiles of its
// ellipse.
//
// Owner: A work-item owns LANES Gaussians. It computes splats in vectors, and counts tiles and writes splats one
//   visible Gaussian at a time.
// Launch: One work-item for each LANES Gaussians, in groups of 64; work-items past the end do nothing.
// Buffers: radii (n, 2): in whole pixels; a radius of 0 culls. means2d (n, 2): in pixels.
//   conics (n, 3): a, b, c of the inverse covariance. opacities (n): in [0, 1]. depths (n).
//   values (n, width): the first three are the colour, with 0 in place of missing values.
//   -> splat_rows (n, SPLAT_SIZE): the splats, written where visible; tile_counts (n): 0 where culled. With LISTED the
//     caller makes the tile lists, so every splat is written; a culled Gaussian's splat has alpha 0.
// Equations: docs/gradients.md, (170) to (172), with (44) to (47).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/splat.h"
#include "shared/tile.h"

// Limits of a conic's a and c, within which float32 can represent the determinant; and the limit of a mean's position
// in pixels.
#define LEAST_CONIC 1e-15f
#define LARGEST_CONIC 1e15f
#define FARTHEST_PIXEL 1e9f

// Rounding a, b and c can change a conic's determinant by this fraction of a times c.
#define ROUNDING 5.9604645e-8f

// log2 of an alpha too small to show in any pixel.
#define NO_ALPHA -1e3f

__kernel void splats(const uint n, const int tiles_x, const int tiles_y, const int width, __global const int *radii,
                     __global const float *means2d, __global const float *conics, __global const float *opacities,
                     __global const float *depths, __global const float *values, __global float *splat_rows,
                     __global uint *tile_counts) {
  ROWS_OF_ITEM(n)
  const floatL mx = GATHER(means2d, 2, 0), my = GATHER(means2d, 2, 1), depth = GATHER(depths, 1, 0);
  const floatL a = GATHER(conics, 3, 0), b = GATHER(conics, 3, 1), c = GATHER(conics, 3, 2);
  const floatL opacity = GATHER(opacities, 1, 0);

  // Equation (170) of docs/gradients.md: a c - b^2 to the last bit. If rounding has made a conic singular, it gets the
  // smallest determinant that float32 resolves.
  const floatL bb = b * b, ac = a * c;
  const floatL exact = fmaL(a, c, -bb) + fmaL(-b, b, bb), least = ROUNDING * ac;
  const floatL det = exact > least ? exact : least;
  IntLanes valid;
  valid.all = MASKL(a > LEAST_CONIC) & MASKL(a < LARGEST_CONIC) & MASKL(c > LEAST_CONIC) & MASKL(c < LARGEST_CONIC);
  valid.all &= MASKL(exact > -4.0f * least) & MASKL(opacity > ALPHA_MIN) & MASKL(opacity < LARGEST_CONIC);
  valid.all &= MASKL(mx * mx < FARTHEST_PIXEL * FARTHEST_PIXEL) & MASKL(my * my < FARTHEST_PIXEL * FARTHEST_PIXEL);
  valid.all &= MASKL(depth * 0.0f == 0.0f);
  valid.all &= MASKL(GATHER(radii, 2, 0) > 0.0f) & MASKL(GATHER(radii, 2, 1) > 0.0f);

  Lanes field[SPLAT_SIZE];
  const floatL root = sqrt(a), log2o = log2L(opacity), budget = (floatL)(EXTENT(log2o));
  field[SPLAT_PIXEL_X].all = floorL(mx);
  field[SPLAT_PIXEL_Y].all = floorL(my);
  field[SPLAT_SUB_X].all = mx - field[SPLAT_PIXEL_X].all;
  field[SPLAT_SUB_Y].all = my - field[SPLAT_PIXEL_Y].all;
  field[SPLAT_L11].all = WHITEN * root; // equation (171) of docs/gradients.md
  field[SPLAT_L12].all = WHITEN * (b / root);
  field[SPLAT_L22].all = WHITEN * sqrt(det / a);
  field[SPLAT_LOG2O].all = log2o;
  field[SPLAT_DEPTH].all = depth;
  field[SPLAT_HALF_W].all = sqrt(budget * (c / det)) / WHITEN; // equation (172) of docs/gradients.md
  field[SPLAT_HALF_H].all = sqrt(budget * (a / det)) / WHITEN;
  field[SPLAT_INVERSE_L11].all = 1.0f / field[SPLAT_L11].all;

  for (uint lane = 0; lane < lanes_used; ++lane) {
    const size_t i = first_row + lane;
    __global float *splat = splat_rows + (size_t)SPLAT_SIZE * i;
#ifdef LISTED
    if (!valid.lane[lane]) {
      for (int k = 0; k < SPLAT_SIZE; ++k) splat[k] = 0.0f;
      splat[SPLAT_L11] = splat[SPLAT_L22] = splat[SPLAT_INVERSE_L11] = splat[SPLAT_DEPTH] = 1.0f;
      splat[SPLAT_LOG2O] = NO_ALPHA;
    }
#endif
    tile_counts[i] = 0;
    if (!valid.lane[lane]) continue;
    const int fields[] = {SPLAT_PIXEL_X, SPLAT_PIXEL_Y, SPLAT_SUB_X, SPLAT_SUB_Y,  SPLAT_L11,    SPLAT_L12,
                          SPLAT_L22,     SPLAT_LOG2O,   SPLAT_DEPTH, SPLAT_HALF_W, SPLAT_HALF_H, SPLAT_INVERSE_L11};
    for (uint k = 0; k < sizeof(fields) / sizeof(fields[0]); ++k) splat[fields[k]] = field[fields[k]].lane[lane];
    const Ellipse e = ellipse_of(splat, tiles_x, tiles_y);
    const uint count = tile_count(&e, tiles_x);
    tile_counts[i] = count;
#ifndef LISTED
    if (count == 0) continue;
#endif
    __global const float *colour = values + (size_t)width * i;
    splat[SPLAT_RED] = width > 0 ? colour[0] : 0.0f;
    splat[SPLAT_GREEN] = width > 1 ? colour[1] : 0.0f;
    splat[SPLAT_BLUE] = width > 2 ? colour[2] : 0.0f;
  }
}

// The gradient of blending, back to front: partial sums for each pair of a tile and a Gaussian.
//
// Owner: A group owns a tile and writes one slot for each of its pairs, at a place of its own: no atomics on global
//   memory.
// Launch: One group of ITEMS work-items for each tile, the first for first_tile, as blend's.
// Buffers: blend's, its transmittance and stops, image_gradient (3, height, width): of the loss by colour,
//   slot_from_sorted (pairs) -> slots (pairs, SLOT_STRIDE), every one of them: sums over the tile's pixels in blend's
//   whitened units (49).
// Equations: docs/gradients.md, (14), (22) to (26), (48), (49) and (55).
//
// Per pixel, from the last Gaussian to the first: transmittance is recovered by division, and `behind` holds what comes
// after (sum of weight times colour, background included) as seen by the pixel's gradient. The sums over pixels are
// moments of g = alpha * dL/dalpha in (u, v); with CONTRIBUTIONS there is the sum of the weights too (55).
#include "shared/math.h"
#include "shared/splat.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/tile.h"
#include "shared/cells.h"
#include "shared/alpha.h"
#include "shared/prefetch.h"

// RasterizerConfig.gradient_skip; contributions are of all cells.
#if defined(NO_GRADIENT_SKIP) || defined(CONTRIBUTIONS)
#define LIVE(cells, live) (cells)
#else
#define LIVE(cells, live) ((cells) & (live))
#endif
#ifdef RECORD_CELLS // by blend: each cell that is visited has a pixel that takes the Gaussian
#define CONTRIBUTES(mask) 1
#else
#define CONTRIBUTES(mask) REACHES(mask)
#endif

#if ITEMS > 1
// slot[field] = the sum of value over the group, in a fixed tree.
static inline void group_sums(float *values, __local float *scratch, __global float *slot) {
  const int item = get_local_id(0);
  for (int field = 0; field < SLOT_STRIDE; ++field) scratch[field * ITEMS + item] = values[field];
  for (int step = ITEMS / 2; step > 0; step /= 2) {
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < step)
      for (int field = 0; field < SLOT_STRIDE; ++field)
        scratch[field * ITEMS + item] += scratch[field * ITEMS + item + step];
  }
  barrier(CLK_LOCAL_MEM_FENCE);
  for (int field = item; field < SLOT_STRIDE; field += ITEMS) slot[field] = scratch[field * ITEMS];
  barrier(CLK_LOCAL_MEM_FENCE);
}
#endif

GROUP __kernel void blend_grad(const int first_tile, const int tiles_x, const int height, __global const uint *ranges,
                               __global const uint *gaussian_from_sorted, __global const uint *slot_from_sorted,
                               __global const float *splats, __global const float *background,
                               __global const float *image_gradient, __global const float *transmittance,
                               __global const int *stops, __global float *slots
#ifdef RECORD_CELLS
                               ,
                               __global const uint *cells_from_sorted
#endif
) {
#if ITEMS > 1
  __local float scratch[SLOT_STRIDE * ITEMS];
#endif
  TILE_OF_GROUP
  PIXEL_TABLES
  floatL t[OWNED], behind[OWNED], g_red[OWNED], g_green[OWNED], g_blue[OWNED];
  intL stop[OWNED];
  int last = begin;
  Open live = 0; // cells with a pixel that has a gradient
  for (int k = 0; k < OWNED; ++k) {
    const int cell = OWN_CELL(k);
    const size_t pixel = CELL_IN_PLANE(cell);
    t[k] = LOAD_CELL(float, transmittance + pixel, stride);
    stop[k] = LOAD_CELL(int, stops + pixel, stride);
    const intL inside = MASKL(stop[k] >= 0); // in padding nobody has written a gradient, and 0 * NaN is not 0
    g_red[k] = AS_FLOATL(LOAD_CELL(int, (__global const int *)image_gradient + pixel, stride) & inside);
    g_green[k] = AS_FLOATL(LOAD_CELL(int, (__global const int *)image_gradient + plane + pixel, stride) & inside);
    g_blue[k] = AS_FLOATL(LOAD_CELL(int, (__global const int *)image_gradient + 2 * plane + pixel, stride) & inside);
    behind[k] = t[k] * (g_red[k] * background[0] + g_green[k] * background[1] + g_blue[k] * background[2]);
    last = max(last, maxL(stop[k]));
    if (ANYL((g_red[k] != 0.0f) | (g_green[k] != 0.0f) | (g_blue[k] != 0.0f))) OPEN_CELL(live, cell);
  }
  RAISE_TO_GROUP_MAX(last)
#ifdef NO_LAST_CONTRIBUTOR // RasterizerConfig.last_contributor: begin at the end of the list, to no effect
  last = end;
#endif

  for (int i = last + (int)get_local_id(0); i < end; i += ITEMS) {
    __global float *slot = slots + (size_t)SLOT_STRIDE * slot_from_sorted[i];
    for (int field = 0; field < SLOT_STRIDE; ++field) slot[field] = 0.0f;
  }

  for (int i = last - 1; i >= begin; --i) {
    PREFETCH(splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i - AHEAD > begin ? i - AHEAD : begin]);
    PREFETCH(slots + (size_t)SLOT_STRIDE * slot_from_sorted[i - AHEAD > begin ? i - AHEAD : begin]);
    __global const float *splat = splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i];
    __global float *slot = slots + (size_t)SLOT_STRIDE * slot_from_sorted[i];
    const float l11 = splat[SPLAT_L11], l12 = splat[SPLAT_L12], l22 = splat[SPLAT_L22];
    const float log2o = splat[SPLAT_LOG2O];
    const float c_red = splat[SPLAT_RED], c_green = splat[SPLAT_GREEN], c_blue = splat[SPLAT_BLUE];
    const float mx = FROM_TILE(splat, X, tile_x), my = FROM_TILE(splat, Y, tile_y);
#ifdef RECORD_CELLS
    const uint reach = LIVE(cells_from_sorted[i], live);
    if (reach == 0) {
      for (int field = 0; field < SLOT_STRIDE; ++field) slot[field] = 0.0f;
      continue;
    }
#else
    const Reach reach = reach_of(splat, tile_x, tile_y);
#endif
    const floatL zero = (floatL)(0.0f);
    floatL sum_g = zero, sum_gu = zero, sum_gv = zero, sum_guu = zero, sum_guv = zero, sum_gvv = zero;
    floatL d_red = zero, d_green = zero, d_blue = zero;
#ifdef ABSOLUTE_GRADIENTS
    floatL abs_x = zero, abs_y = zero;
#endif
#ifdef CONTRIBUTIONS
    floatL sum_weight = zero;
#endif
    FOR_CELLS(cell, reach) {
      const int k = cell / ITEMS;
      const floatL dy = my - AT_Y(cell);
      const floatL u = whitened_u(l11, l12, mx - AT_X(cell), dy), v = l22 * dy;
      const floatL power = log2_alpha(u, v, log2o);
      const intL taken = MASKL(power >= LOG2_ALPHA_MIN) & MASKL((intL)(i) < stop[k]);
      if (CONTRIBUTES(taken)) {
        const floatL uncapped = AS_FLOATL(AS_INTL(exp2L(power)) & taken);
        const floatL alpha = uncapped < ALPHA_MAX ? uncapped : (floatL)(ALPHA_MAX);
        const floatL inverse = 1.0f / (1.0f - alpha);
        const floatL before = t[k] * inverse;
        const floatL shade = fmaL(g_red[k], (floatL)(c_red), fmaL(g_green[k], (floatL)(c_green), g_blue[k] * c_blue));
        const floatL weight = alpha * before;
        const floatL d_alpha = fmaL(before, shade, -(behind[k] * inverse));
        const floatL g = AS_FLOATL(AS_INTL(alpha * d_alpha) & MASKL(uncapped < ALPHA_MAX));
        behind[k] = fmaL(weight, shade, behind[k]);
        t[k] = before;
        d_red = fmaL(weight, g_red[k], d_red);
        d_green = fmaL(weight, g_green[k], d_green);
        d_blue = fmaL(weight, g_blue[k], d_blue);
        ADD_MOMENTS(g, u, v);
#ifdef ABSOLUTE_GRADIENTS
        abs_x += fabs(g * (l11 * u));
        abs_y += fabs(g * fmaL((floatL)(l12), u, l22 * v));
#endif
#ifdef CONTRIBUTIONS
        sum_weight += weight;
#endif
      }
    }

#if LANES >= 8 && ITEMS == 1
    // The first eight fields of a slot, in the order of layout.SLOT.
    typedef float8 float8U __attribute__((aligned(4)));
    *(__global float8U *)slot = sums8(sum_g, sum_gu, sum_gv, sum_guu, sum_guv, sum_gvv, d_red, d_green);
    slot[SLOT_BLUE] = sumL(d_blue);
#ifdef ABSOLUTE_GRADIENTS
    slot[SLOT_ABSX] = sumL(abs_x);
    slot[SLOT_ABSY] = sumL(abs_y);
#endif
#ifdef CONTRIBUTIONS
    slot[SLOT_WEIGHT] = sumL(sum_weight);
#endif
#else
    float values[SLOT_STRIDE];
    values[SLOT_G] = sumL(sum_g);
    values[SLOT_GU] = sumL(sum_gu);
    values[SLOT_GV] = sumL(sum_gv);
    values[SLOT_GUU] = sumL(sum_guu);
    values[SLOT_GUV] = sumL(sum_guv);
    values[SLOT_GVV] = sumL(sum_gvv);
    values[SLOT_RED] = sumL(d_red);
    values[SLOT_GREEN] = sumL(d_green);
    values[SLOT_BLUE] = sumL(d_blue);
#ifdef ABSOLUTE_GRADIENTS
    values[SLOT_ABSX] = sumL(abs_x);
    values[SLOT_ABSY] = sumL(abs_y);
#endif
#ifdef CONTRIBUTIONS
    values[SLOT_WEIGHT] = sumL(sum_weight);
#endif
#if ITEMS == 1
    for (int field = 0; field < SLOT_STRIDE; ++field) slot[field] = values[field];
#else
    group_sums(values, scratch, slot);
#endif
#endif
  }
}

// The gradient of blending, back to front (docs/gradients.md, equations 22 to 26, 48 and 49). A group owns a tile and
// writes one slot of partial sums for each of its (tile, Gaussian) pairs, at a place of its own: no atomics.
//
// Per pixel, from the last Gaussian to the first: transmittance is recovered by division, and `behind` holds what comes
// after (sum of weight times colour, background included) as seen by the pixel's gradient. The sums over pixels are
// moments of g = alpha * dL/dalpha; they are taken about the tile's centre, where no ellipse is far off in units of its
// own width, and moved to (u, v) at the end.
#include "shared/math.h"
#include "shared/splat.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/tile.h"
#include "shared/alpha.h"
#include "shared/prefetch.h"

#define CENTRE (0.5f * TILE - 0.5f)

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

// As blend, its transmittance and stops, image_gradient (3, height, width), slot_from_sorted (pairs)
// -> slots (pairs, SLOT_STRIDE), every one of them.
GROUP __kernel void blend_grad(const int tiles_x, const int height, __global const uint *ranges,
                               __global const uint *gaussian_from_sorted, __global const uint *slot_from_sorted,
                               __global const float *splats, __global const float *background,
                               __global const float *image_gradient, __global const float *transmittance,
                               __global const int *stops, __global float *slots) {
#if ITEMS > 1
  __local float scratch[SLOT_STRIDE * ITEMS];
  __local int group_last;
#endif
  const int tile = get_group_id(0);
  const int tile_x = (tile % tiles_x) * TILE, tile_y = (tile / tiles_x) * TILE;
  const int begin = ranges[2 * tile], end = ranges[2 * tile + 1];
  const size_t stride = (size_t)tiles_x * TILE;
  const size_t plane = stride * ((height + TILE - 1) / TILE * TILE);

  floatL t[OWNED], behind[OWNED], g_red[OWNED], g_green[OWNED], g_blue[OWNED];
  intL stop[OWNED];
  int last = begin;
  for (int k = 0; k < OWNED; ++k) {
    const int vector = get_local_id(0) + k * ITEMS;
    const size_t pixel = stride * (tile_y + vector / HALVES) + tile_x + (vector % HALVES) * LANES;
    t[k] = LOADL(transmittance + pixel);
    g_red[k] = LOADL(image_gradient + pixel);
    g_green[k] = LOADL(image_gradient + plane + pixel);
    g_blue[k] = LOADL(image_gradient + 2 * plane + pixel);
    behind[k] = t[k] * (g_red[k] * background[0] + g_green[k] * background[1] + g_blue[k] * background[2]);
#if LANES == 1
    stop[k] = stops[pixel];
    last = max(last, stop[k]);
#else
    stop[k] = CAT(vload, LANES)(0, stops + pixel);
    for (int lane = 0; lane < LANES; ++lane) last = max(last, stops[pixel + lane]);
#endif
  }
#if ITEMS > 1
  if (get_local_id(0) == 0) group_last = begin;
  barrier(CLK_LOCAL_MEM_FENCE);
  atomic_max(&group_last, last);
  barrier(CLK_LOCAL_MEM_FENCE);
  last = group_last;
#endif
#ifdef NO_EARLY_STOP
  last = end;
#endif

  for (int i = last + (int)get_local_id(0); i < end; i += ITEMS) {
    __global float *slot = slots + (size_t)SLOT_STRIDE * slot_from_sorted[i];
    for (int field = 0; field < SLOT_STRIDE; ++field) slot[field] = 0.0f;
  }

  for (int i = last - 1; i >= begin; --i) {
    PREFETCH(splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[max(i - AHEAD, begin)]);
    PREFETCH(slots + (size_t)SLOT_STRIDE * slot_from_sorted[max(i - AHEAD, begin)]);
    __global const float *splat = splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i];
    __global float *slot = slots + (size_t)SLOT_STRIDE * slot_from_sorted[i];
    int y0, y1, h0, h1;
    tile_box(splat, (float)tile_x, (float)tile_y, &y0, &y1, &h0, &h1);
    const float l11 = splat[SPLAT_L11], l12 = splat[SPLAT_L12], l22 = splat[SPLAT_L22];
    const float log2o = splat[SPLAT_LOG2O];
    const float c_red = splat[SPLAT_RED], c_green = splat[SPLAT_GREEN], c_blue = splat[SPLAT_BLUE];
    const float mx = FROM_TILE(splat, X, tile_x), my = FROM_TILE(splat, Y, tile_y);
    // (49), in (u, v) with y from the tile's centre row: u = uc - l12 y, v = vc - l22 y.
    const float uy = l12 * (my - CENTRE), vc = l22 * (my - CENTRE);
    const floatL zero = (floatL)(0.0f);
    floatL m0 = zero, m1 = zero, m2 = zero, mu = zero, mu1 = zero, muu = zero;
    floatL d_red = zero, d_green = zero, d_blue = zero;
#ifdef ABSOLUTE_GRADIENTS
    floatL abs_x = zero, abs_y = zero;
#endif
    FOR_PARTS(part) {
      const floatL offset_u = l11 * (mx - ((floatL)(part * LANES) + LANE_INDEX));
      floatL s0 = zero, s1 = zero, s2 = zero;
      FOR_ROWS(row, k, part) {
        const float dy = my - (float)row;
        const float v = l22 * dy;
        const floatL open = log2_alpha(offset_u, l12 * dy, fma1(-v, v, log2o));
        const floatL power = (intL)(i) < stop[k] ? open : (floatL)(FINISHED);
        if (REACHES(open, power)) {
          const floatL uncapped = power >= LOG2_ALPHA_MIN ? exp2L(power) : zero;
          const floatL alpha = uncapped < ALPHA_MAX ? uncapped : (floatL)(ALPHA_MAX);
          const floatL inverse = 1.0f / (1.0f - alpha);
          const floatL before = t[k] * inverse;
          const floatL shade = fmaL(g_red[k], (floatL)(c_red), fmaL(g_green[k], (floatL)(c_green), g_blue[k] * c_blue));
          const floatL weight = alpha * before;
          const floatL d_alpha = fmaL(before, shade, -(behind[k] * inverse));
          const floatL g = uncapped < ALPHA_MAX ? alpha * d_alpha : zero;
          behind[k] = fmaL(weight, shade, behind[k]);
          t[k] = before;
          d_red = fmaL(weight, g_red[k], d_red);
          d_green = fmaL(weight, g_green[k], d_green);
          d_blue = fmaL(weight, g_blue[k], d_blue);
          const float y = (float)row - CENTRE;
          const floatL gy = g * y;
          s0 += g;
          s1 += gy;
          s2 = fmaL(gy, (floatL)(y), s2);
#ifdef ABSOLUTE_GRADIENTS
          const floatL u = offset_u + l12 * dy;
          abs_x += fabs(g * (l11 * u));
          abs_y += fabs(g * fmaL((floatL)(l12), u, (floatL)(l22 * v)));
#endif
        }
      }
      const floatL uc = offset_u + uy;
      const floatL first = fmaL(uc, s0, -(l12 * s1));
      const floatL cross = fmaL(uc, s1, -(l12 * s2));
      m0 += s0;
      m1 += s1;
      m2 += s2;
      mu += first;
      mu1 += cross;
      muu += fmaL(uc, first, -(l12 * cross));
    }

    float values[SLOT_STRIDE];
    const float g = sumL(m0), g1 = sumL(m1), g2 = sumL(m2), gu = sumL(mu), gu1 = sumL(mu1);
    values[SLOT_G] = g;
    values[SLOT_GU] = gu;
    values[SLOT_GV] = fma1(vc, g, -(l22 * g1));
    values[SLOT_GUU] = sumL(muu);
    values[SLOT_GUV] = fma1(vc, gu, -(l22 * gu1));
    values[SLOT_GVV] = fma1(vc * vc, g, fma1(-2.0f * vc * l22, g1, l22 * l22 * g2));
    values[SLOT_RED] = sumL(d_red);
    values[SLOT_GREEN] = sumL(d_green);
    values[SLOT_BLUE] = sumL(d_blue);
#ifdef ABSOLUTE_GRADIENTS
    values[SLOT_ABSX] = sumL(abs_x);
    values[SLOT_ABSY] = sumL(abs_y);
#endif
#if ITEMS == 1
    for (int field = 0; field < SLOT_STRIDE; ++field) slot[field] = values[field];
#else
    group_sums(values, scratch, slot);
#endif
  }
}

// Kernels that measure a device's peak rates: blending, its gradient, and copying. `clsplat bench` compares the stages
// with these rates.
//
// Owner: A work-item owns OWNED cells of pixels, whose values are not stored; in limit_copy it owns COPIED elements.
// Launch: As many groups of ITEMS work-items as keep the device busy; limit_copy: one work-item for each COPIED
//   elements.
// Buffers: limit_blend, limit_blend_grad: splats (LIMIT_SPLATS, SPLAT_SIZE) in pixels -> sums (items), which keep
//     compilers from removing the arithmetic.
//   limit_copy: from (n) -> to (n).
// Equations: those of blend.cl and blend_grad.cl, without branches.
#define SUMS_OF_LANES // the bits of the sums do not matter
#include "shared/widened.h"
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/tile.h"
#include "shared/cells.h"
#include "shared/alpha.h"

#define LIMIT_SPLATS 64

// The arithmetic of blending without branches. Every Gaussian reaches every pixel, sums stay in registers, and splats
// stay in the nearest cache. Each item processes rounds * OWNED * LANES pairs of a Gaussian and a pixel.
GROUP __kernel void limit_blend(const int rounds, __global const float *splats, __global float *sums) {
  float sum = 0.0f;
  for (int k = 0; k < OWNED; ++k) {
    const floatL x = PIXELS_X(k), y = PIXELS_Y(k);
    floatL t = (floatL)(1.0f), red = (floatL)(0.0f), green = (floatL)(0.0f), blue = (floatL)(0.0f);
    for (int i = 0; i < rounds; ++i) {
      __global const float *splat = splats + SPLAT_SIZE * (i % LIMIT_SPLATS);
      const floatL dy = splat[SPLAT_PIXEL_Y] - y;
      const floatL u = whitened_u(splat[SPLAT_L11], splat[SPLAT_L12], splat[SPLAT_PIXEL_X] - x, dy);
      const floatL power = log2_alpha(u, splat[SPLAT_L22] * dy, splat[SPLAT_LOG2O]);
      floatL alpha = exp2L(power);
      alpha = alpha < ALPHA_MAX ? alpha : (floatL)(ALPHA_MAX);
      alpha = power >= LOG2_ALPHA_MIN ? alpha : (floatL)(0.0f);
      const floatL after = fmaL(-t, alpha, t);
      const floatL weight = after > TRANSMITTANCE_MIN ? t * alpha : (floatL)(0.0f);
      red = fmaL(weight, (floatL)(splat[SPLAT_RED]), red);
      green = fmaL(weight, (floatL)(splat[SPLAT_GREEN]), green);
      blue = fmaL(weight, (floatL)(splat[SPLAT_BLUE]), blue);
      t = after > TRANSMITTANCE_MIN ? after : t;
    }
    sum += sumL(red + green + blue + t);
  }
  sums[get_global_id(0)] = sum;
}

// The arithmetic of the gradient of blending without branches. For each of rounds * OWNED * LANES pairs of a Gaussian
// and a pixel, an item computes alpha, recovers the transmittance by division, and adds to the nine sums of a slot.
GROUP __kernel void limit_blend_grad(const int rounds, __global const float *splats, __global float *sums) {
  float sum = 0.0f;
  for (int k = 0; k < OWNED; ++k) {
    const floatL x = PIXELS_X(k), y = PIXELS_Y(k), zero = (floatL)(0.0f);
    const floatL g_red = 0.1f * x, g_green = 0.1f * y, g_blue = (floatL)(0.5f);
    floatL t = (floatL)(1e-4f), behind = zero, sums[SLOT_PLAIN];
    for (int field = 0; field < SLOT_PLAIN; ++field) sums[field] = zero;
    for (int i = 0; i < rounds; ++i) {
      __global const float *splat = splats + SPLAT_SIZE * (i % LIMIT_SPLATS);
      const floatL dy = splat[SPLAT_PIXEL_Y] - y;
      const floatL u = whitened_u(splat[SPLAT_L11], splat[SPLAT_L12], splat[SPLAT_PIXEL_X] - x, dy);
      const floatL v = splat[SPLAT_L22] * dy;
      const floatL power = log2_alpha(u, v, splat[SPLAT_LOG2O]);
      const floatL uncapped = power >= LOG2_ALPHA_MIN ? exp2L(power) : zero;
      const floatL alpha = uncapped < ALPHA_MAX ? uncapped : (floatL)(ALPHA_MAX);
      const floatL inverse = 1.0f / (1.0f - alpha);
      const floatL before = t * inverse;
      const floatL shade = fmaL(g_red, (floatL)(splat[SPLAT_RED]),
                                fmaL(g_green, (floatL)(splat[SPLAT_GREEN]), g_blue * splat[SPLAT_BLUE]));
      const floatL weight = alpha * before;
      const floatL d_alpha = fmaL(before, shade, -(behind * inverse));
      const floatL g = uncapped < ALPHA_MAX ? alpha * d_alpha : zero;
      behind = fmaL(weight, shade, behind);
      t = before < 1.0f ? before : (floatL)(1e-4f);
      sums[SLOT_RED] = fmaL(weight, g_red, sums[SLOT_RED]);
      sums[SLOT_GREEN] = fmaL(weight, g_green, sums[SLOT_GREEN]);
      sums[SLOT_BLUE] = fmaL(weight, g_blue, sums[SLOT_BLUE]);
      add_moments(g, u, v, sums);
    }
    for (int field = 0; field < SLOT_PLAIN; ++field) t += sums[field];
    sum += sumL(t);
  }
  sums[get_global_id(0)] = sum;
}

// Copies the array `from` (n) to the array `to` (n), COPIED elements (at least 16 bytes) per work-item. n is a multiple
// of COPIED.
#if LANES > 4
#define COPIED LANES
typedef floatL copied;
#else
#define COPIED 4
typedef float4 copied;
#endif
__kernel void limit_copy(const uint n, __global const copied *from, __global copied *to) {
  const uint i = get_global_id(0);
  if (i < n / COPIED) to[i] = from[i];
}

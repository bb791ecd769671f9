// What the device can do at most, in the terms of the pipeline: `clsplat bench` states each stage's share of it.
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/tile.h"
#include "shared/cells.h"
#include "shared/alpha.h"

#define LIMIT_SPLATS 64

// The arithmetic of blending, pair after pair with no branch: every Gaussian reaches every pixel, sums stay in registers
// and splats in the nearest cache. splats (LIMIT_SPLATS, SPLAT_SIZE) -> sums (items): keeps the work from being left
// out. Each item does rounds * OWNED * LANES pairs.
GROUP __kernel void limit_blend(const int rounds, __global const float *splats, __global float *sums) {
  float sum = 0.0f;
  for (int k = 0; k < OWNED; ++k) {
    const int vector = get_local_id(0) + k * ITEMS;
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

// from (n) -> to (n): LANES elements a work-item.
__kernel void limit_copy(const uint n, __global const float *from, __global float *to) {
  const uint i = get_global_id(0) * LANES;
  if (i + LANES <= n) STOREL(LOADL(from + i), to + i);
}

// Photographs by several cameras: gains and mixes of colours for each photograph, a vignette for each lens, taken from
// a photograph; their gradient. appearance.cl has Adam's step.
//
// Owner: A work-item owns a pixel (develop), or sixteen pixels below each other (camera_sums). Sums have one order on
//   every device. Built with one lane.
// Launch: Grids of stride x rows and stride x tiles_y.
// Buffers: Planes (3, rows, stride) of colour, or the loss by it; gains, logs (photographs, COLOURS): three gains, and
//   of logs six mixes behind them, for channel c those of c + 1 and c + 2, modulo 3; vignettes (lenses, VIGNETTE);
//   partials (COLOURS + VIGNETTE, tiles_y, stride). Shapes of the kernels are above each.
// Equations: docs/gradients.md, "Colours and vignettes".
#include "shared/math.h"
#include "shared/lanes.h"

#define COLOURS 9
#define VIGNETTE 3
#define MOST_FALLOFF 16.0f

// The squared distance of a pixel from (across, down), times scale.
static inline float spread(const int x, const int y, const float across, const float down, const float scale) {
  const float from_x = (float)x + 0.5f - across, from_y = (float)y + 0.5f - down;
  return fma1(from_x, from_x, from_y * from_y) * scale;
}

// gains, logs, vignettes, target -> target, the photograph as the model is to be seen.
__kernel void develop(const int photograph, const int lens, const int stride, const int plane, const float across,
                      const float down, const float scale, __global const float *gains, __global const float *logs,
                      __global const float *vignettes, __global float *target) {
  const int x = get_global_id(0), y = get_global_id(1);
  const size_t at = (size_t)stride * y + x;
  const float s = spread(x, y, across, down, scale);
  __global const float *vignette = vignettes + VIGNETTE * lens;
  const float falloff = s * fma1(s, fma1(s, vignette[2], vignette[1]), vignette[0]);
  const float lens_light = exp2L(clamp(falloff, -MOST_FALLOFF, MOST_FALLOFF));
  float light[3];
  for (int c = 0; c < 3; ++c)
    light[c] = target[(size_t)plane * c + at] / (gains[COLOURS * photograph + c] * lens_light);
  __global const float *mixes = logs + COLOURS * photograph + 3;
  for (int c = 0; c < 3; ++c) {
    float colour = light[c];
    for (int k = 0; k < 2; ++k) colour = fma1(mixes[2 * c + k], light[c] - light[(c + 1 + k) % 3], colour);
    target[(size_t)plane * c + at] = colour;
  }
}

// image, gradient by image -> partials of the gradient by gains and vignette, over ln 2, and by mixes.
__kernel void camera_sums(const int height, const int stride, const int plane, const int tiles_y, const float across,
                          const float down, const float scale, __global const float *image,
                          __global const float *gradient, __global float *partials) {
  const int x = get_global_id(0), y0 = get_global_id(1) * TILE, y1 = min(y0 + TILE, height);
  float sums[COLOURS + VIGNETTE];
  for (int k = 0; k < COLOURS + VIGNETTE; ++k) sums[k] = 0.0f;
  for (int y = y0; y < y1; ++y) {
    const size_t at = (size_t)stride * y + x;
    float colours[3], brighter = 0.0f;
    for (int c = 0; c < 3; ++c) colours[c] = image[(size_t)plane * c + at];
    for (int c = 0; c < 3; ++c) {
      const float g = gradient[(size_t)plane * c + at];
      sums[c] = fma1(colours[c], g, sums[c]);
      for (int k = 0; k < 2; ++k)
        sums[3 + 2 * c + k] = fma1(colours[(c + 1 + k) % 3] - colours[c], g, sums[3 + 2 * c + k]);
      brighter = fma1(colours[c], g, brighter);
    }
    const float s = spread(x, y, across, down, scale);
    float power = s;
    for (int k = 0; k < VIGNETTE; ++k, power *= s) sums[COLOURS + k] = fma1(power, brighter, sums[COLOURS + k]);
  }
  for (int k = 0; k < COLOURS + VIGNETTE; ++k)
    partials[((size_t)tiles_y * k + get_global_id(1)) * stride + x] = sums[k];
}

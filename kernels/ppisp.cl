// Photographs by several cameras: removes the gains and colour mixes of a photograph and the vignette of its lens, and
// computes the gradient with respect to these. appearance.cl updates them by Adam.
//
// Owner: A work-item owns LANES neighbouring pixels (develop), or LANES columns of a tile row (camera_sums). Sums are
//   added in the same order on every device, with any LANES and ITEMS.
// Launch: Grids of stride / LANES x rows and stride / LANES x tiles_y.
// Buffers: Planes (3, rows, stride) of colour, or the loss's gradient with respect to it; gains, logs (photographs,
//   COLOURS): three gains; in logs, six mixes follow, for each channel c from channels c + 1 and c + 2, modulo 3;
//   vignettes (lenses, VIGNETTE); partials (COLOURS + VIGNETTE, tiles_y, stride). Shapes are above each kernel.
// Equations: docs/gradients.md, "Colours and vignettes".
#include "shared/math.h"
#include "shared/lanes.h"

#define COLOURS 9
#define VIGNETTE 3
#define MOST_FALLOFF 16.0f

// Squared distances of pixels from (across, down), times scale.
static inline floatL spread(const int x, const int y, const float across, const float down, const float scale) {
  const floatL from_x = (floatL)((float)x + 0.5f) + LANE_INDEX - across;
  const float from_y = (float)y + 0.5f - down;
  return fmaL(from_x, from_x, (floatL)(from_y * from_y)) * scale;
}

// gains, logs, vignettes, target -> target: the photograph without them, to which the render is compared.
__kernel void develop(const int photograph, const int lens, const int stride, const int plane, const float across,
                      const float down, const float scale, __global const float *gains, __global const float *logs,
                      __global const float *vignettes, __global float *target) {
  const int x = LANES * get_global_id(0), y = get_global_id(1);
  const size_t at = (size_t)stride * y + x, next = plane + at, last = (size_t)plane * 2 + at;
  const floatL s = spread(x, y, across, down, scale);
  __global const float *vignette = vignettes + VIGNETTE * lens;
  const floatL falloff = s * fmaL(s, fmaL(s, (floatL)(vignette[2]), (floatL)(vignette[1])), (floatL)(vignette[0]));
  const floatL lens_light = exp2L(clamp(falloff, (floatL)(-MOST_FALLOFF), (floatL)(MOST_FALLOFF)));
  __global const float *gain = gains + COLOURS * photograph, *mix = logs + COLOURS * photograph + 3;
  const floatL r = LOADL(target + at) / (gain[0] * lens_light), g = LOADL(target + next) / (gain[1] * lens_light),
               b = LOADL(target + last) / (gain[2] * lens_light);
  STOREL(fmaL((floatL)(mix[1]), r - b, fmaL((floatL)(mix[0]), r - g, r)), target + at);
  STOREL(fmaL((floatL)(mix[3]), g - r, fmaL((floatL)(mix[2]), g - b, g)), target + next);
  STOREL(fmaL((floatL)(mix[5]), b - g, fmaL((floatL)(mix[4]), b - r, b)), target + last);
}

// image, gradient with respect to image -> partials: sums of the gradients with respect to gains and vignette, divided
// by ln 2, and with respect to mixes.
__kernel void camera_sums(const int height, const int stride, const int plane, const int tiles_y, const float across,
                          const float down, const float scale, __global const float *image,
                          __global const float *gradient, __global float *partials) {
  const int x = LANES * get_global_id(0), y0 = get_global_id(1) * TILE, y1 = min(y0 + TILE, height);
  const floatL zero = (floatL)(0.0f);
  floatL red = zero, green = zero, blue = zero, falloff1 = zero, falloff2 = zero, falloff3 = zero;
  floatL red_green = zero, red_blue = zero, green_blue = zero, green_red = zero, blue_red = zero, blue_green = zero;
  for (int y = y0; y < y1; ++y) {
    const size_t at = (size_t)stride * y + x, next = plane + at, last = (size_t)plane * 2 + at;
    const floatL r = LOADL(image + at), g = LOADL(image + next), b = LOADL(image + last);
    const floatL by_r = LOADL(gradient + at), by_g = LOADL(gradient + next), by_b = LOADL(gradient + last);
    red = fmaL(r, by_r, red), green = fmaL(g, by_g, green), blue = fmaL(b, by_b, blue);
    red_green = fmaL(g - r, by_r, red_green), red_blue = fmaL(b - r, by_r, red_blue);
    green_blue = fmaL(b - g, by_g, green_blue), green_red = fmaL(r - g, by_g, green_red);
    blue_red = fmaL(r - b, by_b, blue_red), blue_green = fmaL(g - b, by_b, blue_green);
    const floatL brighter = fmaL(b, by_b, fmaL(g, by_g, r * by_r)), s = spread(x, y, across, down, scale), s2 = s * s;
    falloff1 = fmaL(s, brighter, falloff1), falloff2 = fmaL(s2, brighter, falloff2);
    falloff3 = fmaL(s2 * s, brighter, falloff3);
  }
  const size_t of_sum = (size_t)tiles_y * stride;
  partials += (size_t)stride * get_global_id(1) + x;
  STOREL(red, partials), STOREL(green, partials + of_sum), STOREL(blue, partials + 2 * of_sum);
  STOREL(red_green, partials + 3 * of_sum), STOREL(red_blue, partials + 4 * of_sum);
  STOREL(green_blue, partials + 5 * of_sum), STOREL(green_red, partials + 6 * of_sum);
  STOREL(blue_red, partials + 7 * of_sum), STOREL(blue_green, partials + 8 * of_sum);
  STOREL(falloff1, partials + 9 * of_sum), STOREL(falloff2, partials + 10 * of_sum);
  STOREL(falloff3, partials + 11 * of_sum);
}

// Converts planes of blending, padded to whole tiles, to arrays of pixels with interleaved values, and gradients back.
//
// Owner: A work-item owns a pixel.
// Launch: One work-item for each pixel of the image, row by row, in groups of 64; work-items past the end do nothing.
// Buffers: pixels_from_planes: image (3, rows, stride), transmittance (rows, stride) -> pixels (height, width, depth),
//     of which at most the first three values of each pixel are written; alpha (height, width), 0 to 1.
//   planes_from_pixels: d_pixels (height, width, depth), with ALPHA_GRADIENT d_alpha (height, width) -> image_gradient
//     (3, rows, stride) of blend_grad.cl, 0 in planes for which there is no value; with ALPHA_GRADIENT a fourth plane,
//     the gradient with respect to the transmittance. Padding is not written.
// Equations: docs/gradients.md, (177).
#include "shared/layouts.h"

__kernel void pixels_from_planes(const int width, const int height, const int depth, const int stride,
                                 __global const float *image, __global const float *transmittance,
                                 __global float *pixels, __global float *alpha) {
  const int pixel = get_global_id(0);
  if (pixel >= width * height) return;
  const size_t plane = (size_t)stride * ((height + TILE - 1) / TILE * TILE);
  const size_t at = (size_t)stride * (pixel / width) + pixel % width;
  __global float *own = pixels + (size_t)depth * pixel;
  own[0] = image[at];
  if (depth > 1) own[1] = image[plane + at];
  if (depth > 2) own[2] = image[2 * plane + at];
  alpha[pixel] = 1.0f - transmittance[at];
}

__kernel void planes_from_pixels(const int width, const int height, const int depth, const int stride,
                                 __global const float *d_pixels,
#ifdef ALPHA_GRADIENT
                                 __global const float *d_alpha,
#endif
                                 __global float *image_gradient) {
  const int pixel = get_global_id(0);
  if (pixel >= width * height) return;
  const size_t plane = (size_t)stride * ((height + TILE - 1) / TILE * TILE);
  const size_t at = (size_t)stride * (pixel / width) + pixel % width;
  __global const float *own = d_pixels + (size_t)depth * pixel;
  image_gradient[at] = own[0];
  image_gradient[plane + at] = depth > 1 ? own[1] : 0.0f;
  image_gradient[2 * plane + at] = depth > 2 ? own[2] : 0.0f;
#ifdef ALPHA_GRADIENT
  image_gradient[3 * plane + at] = -d_alpha[pixel];
#endif
}

// The depth loss and its gradient with respect to the render's nearness N = 1 / depth. The loss is a factor times the
// sum of weight * |N - aim| over the pixels, where `aim` is the known nearness.
//
// Owner: A work-item owns TILE pixels of a column.
// Launch: A grid of stride x rows / TILE work-items.
// Buffers: stops (rows, stride) of blend.cl, negative in padding and, after target.cl, in masked pixels. rows is the
//     argument `height`, padded to whole tiles.
//   nearness (rows, stride): in 1 / world units.
//   aims (2, rows, stride): target nearness, and weight, which is 0 where the target is unknown.
//   factor: multiplies the gradient.
//   -> gradient: plane number `gradient_plane` (rows, stride), 0 where the target is unknown or `stops` is negative;
//     sums (rows / TILE, stride) of weight * |N - aim|, from index first_sum on.
// Equations: docs/gradients.md, (121).
#include "shared/math.h"

__kernel void depth_loss(const int stride, const int height, const int gradient_plane, const int first_sum,
                         const float factor, __global const int *stops, __global const float *nearness,
                         __global const float *aims, __global float *gradient, __global float *sums) {
  const int x = get_global_id(0), block = get_global_id(1);
  if (x >= stride || block * TILE >= height) return;
  float sum = 0.0f;
  const size_t plane = (size_t)stride * height;
  for (int row = 0; row < TILE; ++row) {
    const size_t at = (size_t)stride * (block * TILE + row) + x;
    const float weight = stops[at] >= 0 ? aims[plane + at] : 0.0f;
    float by_nearness = 0.0f;
    if (weight > 0.0f) {
      const float difference = nearness[at] - aims[at];
      by_nearness = difference > 0.0f ? factor * weight : (difference < 0.0f ? -factor * weight : 0.0f);
      sum += weight * fabs(difference);
    }
    gradient[gradient_plane * plane + at] = by_nearness;
  }
  sums[(size_t)first_sum + (size_t)stride * block + x] = sum;
}

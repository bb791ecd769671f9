// The alpha loss and its gradient with respect to the render's transmittance T. The loss is a weight times the mean of
// |A - alpha| over the pixels that no mask excludes, where A = 1 - T is the render's alpha and `alpha` the
// photograph's.
//
// Owner: A work-item owns TILE pixels of a column.
// Launch: A grid of stride x rows / TILE work-items.
// Buffers: stops (rows, stride) of blend.cl, negative in padding and, after target.cl, in masked pixels. rows is the
//     argument `height`, padded to whole tiles.
//   transmittance, alpha (rows, stride).
//   scale: the weight divided by the number of pixels that no mask excludes.
//   -> gradient (rows, stride) with respect to the transmittance, 0 where `stops` is negative; sums (rows / TILE,
//     stride) of |A - alpha|, from index first_sum on.
//   alpha and gradient are the fourth planes of their buffers, after the colours.
// Equations: docs/gradients.md, (81).
#include "shared/math.h"

__kernel void alpha_loss(const int stride, const int height, const int first_sum, const float scale,
                         __global const int *stops, __global const float *transmittance, __global const float *alpha,
                         __global float *gradient, __global float *sums) {
  const int x = get_global_id(0), block = get_global_id(1);
  if (x >= stride || block * TILE >= height) return;
  float sum = 0.0f;
  const size_t plane = (size_t)stride * height;
  for (int row = 0; row < TILE; ++row) {
    const size_t at = (size_t)stride * (block * TILE + row) + x;
    float by_t = 0.0f;
    if (stops[at] >= 0) {
      const float difference = (1.0f - transmittance[at]) - alpha[3 * plane + at];
      by_t = difference > 0.0f ? -scale : (difference < 0.0f ? scale : 0.0f);
      sum += fabs(difference);
    }
    gradient[3 * plane + at] = by_t;
  }
  sums[(size_t)first_sum + (size_t)stride * block + x] = sum;
}

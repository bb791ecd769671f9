// Sums along the rows of an array, in the same order on every device. Gradients with respect to a camera are summed
// over Gaussians in this way.
//
// Owner: A work-item owns SUM_ROWS adjacent numbers of a row.
// Launch: One work-item for each SUM_ROWS numbers of each row, in groups of 64; work-items past the end do nothing.
// Buffers: parts (rows, padded): padded is a multiple of SUM_ROWS.
//   -> sums (rows, stride): stride is at least padded / SUM_ROWS; elements from padded / SUM_ROWS on are zero in each
//     row.
// Equations: docs/gradients.md, section 23.
#include "shared/math.h"

__kernel void row_sums(const uint rows, const uint padded, const uint stride, __global const float *parts,
                       __global float *sums) {
  const uint item = get_global_id(0), row = item / stride, place = item % stride;
  if (row >= rows) return;
  float sum = 0.0f;
  if (place < padded / SUM_ROWS) {
    __global const float *part = parts + (size_t)row * padded + (size_t)SUM_ROWS * place;
    float8 eight = (float8)(0.0f);
    for (uint k = 0; k < SUM_ROWS / 8; ++k) eight += *(__global const float8 *)(part + 8 * k);
    const float4 four = eight.lo + eight.hi;
    const float2 two = four.lo + four.hi;
    sum = two.x + two.y;
  }
  sums[item] = sum;
}

// Bounds of a model's chunks: the axis-aligned box of each chunk's means, and its largest log scale.
//
// Owner: A group owns a chunk. Each item reads every ITEMS-th row of it; the first BOUNDS items then combine the
//   results of all items.
// Launch: Groups of ITEMS items, one for each entry of `chunks`.
// Buffers: chunks (entries): numbers of chunks.
//   means, log_scales (model_rows, 3).
//   -> bounds (entries, BOUNDS): least and greatest coordinates of the means, and the greatest log scale. NaN is
//     ignored, because a Gaussian with NaN is never drawn. A chunk with only NaN has an empty box, from INFINITY to
//     -INFINITY.
// Equations: none.
#include "shared/math.h"

#define BOUNDS 7
__kernel void bounds(__global const uint *chunks, const uint model_rows, __global const float *means,
                     __global const float *log_scales, __global float *bounds) {
  const uint place = get_group_id(0), me = get_local_id(0);
  const size_t first = (size_t)CHUNK_ROWS * chunks[place];
  const uint rows = first < model_rows ? (uint)min((size_t)CHUNK_ROWS, model_rows - first) : 0;
  float found[BOUNDS];
  for (int k = 0; k < 3; ++k) found[k] = INFINITY, found[3 + k] = -INFINITY;
  found[6] = -INFINITY;
  for (uint i = me; i < rows; i += ITEMS) {
    for (int k = 0; k < 3; ++k) {
      const float mean = means[3 * (first + i) + k];
      found[k] = fmin(found[k], mean);
      found[3 + k] = fmax(found[3 + k], mean);
      found[6] = fmax(found[6], log_scales[3 * (first + i) + k]);
    }
  }
#if ITEMS > 1
  __local float by_item[BOUNDS * ITEMS];
  for (int k = 0; k < BOUNDS; ++k) by_item[k * ITEMS + me] = found[k];
  barrier(CLK_LOCAL_MEM_FENCE);
  if (me < BOUNDS) {
    float one = by_item[me * ITEMS];
    for (uint i = 1; i < ITEMS; ++i)
      one = me < 3 ? fmin(one, by_item[me * ITEMS + i]) : fmax(one, by_item[me * ITEMS + i]);
    bounds[BOUNDS * (size_t)place + me] = one;
  }
#else
  for (int k = 0; k < BOUNDS; ++k) bounds[BOUNDS * (size_t)place + k] = found[k];
#endif
}

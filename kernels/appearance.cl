// Updates the appearance of photographs by Adam: the gains and colour mixes of photographs, or the vignettes of lenses.
// The gradients come from the partial sums of shared/develop.h.
//
// Owner: A work-item owns a column of the partial sums (column_sums), one entry of one photograph or lens (move_gains,
//   centre_gains), or one entry of SUMMED photographs (change_sums). Every device adds the sums in the same order.
//   Built with one lane.
// Launch: A grid of stride x sums work-items (column_sums); one work-item for each of the `count` entries (move_gains,
//   centre_gains); a grid of entries x ceil(photographs / SUMMED) work-items (change_sums).
// Buffers: logs (photographs, entries): the first three entries are base-2 logs of gains, the rest are colour mixes
//     (ppisp.cl). For vignettes, a row is a lens with three coefficients.
//   Of the same shape: `start`, the initial logs; `first` and `second`, Adam's moments; `moved`, the logs before
//     centring; `gains`, 2^logs.
//   changes (ceil(photographs / SUMMED), entries): sums of moved - start.
//   begins (photographs + 1), others, weights: a sparse matrix in CSR form, which pulls gains towards `start`.
//   partials (sums, tiles_y, stride), columns (sums, stride): partial sums of the gradient. The sums of these entries
//     begin at row `at` of `columns`.
// Equations: docs/gradients.md, "Appearance".
#include "shared/math.h"
#include "shared/lanes.h"

#define MOST_LOG 16.0f
#define MOST_MIX 0.2f // limit of |mix|; below it the matrix of six mixes is invertible
#define SUMMED 256    // photographs whose changes a work-item sums

// Adds the partial sums over the rows of tiles: partials -> columns.
__kernel void column_sums(const int stride, const int tiles_y, __global const float *partials,
                          __global float *columns) {
  const int x = get_global_id(0), c = get_global_id(1);
  float sum = 0.0f;
  for (int tile = 0; tile < tiles_y; ++tile) sum += partials[((size_t)tiles_y * c + tile) * stride + x];
  columns[(size_t)stride * c + x] = sum;
}

// Takes a step of Adam on the entries of all photographs. Only the entries of `photograph` get a gradient from columns;
// the loss's gradient with respect to all other entries is 0. columns, logs, start, begins, others, weights -> moved:
// the new logs before centring; first and second change in place. The learning rate of mixes is `slow` times `rate`.
__kernel void move_gains(const int count, const int entries, const int photograph, const int stride, const int at,
                         const float rate, const float slow, const float root, const float beta1, const float beta2,
                         const float epsilon, __global const uint *readback, __global const float *columns,
                         __global const float *start, __global const int *begins, __global const int *others,
                         __global const float *weights, __global const float *logs, __global float *moved,
                         __global float *first, __global float *second) {
  const int i = get_global_id(0), c = i % entries;
  if (i >= count || readback[READBACK_STOPPED]) return;
  float g = 0.0f;
  if (i / entries == photograph)
    for (int x = 0; x < stride; ++x) g = added(g, columns[(size_t)stride * (at + c) + x]);
  if (c < 3) g *= LN2;
  const int begin = begins[photograph], end = begins[photograph + 1];
  if (i / entries == photograph && end > begin) {
    // apart: the sum of (logs - start) over the photographs with a row in the sparse matrix, whose gains are pulled
    // towards `start`; told: the number of these photographs.
    float told = 0.0f, apart = 0.0f, pull = 0.0f;
    for (int k = 0; entries * k < count; ++k)
      if (begins[k + 1] > begins[k]) told += 1.0f, apart = added(apart, logs[entries * k + c] - start[entries * k + c]);
    for (int k = begin; k < end; ++k) {
      const int j = entries * others[k] + c;
      pull = fma1(weights[k], logs[j] - start[j] - apart / told, pull);
    }
    g = added(g, pull);
  }
  if (!(g * g < INFINITY)) g = 0.0f; // a gradient that is not finite counts as 0
  const float m = fma1(beta1, first[i], (1.0f - beta1) * g), v = fma1(beta2, second[i], (1.0f - beta2) * (g * g));
  first[i] = m, second[i] = v;
  moved[i] = logs[i] - (c < 3 ? rate : slow * rate) * m / fma1(sqrt(v), root, epsilon);
}

// Sums the changes of each entry since the start over SUMMED photographs: moved, start -> changes.
__kernel void change_sums(const int count, const int entries, __global const float *start, __global const float *moved,
                          __global float *changes) {
  const int c = get_global_id(0), group = get_global_id(1);
  const int begin = group * SUMMED * entries + c, end = min(begin + SUMMED * entries, count);
  float sum = 0.0f;
  for (int k = begin; k < end; k += entries) sum += moved[k] - start[k];
  changes[group * entries + c] = sum;
}

// Shifts each entry so that its mean over the photographs is the mean of `start`, and then limits the entries: moved,
// and `groups` rows of changes -> logs; gains: 2^logs. groups is 0 if nothing is shifted.
__kernel void centre_gains(const int count, const int entries, const int groups, __global const uint *readback,
                           __global const float *changes, __global const float *moved, __global float *logs,
                           __global float *gains) {
  const int i = get_global_id(0), c = i % entries;
  if (i >= count || readback[READBACK_STOPPED]) return;
  float sum = 0.0f;
  for (int k = 0; k < groups; ++k) sum += changes[k * entries + c];
  const float most = c < 3 ? MOST_LOG : MOST_MIX;
  const float x = clamp(moved[i] - (float)entries * sum / (float)count, -most, most);
  logs[i] = x;
  gains[i] = exp2L(x);
}

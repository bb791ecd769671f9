// Exposure and white balance of photographs: a gain for each channel, its gradient, and Adam's step.
//
// Owner: A work-item owns a pixel (remove_gains), sixteen pixels below each other (gain_sums), a column of these
//   (column_sums), or one gain of one photograph (move_gains, centre_gains). Sums have one order on every device.
//   Built with one lane.
// Launch: Grids of stride x rows, stride x tiles_y and stride x 3; a work-item for each of the `count` gains.
// Buffers: Planes (3, rows, stride) of colour, or the loss by it; logs, start, first, second, moved, gains
//   (photographs, 3), logs to base 2; begins (photographs + 1), others, weights: rows of a sparse matrix; partials
//   (3, tiles_y, stride); columns (3, stride). Shapes of the kernels are above each.
// Equations: docs/gradients.md, "Appearance".
#include "shared/math.h"
#include "shared/lanes.h"

#define MOST_LOG 16.0f

// gains, target -> target, the photograph, exposed as the model is.
__kernel void remove_gains(const int photograph, const int stride, const int plane, __global const float *gains,
                           __global float *target) {
  const size_t at = (size_t)stride * get_global_id(1) + get_global_id(0);
  for (int c = 0; c < 3; ++c) target[(size_t)plane * c + at] /= gains[3 * photograph + c];
}

// image, gradient by image -> partials of the gradient by logs over ln 2.
__kernel void gain_sums(const int height, const int stride, const int plane, const int tiles_y,
                        __global const float *image, __global const float *gradient, __global float *partials) {
  const int x = get_global_id(0), y0 = get_global_id(1) * TILE, y1 = min(y0 + TILE, height);
  for (int c = 0; c < 3; ++c) {
    float sum = 0.0f;
    for (int y = y0; y < y1; ++y) {
      const size_t at = (size_t)plane * c + (size_t)stride * y + x;
      sum = fma1(image[at], gradient[at], sum);
    }
    partials[((size_t)tiles_y * c + get_global_id(1)) * stride + x] = sum;
  }
}

// partials -> columns.
__kernel void column_sums(const int stride, const int tiles_y, __global const float *partials,
                          __global float *columns) {
  const int x = get_global_id(0), c = get_global_id(1);
  float sum = 0.0f;
  for (int tile = 0; tile < tiles_y; ++tile) sum += partials[((size_t)tiles_y * c + tile) * stride + x];
  columns[(size_t)stride * c + x] = sum;
}

// columns of one photograph, logs, start, begins, others, weights -> moved; first and second in place. All
// photographs move: the others' gradient is 0.
__kernel void move_gains(const int count, const int photograph, const int stride, const float rate, const float root,
                         const float beta1, const float beta2, const float epsilon, __global const uint *readback,
                         __global const float *columns, __global const float *start, __global const int *begins,
                         __global const int *others, __global const float *weights, __global const float *logs,
                         __global float *moved, __global float *first, __global float *second) {
  const int i = get_global_id(0), c = i % 3;
  if (i >= count || readback[READBACK_STOPPED]) return;
  float g = 0.0f;
  if (i / 3 == photograph)
    for (int x = 0; x < stride; ++x) g = added(g, columns[(size_t)stride * c + x]);
  g *= LN2;
  const int begin = begins[photograph], end = begins[photograph + 1];
  if (i / 3 == photograph && end > begin) {
    float told = 0.0f, apart = 0.0f, pull = 0.0f; // the mean of all that are pulled is nobody's to hold
    for (int k = 0; 3 * k < count; ++k)
      if (begins[k + 1] > begins[k]) told += 1.0f, apart = added(apart, logs[3 * k + c] - start[3 * k + c]);
    for (int k = begin; k < end; ++k) {
      const int j = 3 * others[k] + c;
      pull = fma1(weights[k], logs[j] - start[j] - apart / told, pull);
    }
    g = added(g, pull);
  }
  if (!(g * g < INFINITY)) g = 0.0f; // of a view with something that is not finite nothing is learnt
  const float m = fma1(beta1, first[i], (1.0f - beta1) * g), v = fma1(beta2, second[i], (1.0f - beta2) * (g * g));
  first[i] = m, second[i] = v;
  moved[i] = logs[i] - rate * m / fma1(sqrt(v), root, epsilon);
}

// moved -> logs, of which each channel has the mean 0; gains.
__kernel void centre_gains(const int count, __global const uint *readback, __global const float *moved,
                           __global float *logs, __global float *gains) {
  const int i = get_global_id(0);
  if (i >= count || readback[READBACK_STOPPED]) return;
  float sum = 0.0f;
  for (int k = i % 3; k < count; k += 3) sum += moved[k];
  const float x = clamp(moved[i] - 3.0f * sum / (float)count, -MOST_LOG, MOST_LOG);
  logs[i] = x;
  gains[i] = exp2L(x);
}

// Adam on one parameter group, from gradients in memory. Usually Adam is fused into project_grad.cl. These kernels are
// for steps that need the gradients in memory, for example to add up the views of a batch.
//
// adam and adam_visible also set the gradients to zero for the next step, because project_grad writes only the rows of
// visible Gaussians.
//
// With CHUNKS (shared/chunks.h) the gradients in adam, and the gradients and tile_counts in add_view, have the rows of
// the launch, which are rows of listed chunks.
//
// Owner: A work-item owns ABREAST (shared/adam.h) consecutive elements in adam, ABREAST rows in adam_visible, and one
//   element in add_view.
// Launch: One work-item for each ABREAST elements, ABREAST rows or element, in groups of 64; work-items past the end do
//   nothing.
// Buffers: A parameter group in its own units, its gradients, its moments `first` and `second`; `readback`
//   (READBACK_SIZE) counts the elements whose update is refused. The scalars are fields of Step (shared/adam.h). Shapes
//   are above each kernel.
// Equations: docs/gradients.md, (42).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/adam.h"
#include "shared/chunks.h"

// Updates a parameter group as a flat array, ABREAST elements per work-item. parameters, gradients, first, second (n);
// with CHUNKS, gradients (n), and rows of WIDTH floats of the other arrays. With SPARSE (OptimiserConfig.sparse)
// elements whose gradient is zero do not change.
__kernel void adam(const ulong n, const float rate, const float root, const float beta1, const float beta2,
                   const float epsilon, const float limit2, __global uint *readback, __global float *parameters,
                   __global float *gradients, __global float *first, __global float *second CHUNK_PARAMETERS) {
  const Step s = {rate, root, beta1, beta2, epsilon, limit2, readback};
  const ulong i = get_global_id(0) * (ulong)ABREAST;
#ifdef CHUNKS // elements are in one chunk, because CHUNK_ROWS is a multiple of ABREAST
  if (i >= n) return;
  const uint row = i / WIDTH;
  const long ahead = rows_ahead(chunks, row);
  const ulong end = (ulong)WIDTH * end_of_rows(row, n / WIDTH, ahead, model_rows);
  const Stepped model = {parameters + WIDTH * ahead, first + WIDTH * ahead, second + WIDTH * ahead};
#else
  const ulong end = n;
  const Stepped model = {parameters, first, second};
#endif
  if (i + ABREAST <= end) {
    const floatA g = LOADA(gradients + i);
#ifdef SPARSE
    const intA taken = g != 0.0f;
    if (!ANYA(taken)) return;
#else
    const intA taken = (intA)(-1);
#endif
    if (step_vector(i, g, taken, s, model)) {
      STOREA((floatA)(0.0f), gradients + i);
      return;
    }
  }
  for (ulong k = i; k < min(i + (ulong)ABREAST, end); ++k) {
#ifdef SPARSE
    if (gradients[k] == 0.0f) continue;
#endif
    step_element(k, gradients[k], s, model);
    gradients[k] = 0.0f;
  }
}

#ifdef WIDTH
// Updates only the rows of visible Gaussians (OptimiserConfig.late), ABREAST rows per work-item. The gradients of
// invisible Gaussians are zero. tile_counts (n): 0 for an invisible Gaussian; parameters, gradients, first, second (n,
// WIDTH).
__kernel void adam_visible(const uint n, const float rate, const float root, const float beta1, const float beta2,
                           const float epsilon, const float limit2, __global uint *readback,
                           __global const uint *tile_counts, __global float *parameters, __global float *gradients,
                           __global float *first, __global float *second) {
  const Step s = {rate, root, beta1, beta2, epsilon, limit2, readback};
  const Stepped model = {parameters, first, second};
  const uint row = get_global_id(0) * ABREAST;
  if (row >= n) return;
  int visible[ABREAST], some = 0;
  for (uint lane = 0; lane < ABREAST; ++lane) {
    visible[lane] = row + lane < n && tile_counts[row + lane] > 0 ? -1 : 0;
    some |= visible[lane];
  }
  if (!some) return;
  const size_t begin = (size_t)row * WIDTH, end = (size_t)n * WIDTH;
  for (uint k = 0; k < WIDTH; ++k) {
    const size_t i = begin + k * ABREAST;
    union {
      intA all;
      int lane[ABREAST];
    } taken;
    for (uint lane = 0; lane < ABREAST; ++lane) taken.lane[lane] = visible[(k * ABREAST + lane) / WIDTH];
    if (n - row >= ABREAST && step_vector(i, LOADA(gradients + i), taken.all, s, model)) {
      STOREA((floatA)(0.0f), gradients + i);
      continue;
    }
    for (uint lane = 0; lane < ABREAST && i + lane < end; ++lane)
      if (taken.lane[lane]) {
        step_element(i + lane, gradients[i + lane], s, model);
        gradients[i + lane] = 0.0f;
      }
  }
}

// Adds a view's gradients to the sums over earlier views of the batch, one element per work-item. It does not read the
// gradients of Gaussians that are invisible in the view. tile_counts (n / WIDTH): 0 for an invisible Gaussian;
// gradients, sums (n); with CHUNKS, `chunks` has the places of the view's chunks in `sums`.
__kernel void add_view(const ulong n, __global const uint *tile_counts, __global const float *gradients,
                       __global float *sums CHUNK_PARAMETERS) {
  const size_t i = get_global_id(0);
  if (i >= n || tile_counts[i / WIDTH] == 0) return;
#ifdef CHUNKS
  sums += WIDTH * rows_ahead(chunks, i / WIDTH);
#endif
  sums[i] += gradients[i];
}
#endif

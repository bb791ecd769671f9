// Adam on one parameter group. It leaves the gradient zero, so that the next step need only write the rows of visible
// Gaussians.
//
// Owner: A work-item owns LANES elements that follow each other (adam), or LANES rows (adam_visible).
// Launch: One work-item for each such piece, in groups of 64; those beyond the last piece do nothing.
// Buffers: The group's parameters in its own units, their gradients, the moments `first` and `second`; `readback`
//   (READBACK_SIZE) counts. Scalars: rate is the learning rate / (1 - beta1^t), root is 1 / sqrt(1 - beta2^t). Shapes
//   are above each kernel.
// Equations: docs/gradients.md, (42); Kingma and Ba 2015, algorithm 1.
//
// No parameter and no moment becomes NaN or infinite here. An element is left as it is where its new values would be,
// or where its parameter's square would not be less than `limit2`. It is counted in the last four of `readback`, of
// which compact_visible has the first four: by the parameter that it had, its gradient, its moments, or all of these
// well and the step not. Moments that are broken begin again from zero. In the other cases the second moment becomes
// infinite and the first 0, which refuses every step until the host has seen to the row
// (docs/decisions/0016-never-a-nan.md).
#include "shared/math.h"
#include "shared/lanes.h"

// What to subtract from a vector of parameters; *m and *v become the new moments.
static inline floatL change(floatL g, float rate, float root, float beta1, float beta2, float epsilon, floatL *m,
                            floatL *v) {
  *m = fmaL((floatL)(beta1), *m, (1.0f - beta1) * g);
  *v = fmaL((floatL)(beta2), *v, (1.0f - beta2) * (g * g));
  return rate * *m / fmaL(sqrt(*v), (floatL)(root), (floatL)(epsilon));
}

// True if new values may be stored. A second moment is a square as well, so that the sum is one test of both.
#ifdef UNGUARDED
#define WELL(parameter, second) ((intL)(-1))
#else
#define WELL(parameter, second) MASKL(fmaL(parameter, parameter, second) < limit2)
#endif

// What becomes of an element whose step is refused: p, g, m and v as they were before it.
static inline void refuse(size_t i, float limit2, float p, float g, float m, float v, __global float *first,
                          __global float *second, __global uint *readback) {
  const int parameter = p * p < limit2, gradient = fabs(g) < INFINITY;
  const int moments = fabs(m) < INFINITY && v >= 0.0f && v < INFINITY, marked = m == 0.0f && v == INFINITY;
  const int again = parameter && gradient && !moments && !marked;
  first[i] = 0.0f;
  second[i] = again ? 0.0f : INFINITY;
  atomic_inc(readback + (!parameter  ? READBACK_REFUSED_PARAMETERS
                         : !gradient ? READBACK_REFUSED_GRADIENTS
                         : again     ? READBACK_REFUSED_MOMENTS
                                     : READBACK_REFUSED_STEPS));
}

// The step of one element, by `change`.
static inline void step_element(size_t i, float rate, float root, float beta1, float beta2, float epsilon, float limit2,
                                __global uint *readback, __global float *parameters, __global float *gradients,
                                __global float *first, __global float *second) {
  const float g = gradients[i];
  const float m = fma1(beta1, first[i], (1.0f - beta1) * g);
  const float v = fma1(beta2, second[i], (1.0f - beta2) * (g * g));
  const float p = parameters[i] - rate * m / fma1(sqrt(v), root, epsilon);
  gradients[i] = 0.0f;
#ifndef UNGUARDED
  if (!(fma1(p, p, v) < limit2)) {
    refuse(i, limit2, parameters[i], g, first[i], second[i], first, second, readback);
    return;
  }
#endif
  first[i] = m;
  second[i] = v;
  parameters[i] = p;
}

// The group as a flat array, LANES elements a work-item. parameters, gradients, first, second (n).
__kernel void adam(const ulong n, const float rate, const float root, const float beta1, const float beta2,
                   const float epsilon, const float limit2, __global uint *readback, __global float *parameters,
                   __global float *gradients, __global float *first, __global float *second) {
  const ulong i = get_global_id(0) * (ulong)LANES;
  if (i + LANES <= n) {
    floatL m = LOADL(first + i), v = LOADL(second + i);
    const floatL by = change(LOADL(gradients + i), rate, root, beta1, beta2, epsilon, &m, &v);
    const floatL p = LOADL(parameters + i) - by;
    if (!ANYL(~WELL(p, v))) {
      STOREL(m, first + i);
      STOREL(v, second + i);
      STOREL(p, parameters + i);
      STOREL((floatL)(0.0f), gradients + i);
      return;
    }
  }
  for (ulong k = i; k < min(i + LANES, n); ++k)
    step_element(k, rate, root, beta1, beta2, epsilon, limit2, readback, parameters, gradients, first, second);
}

#ifdef WIDTH
// Only the rows of visible Gaussians, LANES rows a work-item (OptimiserConfig.sparse); gradients of the others are zero
// already. tile_counts (n): 0 where hidden; parameters, gradients, first, second (n, WIDTH).
__kernel void adam_visible(const uint n, const float rate, const float root, const float beta1, const float beta2,
                           const float epsilon, const float limit2, __global uint *readback,
                           __global const uint *tile_counts, __global float *parameters, __global float *gradients,
                           __global float *first, __global float *second) {
  const uint row = get_global_id(0) * LANES;
  if (row >= n) return;
  int visible[LANES], some = 0;
  for (uint lane = 0; lane < LANES; ++lane) {
    visible[lane] = row + lane < n && tile_counts[row + lane] > 0 ? -1 : 0;
    some |= visible[lane];
  }
  if (!some) return;
  const size_t begin = (size_t)row * WIDTH, end = (size_t)n * WIDTH;
  if (n - row < LANES) {
    for (size_t i = begin; i < end; ++i)
      if (visible[(i - begin) / WIDTH])
        step_element(i, rate, root, beta1, beta2, epsilon, limit2, readback, parameters, gradients, first, second);
    return;
  }
  for (uint k = 0; k < WIDTH; ++k) {
    const size_t i = begin + k * LANES;
    IntLanes taken;
    for (uint lane = 0; lane < LANES; ++lane) taken.lane[lane] = visible[(k * LANES + lane) / WIDTH];
    const floatL m_before = LOADL(first + i), v_before = LOADL(second + i);
    floatL m = m_before, v = v_before;
    const floatL by = change(LOADL(gradients + i), rate, root, beta1, beta2, epsilon, &m, &v);
    const floatL p = LOADL(parameters + i) - (taken.all ? by : (floatL)(0.0f));
    if (ANYL(~WELL(p, v) & taken.all)) {
      for (uint lane = 0; lane < LANES; ++lane)
        if (taken.lane[lane])
          step_element(i + lane, rate, root, beta1, beta2, epsilon, limit2, readback, parameters, gradients, first,
                       second);
      continue;
    }
    STOREL(taken.all ? m : m_before, first + i);
    STOREL(taken.all ? v : v_before, second + i);
    STOREL(p, parameters + i);
    STOREL((floatL)(0.0f), gradients + i);
  }
}
#endif

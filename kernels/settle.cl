// Late Adam (optimiser.late): takes the steps of Adam that Gaussians missed while no view showed them. In these steps
// the gradients are zero. So the moments decay by powers of beta1 and beta2, and parameters move along m / (sqrt(v) +
// epsilon), by a factor that is the same for all elements of a parameter group.
//
// Owner: A work-item owns a Gaussian. Built with one lane; LANES and ITEMS do not change its bits.
// Launch: One work-item for each Gaussian, in groups of 64; work-items past the end do nothing.
// Buffers: last (n): the last step that a Gaussian took, at most `step`; the kernel sets it to `mark`.
//   tile_counts (n), with VISIBLE: rows with a tile count of 0 do not change.
//   missed (MOST_MISSED + 1, 6, 3): the factors of (190) and (191), by the number of missed steps up to `step` and by
//     parameter group.
//   Parameters and their moments `first` and `second`: updated in place.
//   readback (READBACK_SIZE): after a stopped pass (duplicate.cl) nothing changes.
// Equations: docs/gradients.md, (190) to (192).
#include "shared/math.h"

// Number of factors of a parameter group, one each for m / (sqrt(v) + epsilon), for the first moment m and for the
// second moment v.
#define FACTORS 3
#define GROUPS 6

// Takes the missed steps of a row of `width` floats. If a new parameter would not be finite, or would be too large, the
// old one stays. The row's next step of Adam then refuses and counts the element.
static inline void settle_row(const size_t row, const uint width, __global const float *factors, const float epsilon,
                              const float limit2, __global float *parameters, __global float *first,
                              __global float *second) {
  const float drift = factors[0], decay1 = factors[1], decay2 = factors[2];
  for (size_t i = row * width; i < (row + 1) * width; ++i) {
    const float before = parameters[i], m = first[i], v = second[i];
    const float p = before - drift * (m / (sqrt(v) + epsilon));
    parameters[i] = p * p < limit2 ? p : before;
    first[i] = decay1 * m;
    second[i] = decay2 * v;
  }
}

__kernel void settle(const uint n, const uint sh_width, const uint step, const uint mark, const float epsilon,
                     const float limit2, const float limit2_sh, __global const uint *readback,
#ifdef VISIBLE
                     __global const uint *tile_counts,
#endif
                     __global uint *last, __global const float *missed, __global float *means,
                     __global float *quaternions, __global float *log_scales, __global float *opacity_logits,
                     __global float *sh_dc, __global float *sh_rest, __global float *first_means,
                     __global float *first_quaternions, __global float *first_log_scales,
                     __global float *first_opacity_logits, __global float *first_sh_dc, __global float *first_sh_rest,
                     __global float *second_means, __global float *second_quaternions,
                     __global float *second_log_scales, __global float *second_opacity_logits,
                     __global float *second_sh_dc, __global float *second_sh_rest) {
  const size_t row = get_global_id(0);
  if (row >= n || readback[READBACK_STOPPED]) return;
#ifdef VISIBLE
  if (tile_counts[row] == 0) return;
#endif
  const uint from = last[row];
  last[row] = mark;
  if (step <= from) return;
  __global const float *factors = missed + (size_t)GROUPS * FACTORS * (step - from);
#define SETTLE(number, group, width, limit)                                                                            \
  settle_row(row, width, factors + number * FACTORS, epsilon, limit, group, first_##group, second_##group);
  SETTLE(0, means, 3, limit2)
  SETTLE(1, quaternions, 4, limit2)
  SETTLE(2, log_scales, 3, limit2)
  SETTLE(3, opacity_logits, 1, limit2)
  SETTLE(4, sh_dc, 3, limit2_sh)
  SETTLE(5, sh_rest, sh_width, limit2_sh)
}

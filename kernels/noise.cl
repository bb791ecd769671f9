// The noise of MCMC: adds normally distributed noise to the means of nearly transparent Gaussians, in the shape of
// their ellipsoids. It also moves Gaussians that no view shows and that have no gradient.
//
// Owner: A work-item owns a Gaussian. Built with one lane; LANES and ITEMS do not change its bits.
// Launch: One work-item for each Gaussian, in groups of 64; work-items past the end do nothing.
// Buffers: quaternions (n, 4), log_scales (n, 3), opacity_logits (n).
//   first_row: the first Gaussian's row in the model. key0, key1: the step's random key.
//   amount: a factor of the noise, in 1 / world units. dead: opacity at which half of the noise is added. highest:
//     Gaussians with this logit or more do not move.
//   readback (READBACK_SIZE): after a stopped pass (duplicate.cl) nothing changes.
//   -> means (n, 3): in world units. With REGION (shared/region.h) means outside the region stay.
// Equations: docs/gradients.md, (92) and (93).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/random.h"
#include "shared/region.h"

#define HALVES 8              // number of uniform 16-bit numbers that are summed
#define WORDS (HALVES / 2)    // number of random 32-bit words, each with two of these numbers
#define SPREAD 1.86881232e-5f // 1 / sqrt(HALVES * (2^32 - 1) / 12), the inverse of the sum's standard deviation

// The normally distributed random number with the given index, 0 to 2, for a row of the model: equation (93) of
// docs/gradients.md. row_word: a random word of the row and the step. The number is a scaled sum of uniform integers.
// The sum stays below 2^23, so only the scaling rounds.
static inline float normal(uint row_word, uint index) {
  int sum = -(HALVES * 65535) / 2;
  for (uint k = 0; k < WORDS; ++k) {
    const uint word = mixed(row_word + 0x9e3779b9u * (WORDS * index + k));
    sum += (int)(word & 0xffffu) + (int)(word >> 16);
  }
  return SPREAD * (float)sum;
}

__kernel void add_noise(const uint n, const uint first_row, const uint key0, const uint key1, const float amount,
                        const float dead, const float highest, const float limit2, __global const uint *readback,
                        __global const float *quaternions, __global const float *log_scales,
                        __global const float *opacity_logits, __global float *means REGION_PARAMETERS) {
  const uint i = get_global_id(0);
  if (i >= n || readback[READBACK_STOPPED]) return;
  const float logit = opacity_logits[i];
  if (!(logit < highest)) return;
#ifdef REGION
  if (!in_region(means + 3 * (size_t)i REGION_NUMBERS)) return;
#endif
  const uint row_word = mixed((first_row + i) ^ key0) + key1;
  const float e0 = normal(row_word, 0), e1 = normal(row_word, 1), e2 = normal(row_word, 2);
  const float by = amount * sigmoidL(100.0f * (dead - sigmoidL(logit)));

  // Equation (92) of docs/gradients.md: adds, for each axis of the ellipsoid, the axis times its variance times the
  // component of the noise along it.
  __global const float *q = quaternions + 4 * (size_t)i;
  __global const float *l = log_scales + 3 * (size_t)i;
  __global float *mean = means + 3 * (size_t)i;
  const float length2 = fma1(q[0], q[0], fma1(q[1], q[1], fma1(q[2], q[2], q[3] * q[3])));
  if (!(length2 > 1e-30f && length2 < 1e30f)) return;
  const float length = sqrt(length2);
  const float w = q[0] / length, x = q[1] / length, y = q[2] / length, z = q[3] / length;
  const float axes[3][3] = {{1.0f - 2.0f * fma1(y, y, z * z), 2.0f * fma1(x, y, w * z), 2.0f * fma1(x, z, -(w * y))},
                            {2.0f * fma1(x, y, -(w * z)), 1.0f - 2.0f * fma1(x, x, z * z), 2.0f * fma1(y, z, w * x)},
                            {2.0f * fma1(x, z, w * y), 2.0f * fma1(y, z, -(w * x)), 1.0f - 2.0f * fma1(x, x, y * y)}};
  float moved[3] = {mean[0], mean[1], mean[2]};
  for (int k = 0; k < 3; ++k) {
    const float s = expL(l[k]);
    const float along = fma1(axes[k][0], e0, fma1(axes[k][1], e1, axes[k][2] * e2)) * s * s * by;
    for (int j = 0; j < 3; ++j) moved[j] = fma1(axes[k][j], along, moved[j]);
  }
  // A mean that would be NaN, infinite or too large keeps its old value, as in Adam.
  if (!(moved[0] * moved[0] < limit2 && moved[1] * moved[1] < limit2 && moved[2] * moved[2] < limit2)) return;
  for (int j = 0; j < 3; ++j) mean[j] = moved[j];
}

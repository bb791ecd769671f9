// The gradient of splats.cl: sums a Gaussian's slots in the order of its tiles, then applies the chain rule to get the
// gradients with respect to the inputs of splats.cl.
//
// Owner: A work-item owns one Gaussian.
// Launch: One work-item for each Gaussian, in groups of 64; work-items past the end do nothing.
// Buffers: slots (pairs, FIELDS) of blend_grad.cl or values_grad.cl: sums of g and its moments; gradients with respect
//     to VALUES values; with ABSOLUTE_GRADIENTS absolute gradients with respect to the mean.
//   tile_counts (n); first_slots (n), the prefix sums of tile_counts; splats of splats.cl.
//   -> d_means2d (n, 2), d_conics (n, 3), d_opacities (n), in loss per unit. Rows of Gaussians without tiles are zero.
//   d_values (n, width): up to VALUES columns, from column `first` on. absolute (n, 2): absolute gradients with respect
//     to means2d.
//   add_values turns slots (pairs, VALUES) of a further pass into d_values only.
// Equations: docs/gradients.md, (173) to (176).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/splat.h"

#if LANES != 1
#error "a work-item has one Gaussian"
#endif

#ifdef ABSOLUTE_GRADIENTS
#define FIELDS (SLOT_RED + VALUES + 2)
#else
#define FIELDS (SLOT_RED + VALUES)
#endif
#define ABSOLUTE (SLOT_RED + VALUES)

// Adds up a Gaussian's `count` slots of `fields` floats each.
static inline void add_up(uint count, __global const float *slot, int fields, float *sums) {
  for (int field = 0; field < fields; ++field) sums[field] = 0.0f;
  for (uint k = 0; k < count; ++k, slot += fields)
    for (int field = 0; field < fields; ++field) sums[field] += slot[field];
}

static inline void store_values(uint i, int width, int first, const float *sums, __global float *d_values) {
  for (int k = 0; k < VALUES; ++k)
    if (first + k < width) d_values[(size_t)width * i + first + k] = sums[k];
}

__kernel void splats_grad(const uint n, const int width, const int first, __global const uint *tile_counts,
                          __global const uint *first_slots, __global const float *slots, __global const float *splats,
                          __global float *d_means2d, __global float *d_conics, __global float *d_opacities,
                          __global float *d_values
#ifdef ABSOLUTE_GRADIENTS
                          ,
                          __global float *absolute
#endif
) {
  const uint i = get_global_id(0);
  if (i >= n) return;
  const uint count = tile_counts[i];
  float sums[FIELDS], by_mean[2] = {0.0f, 0.0f}, by_conic[3] = {0.0f, 0.0f, 0.0f}, by_opacity = 0.0f;
  add_up(count, slots + (size_t)FIELDS * (count > 0 ? first_slots[i] : 0), FIELDS, sums);
  if (count > 0) { // the splats of other Gaussians are uninitialised
    __global const float *splat = splats + (size_t)SPLAT_SIZE * i;
    const float l11 = splat[SPLAT_L11], l12 = splat[SPLAT_L12], l22 = splat[SPLAT_L22];
    by_mean[0] = -INVERSE_WHITEN2 * (l11 * sums[SLOT_GU]); // equation (173) of docs/gradients.md
    by_mean[1] = -INVERSE_WHITEN2 * fma1(l12, sums[SLOT_GU], l22 * sums[SLOT_GV]);
    // Equation (174) of docs/gradients.md: moments of the offsets in pixels. If the ellipse is a needle, the moment
    // along the needle is by far the largest, so it is added last.
    const float in_x = splat[SPLAT_INVERSE_L11], in_y = 1.0f / l22, lean = l12 * in_y;
    const float uv = fma1(-lean, sums[SLOT_GVV], sums[SLOT_GUV]);
    const float uu = fma1(-lean, sums[SLOT_GUV] + uv, sums[SLOT_GUU]);
    by_conic[0] = -0.5f * (in_x * in_x * uu);
    by_conic[1] = -(in_x * in_y * uv);
    by_conic[2] = -0.5f * (in_y * in_y * sums[SLOT_GVV]);
    by_opacity = sums[SLOT_G] / exp2L(splat[SPLAT_LOG2O]); // equation (175) of docs/gradients.md
  }
  for (int k = 0; k < 2; ++k) d_means2d[2 * (size_t)i + k] = by_mean[k];
  for (int k = 0; k < 3; ++k) d_conics[3 * (size_t)i + k] = by_conic[k];
  d_opacities[i] = by_opacity;
  store_values(i, width, first, sums + SLOT_RED, d_values);
#ifdef ABSOLUTE_GRADIENTS
  for (int k = 0; k < 2; ++k)
    absolute[2 * (size_t)i + k] = INVERSE_WHITEN2 * sums[ABSOLUTE + k]; // equation (176) of docs/gradients.md
#endif
}

__kernel void add_values(const uint n, const int width, const int first, __global const uint *tile_counts,
                         __global const uint *first_slots, __global const float *slots, __global float *d_values) {
  const uint i = get_global_id(0);
  if (i >= n) return;
  const uint count = tile_counts[i];
  float sums[VALUES];
  add_up(count, slots + (size_t)VALUES * (count > 0 ? first_slots[i] : 0), VALUES, sums);
  store_values(i, width, first, sums, d_values);
}

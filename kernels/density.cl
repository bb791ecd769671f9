// What adaptive density control (Kerbl et al. 2023, section 5) asks of the device: statistics and moving rows.
#include "shared/math.h"
#include "shared/splat.h"

// One work-item a Gaussian; those with tiles are seen. screen (n, 2): gradient of the mean on the image in pixels;
// x_scale, y_scale to NDC -> gradient_sums (n): norms added up (docs/gradients.md, equation 43); seen (n): views;
// radii (n): largest radius in pixels at 3 sigma.
__kernel void density_statistics(const uint n, const float x_scale, const float y_scale,
                                 __global const uint *tile_counts, __global const float *screen,
                                 __global const float *splats, __global float *gradient_sums,
                                 __global float *seen, __global float *radii) {
  const size_t i = get_global_id(0);
  if (i >= n || tile_counts[i] == 0) return;
  const float gx = x_scale * screen[2 * i], gy = y_scale * screen[2 * i + 1];
  gradient_sums[i] += sqrt(fma1(gx, gx, gy * gy));
  seen[i] += 1.0f;
  __global const float *splat = splats + (size_t)SPLAT_SIZE * i;
  const float l11 = splat[SPLAT_L11] / WHITEN, l12 = splat[SPLAT_L12] / WHITEN, l22 = splat[SPLAT_L22] / WHITEN;
  const float syy = 1.0f / (l22 * l22);
  const float sxy = -(l12 / l11) * syy;
  const float sxx = 1.0f / (l11 * l11) + sxy * sxy / syy;
  const float middle = 0.5f * (sxx + syy), half_difference = 0.5f * (sxx - syy);
  const float radius = ceil(3.0f * sqrt(middle + sqrt(fma1(half_difference, half_difference, sxy * sxy))));
  radii[i] = radii[i] > radius ? radii[i] : radius;
}

// rows (count): which row of `from` each row of `to` is; 0xffffffff for a row of zeros.
__kernel void gather_rows(const uint count, const uint width, __global const uint *rows, __global const float *from,
                          __global float *to) {
  const uint j = get_global_id(0);
  if (j >= count) return;
  const uint row = rows[j];
  for (uint k = 0; k < width; ++k)
    to[(size_t)width * j + k] = row == 0xffffffff ? 0.0f : from[(size_t)width * row + k];
}

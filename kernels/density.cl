// Statistics that adaptive density control reads, and the moving of rows that it orders.
//
// Owner: A work-item owns a Gaussian, in gather_rows a row that is written.
// Launch: One work-item for each Gaussian or row, in groups of 64; those beyond the last do nothing.
// Buffers: tile_counts (n): 0 where not seen; screen (n, 2): gradient of the mean on the image, per pixel; splats (n,
//   SPLAT_SIZE) in pixels. Statistics (n) are added to in place. Shapes of the rest are above each kernel.
// Equations: docs/gradients.md, (43) and (55); Kerbl et al. 2023, section 5.
#include "shared/math.h"
#include "shared/splat.h"

// Norm of the gradient of mean i on the image, (n, 2) in pixels, brought to NDC (docs/gradients.md, equation 43).
static inline float ndc_norm(__global const float *screen, const size_t i, const float x_scale, const float y_scale) {
  const float gx = x_scale * screen[2 * i], gy = y_scale * screen[2 * i + 1];
  return sqrt(fma1(gx, gx, gy * gy));
}

// One work-item a Gaussian; those with tiles are seen. screen (n, 2): gradient of the mean on the image in pixels;
// x_scale, y_scale to NDC -> gradient_sums (n): norms added up; seen (n): views; radii (n): largest radius in pixels
// at 3 sigma. A view in which one of them is not finite does not count, here and below.
__kernel void density_statistics(const uint n, const float x_scale, const float y_scale,
                                 __global const uint *tile_counts, __global const float *screen,
                                 __global const float *splats, __global float *gradient_sums, __global float *seen,
                                 __global float *radii) {
  const size_t i = get_global_id(0);
  if (i >= n || tile_counts[i] == 0) return;
  const float norm = ndc_norm(screen, i, x_scale, y_scale);
  __global const float *splat = splats + (size_t)SPLAT_SIZE * i;
  const float l11 = splat[SPLAT_L11] / WHITEN, l12 = splat[SPLAT_L12] / WHITEN, l22 = splat[SPLAT_L22] / WHITEN;
  const float radius = ceil(3.0f * sqrt(larger_eigenvalue(l11, l12, l22)));
  if (!(norm < INFINITY && radius < INFINITY)) return;
  gradient_sums[i] += norm;
  seen[i] += 1.0f;
  radii[i] = radii[i] > radius ? radii[i] : radius;
}

// As density_statistics -> agreeing (n): views in which the norm is at least the threshold.
__kernel void view_agreement(const uint n, const float x_scale, const float y_scale, const float threshold,
                             __global const uint *tile_counts, __global const float *screen, __global float *agreeing) {
  const size_t i = get_global_id(0);
  if (i >= n || tile_counts[i] == 0) return;
  if (ndc_norm(screen, i, x_scale, y_scale) >= threshold) agreeing[i] += 1.0f;
}

// contributions (n): of the Gaussians with tiles, in pixels; area: what a pixel counts -> totals, largest (n), over
// views.
__kernel void contribution_statistics(const uint n, const float area, __global const uint *tile_counts,
                                      __global const float *contributions, __global float *totals,
                                      __global float *largest) {
  const size_t i = get_global_id(0);
  if (i >= n || tile_counts[i] == 0) return;
  const float contribution = area * contributions[i];
  if (!(contribution < INFINITY)) return;
  totals[i] += contribution;
  largest[i] = largest[i] > contribution ? largest[i] : contribution;
}

// rows (count): which row of `from` each row of `to` is; 0xffffffff for a row of zeros.
__kernel void gather_rows(const uint count, const uint width, __global const uint *rows, __global const float *from,
                          __global float *to) {
  const uint j = get_global_id(0);
  if (j >= count) return;
  const uint row = rows[j];
  for (uint k = 0; k < width; ++k) to[(size_t)width * j + k] = row == 0xffffffff ? 0.0f : from[(size_t)width * row + k];
}

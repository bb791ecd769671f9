// Adaptive density control: statistics, the marks of Gaussians to clone, split and prune, and copies of rows.
//
// Owner: A work-item owns a Gaussian; in gather_rows, an output row.
// Launch: One work-item for each Gaussian or row, in groups of 64; work-items past the end do nothing.
// Buffers: tile_counts (n): 0 if not visible. splats (n, SPLAT_SIZE): in pixels.
//   screen (n, 2): gradient with respect to the mean's image position, per pixel.
//   Statistics (n) are updated in place. Other shapes are above each kernel.
//   density_statistics and contribution_statistics can run over listed chunks only (CHUNKS, as in chunks.h).
// Equations: docs/gradients.md, (43) and (55); Kerbl et al. 2023, section 5.
#include "shared/math.h"
#include "shared/splat.h"
#include "shared/chunks.h"
#include "shared/region.h"
#ifdef RAYS
#include "shared/lanes.h"
#include "shared/rays.h"
#endif

// Norm (grad2d) of the i-th row of `screen` (n, 2), converted from per pixel to per unit of NDC: equation (43) of
// docs/gradients.md.
static inline float ndc_norm(__global const float *screen, const size_t i, const float x_scale, const float y_scale) {
  const float gx = x_scale * screen[2 * i], gy = y_scale * screen[2 * i + 1];
  return sqrt(fma1(gx, gx, gy * gy));
}

// Adds a view to the statistics of its visible Gaussians. x_scale, y_scale: factors that convert `screen` to NDC ->
// gradient_sums (n): sums of gradient norms; seen (n): numbers of views; radii (n): largest radius at 3 sigma, in
// pixels. A view in which a Gaussian's norm or radius is not finite is ignored, as if it did not show the Gaussian.
__kernel void density_statistics(const uint n, const float x_scale, const float y_scale,
#ifdef RAYS
                                 const float pixels, // pixels per radian
#endif
                                 __global const uint *tile_counts, __global const float *screen,
                                 __global const float *splats, __global float *gradient_sums, __global float *seen,
                                 __global float *radii CHUNK_PARAMETERS) {
  const size_t i = get_global_id(0);
  if (i >= n || tile_counts[i] == 0) return;
  const size_t row = ROW_OF_MODEL(i);
  // Read before any is written, and without a branch: a compiler moves no load before a store, and may move one into a
  // branch. So a GPU waits for these loads together.
  const float sum = gradient_sums[row], views = seen[row], largest = radii[row];
  const float norm = ndc_norm(screen, i, x_scale, y_scale);
  __global const float *splat = splats + (size_t)SPLAT_SIZE * i;
#ifdef RAYS
  float w11, w12, w22;
  whitening_of_ray(splat, &w11, &w12, &w22);
  const float radius = ceil(3.0f * (pixels * WHITEN * sqrt(larger_eigenvalue(w11, w12, w22))));
#else
  const float l11 = splat[SPLAT_L11] / WHITEN, l12 = splat[SPLAT_L12] / WHITEN, l22 = splat[SPLAT_L22] / WHITEN;
  const float radius = ceil(3.0f * sqrt(larger_eigenvalue(l11, l12, l22)));
#endif
  const int counts = norm < INFINITY && radius < INFINITY;
  gradient_sums[row] = counts ? sum + norm : sum;
  seen[row] = counts ? views + 1.0f : views;
  radii[row] = counts && !(largest > radius) ? radius : largest;
}

// Adds a view to the statistics of contributions. contributions (n): the Gaussians' contributions to this view, in
// pixels; area: number of full-size pixels in a pixel of this view -> totals, largest (n): sum and maximum over the
// views. Contributions that are not finite are ignored.
__kernel void contribution_statistics(const uint n, const float area, __global const uint *tile_counts,
                                      __global const float *contributions, __global float *totals,
                                      __global float *largest CHUNK_PARAMETERS) {
  const size_t i = get_global_id(0);
  if (i >= n || tile_counts[i] == 0) return;
  const size_t row = ROW_OF_MODEL(i);
  const float contribution = area * contributions[i];
  if (!(contribution < INFINITY)) return;
  totals[row] += contribution;
  largest[row] = largest[row] > contribution ? largest[row] : contribution;
}

// Computes scores for densification. seen (n): numbers of views; whole_largest, current_largest (n): the largest
// contribution to a view in the last complete epoch and in the current one -> scores (n): USELESS if neither is over
// contribution_edge; else the mean gradient norm, if it is over gradient_edge; else UNWANTED. A mean that is not finite
// counts as 0. With REGION and means (n, 3): FROZEN outside the region.
__kernel void density_scores(const uint n, const float gradient_edge, const float contribution_edge,
                             __global const float *gradient_sums, __global const float *seen,
                             __global const float *whole_largest, __global const float *current_largest,
#ifdef REGION
                             __global const float *means,
#endif
                             __global float *scores REGION_PARAMETERS) {
  const size_t i = get_global_id(0);
  if (i >= n) return;
#ifdef REGION
  if (!in_region(means + 3 * i REGION_NUMBERS)) {
    scores[i] = FROZEN;
    return;
  }
#endif
  const float mean = gradient_sums[i] / (seen[i] < 1.0f ? 1.0f : seen[i]);
  const float gradient = fabs(mean) < INFINITY ? mean : 0.0f;
  const bool wanted = gradient > gradient_edge;
  const bool useless = current_largest[i] <= contribution_edge && whole_largest[i] <= contribution_edge;
  scores[i] = useless ? USELESS : wanted ? gradient : UNWANTED;
}

// Marks the Gaussians that remain, that are cloned and that are split, by the thresholds of MarkRules
// (clsplat/optimisation/density_rules.py). Gaussian i is row first + i of the model. scores, radii, logits (n);
// log_scales (n, 3); cut_off, cut_off_row: a Gaussian may be cloned or split if its score is above cut_off, or if its
// score equals cut_off and its row is at most cut_off_row -> marks (3, n), 0 or 1: remains, is cloned, is split. With
// REGION a Gaussian whose score is FROZEN remains.
__kernel void density_marks(const uint n, const uint first, const float cut_off, const uint cut_off_row,
                            const float large_edge, const float transparent_edge, const float oversized_edge,
                            const float oversized_half_edge, const float radius_edge, __global const float *scores,
                            __global const float *radii, __global const float *log_scales, __global const float *logits,
                            __global uint *marks) {
  const size_t i = get_global_id(0);
  if (i >= n) return;
  const float a = log_scales[3 * i], b = log_scales[3 * i + 1], c = log_scales[3 * i + 2], ab = a > b ? a : b;
  const float largest = a == a && b == b ? (ab > c ? ab : c) : -INFINITY;
  const float score = scores[i];
  const bool wanted = score >= 0.0f && (score > cut_off || (score == cut_off && first + i <= cut_off_row));
  const bool large = largest > large_edge, gone = score == USELESS || logits[i] <= transparent_edge;
  const bool stays = !gone && !(largest > oversized_edge);
#ifdef REGION
  marks[i] = score == FROZEN || (stays && !(wanted && large) && !(radii[i] > radius_edge));
#else
  marks[i] = stays && !(wanted && large) && !(radii[i] > radius_edge);
#endif
  marks[(size_t)n + i] = stays && wanted && !large;
  marks[2 * (size_t)n + i] = !gone && wanted && large && !(largest > oversized_half_edge);
}

// Lists the rows that follow from the marks. marks (3, n); places (3, n): exclusive prefix sums of marks; counts[0]:
// the sum of marks; first: as in density_marks -> rows (2n): the source row of each new row; counts[1]: the number of
// splits. Order: remaining Gaussians, clones, first halves, second halves. Clones and halves have the flag FRESH.
__kernel void density_rows(const uint n, const uint first, __global const uint *marks, __global const uint *places,
                           __global uint *rows, __global uint *counts) {
  const size_t i = get_global_id(0);
  if (i >= n) return;
  const uint row = first + (uint)i, splits = counts[0] - places[2 * (size_t)n];
  for (uint kind = 0; kind < 3; ++kind) {
    const size_t at = kind * (size_t)n + i;
    if (marks[at] == 0) continue;
    rows[places[at]] = row | (kind == 0 ? 0 : FRESH);
    if (kind == 2) rows[places[at] + splits] = row | FRESH;
  }
  if (i == 0) counts[1] = splits;
}

// Copies rows of `width` floats from `from` to `to`. rows (count): the source row of each row of `to`. If `renews`,
// FRESH rows are filled with `fresh` instead.
__kernel void gather_rows(const uint count, const uint width, const uint renews, const float fresh,
                          __global const uint *rows, __global const float *from, __global float *to) {
  const uint j = get_global_id(0);
  if (j >= count) return;
  const bool renewed = renews && (rows[j] & FRESH);
  const uint row = rows[j] & ~FRESH;
  for (uint k = 0; k < width; ++k) to[(size_t)width * j + k] = renewed ? fresh : from[(size_t)width * row + k];
}

// Bilateral grids of colour transforms: applies a photograph's grid to the render, computes the gradients, and updates
// the grid by Adam.
//
// Owner: A work-item owns a pixel (slice, slice_gradient); a channel, a grid column and an image line (line_sums); one
//   coefficient of one photograph's grid (grid_sums, move_grid) or of all grids (centre_grids). Sums are added in the
//   same order on every device. Built with one lane.
// Launch: Grids of work-items. slice: stride x rows; slice_gradient: width x height; line_sums: GRID_COLUMNS x height x
//   3; the others: one work-item for each coefficient.
// Buffers: image, seen, gradient (3, rows, stride): colour before and after the transform, and the loss's gradient with
//     respect to colour. across, down: number of grid columns and of grid rows that a pixel spans.
//   grids, first, second (photographs, GRID_LEVELS, GRID_ROWS, GRID_COLUMNS, 3, 4).
//   lines (height, GRID_COLUMNS, 3, 4, GRID_LEVELS).
//   by_grid: the gradient with respect to one photograph's grid.
//   What each kernel reads and writes is above the kernel.
// Equations: docs/gradients.md, "Bilateral grids".
#include "shared/math.h"
#include "shared/lanes.h"

#define GRID_COLUMNS 16
#define GRID_ROWS 16
#define GRID_LEVELS 8
#define MAP 12 // number of coefficients of a colour transform, three rows of four
#define GRID_FLOATS (GRID_LEVELS * GRID_ROWS * GRID_COLUMNS * MAP)
#define LEVEL_FLOATS (GRID_ROWS * GRID_COLUMNS * MAP)

static inline float luminance_of(const float r, const float g, const float b) {
  return fma1(0.299f, r, fma1(0.587f, g, 0.114f * b));
}

// The coordinate of a luminance along the grid's levels, 0 to GRID_LEVELS - 1; NaN gives 0.
static inline float level_of(const float luminance) {
  return luminance > 0.0f ? min(luminance, 1.0f) * (GRID_LEVELS - 1) : 0.0f;
}

// Interpolates a pixel's colour transform: bilinearly within two levels, then linearly between them. (u, v, level): the
// pixel's coordinates in the grid; map (MAP): the transform; risen (MAP): its derivative with respect to the level.
static inline void pixel_map(const float u, const float v, const float level, __global const float *grid, float *map,
                             float *risen) {
  const int i = min((int)u, GRID_COLUMNS - 2), j = min((int)v, GRID_ROWS - 2), l = min((int)level, GRID_LEVELS - 2);
  const float fu = u - (float)i, fv = v - (float)j, fl = level - (float)l;
  const float w00 = (1.0f - fu) * (1.0f - fv), w10 = fu * (1.0f - fv), w01 = (1.0f - fu) * fv, w11 = fu * fv;
  __global const float *at = grid + ((size_t)(l * GRID_ROWS + j) * GRID_COLUMNS + i) * MAP;
  for (int k = 0; k < MAP; ++k) {
    __global const float *low = at + k, *high = at + k + LEVEL_FLOATS;
    const float a =
        fma1(w00, low[0], fma1(w10, low[MAP], fma1(w01, low[MAP * GRID_COLUMNS], w11 * low[MAP * GRID_COLUMNS + MAP])));
    const float b = fma1(
        w00, high[0], fma1(w10, high[MAP], fma1(w01, high[MAP * GRID_COLUMNS], w11 * high[MAP * GRID_COLUMNS + MAP])));
    risen[k] = b - a;
    map[k] = fma1(fl, b - a, a);
  }
}

// Applies each pixel's colour transform: grids, image -> seen.
__kernel void slice(const int photograph, const int stride, const int plane, const float across, const float down,
                    __global const float *grids, __global const float *image, __global float *seen) {
  const int x = get_global_id(0), y = get_global_id(1);
  const size_t at = (size_t)stride * y + x;
  const float r = image[at], g = image[plane + at], b = image[2 * (size_t)plane + at];
  float map[MAP], risen[MAP];
  pixel_map(((float)x + 0.5f) * across, ((float)y + 0.5f) * down, level_of(luminance_of(r, g, b)),
            grids + (size_t)photograph * GRID_FLOATS, map, risen);
  for (int c = 0; c < 3; ++c)
    seen[(size_t)plane * c + at] =
        fma1(map[4 * c], r, fma1(map[4 * c + 1], g, fma1(map[4 * c + 2], b, map[4 * c + 3])));
}

// Turns the gradient with respect to the transformed colours into the gradient with respect to `image`, the colours
// before the transform: grids, image -> gradient, in place.
__kernel void slice_gradient(const int photograph, const int stride, const int plane, const float across,
                             const float down, __global const float *grids, __global const float *image,
                             __global float *gradient) {
  const int x = get_global_id(0), y = get_global_id(1);
  const size_t at = (size_t)stride * y + x;
  const float r = image[at], g = image[plane + at], b = image[2 * (size_t)plane + at];
  const float luminance = luminance_of(r, g, b);
  float map[MAP], risen[MAP];
  pixel_map(((float)x + 0.5f) * across, ((float)y + 0.5f) * down, level_of(luminance),
            grids + (size_t)photograph * GRID_FLOATS, map, risen);
  float by_level = 0.0f, by_red = 0.0f, by_green = 0.0f, by_blue = 0.0f;
  for (int c = 0; c < 3; ++c) {
    const float h = gradient[(size_t)plane * c + at];
    by_red = fma1(h, map[4 * c], by_red);
    by_green = fma1(h, map[4 * c + 1], by_green);
    by_blue = fma1(h, map[4 * c + 2], by_blue);
    by_level = fma1(h, fma1(risen[4 * c], r, fma1(risen[4 * c + 1], g, fma1(risen[4 * c + 2], b, risen[4 * c + 3]))),
                    by_level);
  }
  const float by_luminance = luminance > 0.0f && luminance < 1.0f ? (GRID_LEVELS - 1) * by_level : 0.0f;
  gradient[at] = fma1(0.299f, by_luminance, by_red);
  gradient[plane + at] = fma1(0.587f, by_luminance, by_green);
  gradient[2 * (size_t)plane + at] = fma1(0.114f, by_luminance, by_blue);
}

// Sums the gradient with respect to the grid over the pixels of an image line, with the interpolation weights of grid
// column and level. image: the colours before the transform; gradient: with respect to the transformed colours ->
// lines.
__kernel void line_sums(const int width, const int stride, const int plane, const float across,
                        __global const float *image, __global const float *gradient, __global float *lines) {
  const int i = get_global_id(0), y = get_global_id(1), c = get_global_id(2);
  float sums[4 * GRID_LEVELS];
  for (int k = 0; k < 4 * GRID_LEVELS; ++k) sums[k] = 0.0f;
  const int begin = max(width * (i - 1) / (GRID_COLUMNS - 1) - 1, 0);
  const int end = min(width * (i + 1) / (GRID_COLUMNS - 1) + 2, width);
  for (int x = begin; x < end; ++x) {
    const float hat = 1.0f - fabs(((float)x + 0.5f) * across - (float)i);
    if (!(hat > 0.0f)) continue;
    const size_t at = (size_t)stride * y + x;
    const float r = image[at], g = image[plane + at], b = image[2 * (size_t)plane + at];
    const float level = level_of(luminance_of(r, g, b)), h = hat * gradient[(size_t)plane * c + at];
    const int l = min((int)level, GRID_LEVELS - 2);
    const float high = h * (level - (float)l), low = h - high;
    float *sum = sums + 4 * l;
    sum[0] = fma1(low, r, sum[0]), sum[1] = fma1(low, g, sum[1]), sum[2] = fma1(low, b, sum[2]), sum[3] += low;
    sum[4] = fma1(high, r, sum[4]), sum[5] = fma1(high, g, sum[5]), sum[6] = fma1(high, b, sum[6]), sum[7] += high;
  }
  __global float *line = lines + ((size_t)y * GRID_COLUMNS + i) * MAP * GRID_LEVELS + (size_t)c * 4 * GRID_LEVELS;
  for (int k = 0; k < 4 * GRID_LEVELS; ++k) line[k] = sums[k];
}

// The sum of a coefficient's differences from its two neighbours along an axis of the grid, which are `step` floats
// away. This is half the gradient of the squared differences. place: the coefficient's index along the axis, of
// `count`.
static inline float pull(__global const float *value, const int place, const int count, const int step) {
  float sum = 0.0f;
  if (place > 0) sum += value[0] - value[-step];
  if (place < count - 1) sum += value[0] - value[step];
  return sum;
}

// Computes the gradient with respect to a photograph's grid. lines, grids -> by_grid: sums of the lines, with the
// interpolation weights of grid rows, plus the gradient of the smoothness penalty.
__kernel void grid_sums(const int photograph, const int height, const float down, const float weight,
                        __global const float *grids, __global const float *lines, __global float *by_grid) {
  const int at = get_global_id(0);
  if (at >= GRID_FLOATS) return;
  const int k = at % MAP, i = at / MAP % GRID_COLUMNS, j = at / (MAP * GRID_COLUMNS) % GRID_ROWS;
  const int l = at / LEVEL_FLOATS;
  __global const float *column = lines + ((size_t)i * MAP + k / 4 * 4) * GRID_LEVELS + 4 * l + k % 4;
  const int begin = max(height * (j - 1) / (GRID_ROWS - 1) - 1, 0);
  const int end = min(height * (j + 1) / (GRID_ROWS - 1) + 2, height);
  float sum = 0.0f;
  for (int y = begin; y < end; ++y) {
    const float hat = 1.0f - fabs(((float)y + 0.5f) * down - (float)j);
    if (hat > 0.0f) sum = fma1(hat, column[(size_t)y * GRID_COLUMNS * MAP * GRID_LEVELS], sum);
  }
  __global const float *value = grids + (size_t)photograph * GRID_FLOATS + at;
  const float along = 2.0f * weight * GRID_COLUMNS / (GRID_FLOATS * (GRID_COLUMNS - 1.0f));
  const float below = 2.0f * weight * GRID_ROWS / (GRID_FLOATS * (GRID_ROWS - 1.0f));
  const float above = 2.0f * weight * GRID_LEVELS / (GRID_FLOATS * (GRID_LEVELS - 1.0f));
  sum = fma1(along, pull(value, i, GRID_COLUMNS, MAP), sum);
  sum = fma1(below, pull(value, j, GRID_ROWS, MAP * GRID_COLUMNS), sum);
  by_grid[at] = fma1(above, pull(value, l, GRID_LEVELS, LEVEL_FLOATS), sum);
}

// Takes a step of Adam: by_grid -> the photograph's grid and its moments `first` and `second`, in place.
__kernel void move_grid(const int photograph, const float rate, const float root, const float beta1, const float beta2,
                        const float epsilon, __global const uint *readback, __global const float *by_grid,
                        __global float *grids, __global float *first, __global float *second) {
  const int item = get_global_id(0);
  if (item >= GRID_FLOATS || readback[READBACK_STOPPED]) return;
  const size_t at = (size_t)photograph * GRID_FLOATS + item;
  float g = by_grid[item];
  if (!(g * g < INFINITY)) g = 0.0f; // a gradient that is not finite counts as 0
  const float m = fma1(beta1, first[at], (1.0f - beta1) * g), v = fma1(beta2, second[at], (1.0f - beta2) * (g * g));
  first[at] = m, second[at] = v;
  grids[at] -= rate * m / fma1(sqrt(v), root, epsilon);
}

// Shifts the grids of all photographs in place, so that their mean over the photographs is the grid `mean`.
__kernel void centre_grids(const int photographs, __global const uint *readback, __global const float *mean,
                           __global float *grids) {
  const int item = get_global_id(0);
  if (item >= GRID_FLOATS || readback[READBACK_STOPPED]) return;
  float sum = 0.0f;
  for (int p = 0; p < photographs; ++p) sum += grids[(size_t)p * GRID_FLOATS + item] - mean[item];
  const float shift = sum / (float)photographs;
  for (int p = 0; p < photographs; ++p) grids[(size_t)p * GRID_FLOATS + item] -= shift;
}

// The gradient of values.cl, back to front: for each pair, partial sums over the tile's pixels. A pass covers VALUES
// values.
//
// Owner: A group owns a tile and writes one slot for each of its pairs, as in blend_grad.cl; in gradient_by_cell a
//   group owns a tile's pixels.
// Launch: One group of ITEMS work-items for each tile from first_tile on, as in blend.cl.
// Buffers: gradient_by_cell reads d_pixels (height, width, depth), background (depth), and with ALPHA_GRADIENT d_alpha
//     (height, width). -> by_cell (tiles, (depth + 1) * TILE * TILE): for each cell, the gradients with respect to all
//     values, then with respect to the final transmittance (background included); 0 in padding.
//   values_grad reads ranges, gaussian_from_sorted, slot_from_sorted, splats, transmittance and stops as blend_grad.cl
//     does, value_rows (n, depth) and by_cell. -> slots (pairs, FIELDS), all written: sums over the tile's pixels of
//     the gradients with respect to VALUES values, from `first` on. With GEOMETRY, g and its moments, computed from all
//     values, come before these sums. With ABSOLUTE_GRADIENTS, absolute gradients with respect to the mean come last.
// Equations: docs/gradients.md, (178) to (180), with (22) to (26), (48) and (49).
#include "shared/math.h"
#include "shared/splat.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/subgroup.h"
#include "shared/tile.h"
#include "shared/cells.h"
#include "shared/alpha.h"
#include "shared/prefetch.h"
#include "shared/values.h"

#ifdef GEOMETRY
#define FIRST_VALUE SLOT_RED
#else
#define FIRST_VALUE 0
#endif
#define ABSOLUTE (FIRST_VALUE + VALUES)
#if defined(GEOMETRY) && defined(ABSOLUTE_GRADIENTS)
#define FIELDS (ABSOLUTE + 2)
#else
#define FIELDS ABSOLUTE
#endif

// BY_TILE: number of floats per tile in by_cell. IN_CELL: the index of value k of a cell, within the tile's part of
// by_cell. The values of neighbouring lanes or items are adjacent.
#define BY_TILE ((size_t)(depth + 1) * (TILE * TILE))
#if ITEMS == 1
#define IN_CELL(cell, k) (((cell) * (depth + 1) + (k)) * LANES)
#else
#define IN_CELL(cell, k) ((k) * (TILE * TILE) + (cell) * ITEMS + ITEM)
#endif

GROUP __kernel void gradient_by_cell(const int first_tile, const int tiles_x, const int width, const int height,
                                     const int depth, __global const float *d_pixels, __global const float *background,
#ifdef ALPHA_GRADIENT
                                     __global const float *d_alpha,
#endif
                                     __global float *by_cell) {
  const int tile = first_tile + get_group_id(0);
  const int tile_x = (tile % tiles_x) * TILE, tile_y = (tile / tiles_x) * TILE;
  __global float *tile_values = by_cell + BY_TILE * get_group_id(0);
  ALL_CELLS(cell)
  for (int lane = 0; lane < LANES; ++lane) {
    const int x = tile_x + CELL_X(cell) + LANE_PIXEL_X(lane), y = tile_y + CELL_Y(cell) + LANE_PIXEL_Y(lane);
    const int inside = x < width && y < height;
    const size_t pixel = inside ? (size_t)width * y + x : 0;
    float at_end = 0.0f;
    for (int k = 0; k < depth; ++k) {
      const float by_value = inside ? d_pixels[depth * pixel + k] : 0.0f;
      tile_values[IN_CELL(cell, k) + lane] = by_value;
      at_end = fma1(by_value, background[k], at_end);
    }
#ifdef ALPHA_GRADIENT
    at_end -= inside ? d_alpha[pixel] : 0.0f;
#endif
    tile_values[IN_CELL(cell, depth) + lane] = at_end;
  }
}

typedef struct {
  floatL t, behind;
  intL stop;
} Pixels;

// The dot product of the pixels' gradients and the Gaussian's values, over all values. There are four partial sums,
// because a single sum would be a chain of dependent additions.
static inline floatL shade_of(__global const float *by_pixels, int depth, int cell, __global const float *own) {
  floatL shade[4];
  for (int k = 0; k < 4; ++k) shade[k] = (floatL)(0.0f);
  int k = 0;
  for (; k + 4 <= depth; k += 4)
    UNROLL for (int j = 0; j < 4; ++j) shade[j] =
        fmaL(LOADL(by_pixels + IN_CELL(cell, k + j)), (floatL)(own[k + j]), shade[j]);
  for (; k < depth; ++k) shade[0] = fmaL(LOADL(by_pixels + IN_CELL(cell, k)), (floatL)(own[k]), shade[0]);
  return (shade[0] + shade[1]) + (shade[2] + shade[3]);
}

// Undoes the blending of the i-th pair in the pixels of a cell, and adds the pixels' gradients to the pair's sums
// (FIELDS). by_pixels: the tile's part of by_cell; own: the Gaussian's values.
static inline void take_pair(Pixels *p, int i, floatL u, floatL v, float l11, float l12, float l22, float log2o,
                             __global const float *by_pixels, int depth, int first, int cell, __global const float *own,
                             floatL *sums) {
  const floatL power = log2_alpha(u, v, log2o);
  const intL taken = MASKL(power >= LOG2_ALPHA_MIN) & MASKL((intL)(i) < p->stop);
  if (!ANYL(taken)) return;
  const floatL uncapped = AS_FLOATL(AS_INTL(exp2L(power)) & taken);
  const floatL alpha = uncapped < ALPHA_MAX ? uncapped : (floatL)(ALPHA_MAX);
  const floatL inverse = 1.0f / (1.0f - alpha), before = p->t * inverse, weight = alpha * before;
  p->t = before;
#ifdef GEOMETRY
  const floatL shade = shade_of(by_pixels, depth, cell, own);
  const floatL d_alpha = fmaL(before, shade, -(p->behind * inverse));
  const floatL g = AS_FLOATL(AS_INTL(alpha * d_alpha) & MASKL(uncapped < ALPHA_MAX));
  p->behind = fmaL(weight, shade, p->behind);
  add_moments(g, u, v, sums);
#ifdef ABSOLUTE_GRADIENTS
  sums[ABSOLUTE] += fabs(g * (l11 * u));
  sums[ABSOLUTE + 1] += fabs(g * fmaL((floatL)(l12), u, l22 * v));
#endif
#endif
  FOR_VALUES(k)
  sums[FIRST_VALUE + k] = fmaL(weight, LOADL(by_pixels + IN_CELL(cell, first + k)), sums[FIRST_VALUE + k]);
}

#define TAKE_PAIR(i, reach, own)                                                                                       \
  FOR_CELLS(cell, reach) {                                                                                             \
    const floatL dy = my - AT_Y(cell);                                                                                 \
    take_pair(pixels + cell, i, whitened_u(l11, l12, mx - AT_X(cell), dy), l22 * dy, l11, l12, l22, log2o, by_pixels,  \
              depth, first, cell, own, sums);                                                                          \
  }

#if ITEMS > 1
#undef SLOT_STRIDE
#define SLOT_STRIDE FIELDS // number of sums of a pair, for item_sums.h
#include "shared/item_sums.h"
// Number of pairs whose rows fit together in 16 KiB of local memory.
#define TOGETHER (3 * SLOT_STRIDE * ROW <= 4096 ? 3 : 1)
#endif

GROUP SUBGROUPED __kernel void values_grad(const int first_tile, const int tiles_x, const int height, const int depth,
                                           const int first, __global const uint *ranges,
                                           __global const uint *gaussian_from_sorted,
                                           __global const uint *slot_from_sorted, __global const float *splats,
                                           __global const float *value_rows, __global const float *by_cell,
                                           __global const float *transmittance, __global const int *stops,
                                           __global float *slots
#ifdef RECORD_CELLS
                                           ,
                                           __global const uint *cells_from_sorted
#endif
) {
  TILE_OF_GROUP
  PIXEL_TABLES
  __global const float *by_pixels = by_cell + BY_TILE * get_group_id(0);
  Pixels pixels[OWNED];
  int last = begin;
  ALL_CELLS(cell) {
    const size_t pixel = CELL_IN_PLANE(cell);
    const floatL t = LOAD_CELL(float, transmittance + pixel, stride);
    const Pixels p = {t, t * LOADL(by_pixels + IN_CELL(cell, depth)), LOAD_CELL(int, stops + pixel, stride)};
    pixels[cell] = p;
    last = max(last, maxL(p.stop));
  }
  RAISE_TO_GROUP_MAX(last)

  for (int turn = last; turn < end; turn += ITEMS) {
    const int i = turn + (int)get_local_id(0);
    __global float *slot = slots + (size_t)FIELDS * slot_from_sorted[min(i, end - 1)];
    if (i < end)
      for (int field = 0; field < FIELDS; ++field) slot[field] = 0.0f;
  }

#if ITEMS == 1
  for (int i = last - 1; i >= begin; --i) {
    const int ahead = i - AHEAD > begin ? i - AHEAD : begin;
    PREFETCH(splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[ahead]);
    PREFETCH(value_rows + (size_t)depth * gaussian_from_sorted[ahead]);
    PREFETCH(slots + (size_t)FIELDS * slot_from_sorted[ahead]);
    __global const float *splat = splats + (size_t)SPLAT_SIZE * gaussian_from_sorted[i];
    __global const float *own = value_rows + (size_t)depth * gaussian_from_sorted[i];
    __global float *slot = slots + (size_t)FIELDS * slot_from_sorted[i];
    SPLAT_HERE(splat)
    floatL sums[FIELDS];
    for (int field = 0; field < FIELDS; ++field) sums[field] = (floatL)(0.0f);
    TAKE_PAIR(i, CELLS_OF_PAIR(i, splat), own)
    for (int field = 0; field < FIELDS; ++field) slot[field] = sumL(sums[field]);
  }
#else
  __local Staged staged[BATCH];
  __local float rows[TOGETHER * SLOT_STRIDE * ROW] __attribute__((aligned(16)));
  for (int batch = last; batch > begin; batch -= BATCH) {
    const int count = min(BATCH, batch - begin); // number of pairs in this batch, which ends before index `batch`
    for (int j = ITEM; j < BATCH; j += ITEMS) {
      const int i = max(batch - 1 - j, begin);
      const uint gaussian = gaussian_from_sorted[i];
      stage(staged + j, gaussian, gaussian, slot_from_sorted[i], ALL_BLOCKS, splats, tile_x, tile_y);
    }
    BARRIER_LOCAL();
    for (int turn = 0; turn < count; turn += TOGETHER) {
      const int together = min(TOGETHER, count - turn);
      for (int j = 0; j < together; ++j) {
        const Staged s = staged[turn + j];
        SPLAT_STAGED(s)
        __global const float *own = value_rows + (size_t)depth * s.kept;
        float sums[FIELDS];
        for (int field = 0; field < FIELDS; ++field) sums[field] = 0.0f;
        TAKE_PAIR(batch - 1 - turn - j, FROM_OWN(s.blocks), own)
        leave_sums(sums, rows + j * (FIELDS * ROW));
      }
      BARRIER_LOCAL();
      for (int row = ITEM; row < together * FIELDS; row += ITEMS)
        slots[(size_t)FIELDS * staged[turn + row / FIELDS].slot + row % FIELDS] = row_sum(rows + row * ROW);
      BARRIER_LOCAL();
    }
  }
#endif
}

// Decides which tiles a projected Gaussian reaches. The kernels that count pairs and those that write pairs must both
// use this code: if they disagreed by one tile, the pairs would overrun the arrays sized by the count, or leave gaps in
// them. The tile size is TILE of clsplat/layouts/columns.py.
#include "shared/splat.h"

// Slack in pixels by which ellipses are enlarged. It exceeds the rounding errors of float32 in this file: an extra tile
// only costs time, but a missing tile would be visible.
#define TILE_SLACK 0.01f

// u^2 + v^2 at the edge of a Gaussian's ellipse. Alpha is ALPHA_MIN at the edge, unless RasterizerConfig.extent sets
// another extent.
#ifdef EXTENT_BUDGET
#define EXTENT(log2o) EXTENT_BUDGET
#else
#define EXTENT(log2o) ((log2o) - LOG2_ALPHA_MIN)
#endif

// The first of `count` tiles or cells of `size` pixels whose last pixel centre is at or after the coordinate `low`;
// `count` if there is none. The function rounds through integers after the clamp, because ceil and floor are calls in
// some drivers.
static inline int first_cell(float low, float size, int count) {
  float cell = (low - TILE_SLACK - (size - 0.5f)) * (1.0f / size);
  cell = cell > 0.0f ? cell : 0.0f;
  cell = cell < (float)count ? cell : (float)count;
  const int whole = (int)cell;
  return whole + ((float)whole < cell);
}

// One past the last of `count` tiles or cells of `size` pixels whose first pixel centre is at or before the coordinate
// `high`; 0 if there is none.
static inline int end_cell(float high, float size, int count) {
  float cell = (high + TILE_SLACK - 0.5f) * (1.0f / size) + 1.0f;
  cell = cell > 0.0f ? cell : 0.0f;
  return (int)(cell < (float)count ? cell : (float)count);
}

// A box of up to SMALL_BOX tiles is listed whole. For so few tiles, a test of which tiles the ellipse reaches would
// take longer than the surplus tiles take in blend.cl.
#ifdef BOX_TILE_TEST // RasterizerConfig.tile_test
#define SMALL_BOX 0x7fffffff
#elif !defined(SMALL_BOX)
#define SMALL_BOX 16
#endif

#ifdef RAYS // a ray splat holds its box of tiles, computed by project_rays.cl
typedef struct {
  int tile_x0, tile_x1, tile_y0, tile_y1; // tiles of the box; if x0 > x1 the box wraps: [x0, tiles_x) and [0, x1)
  int box;                                // number of tiles
} Ellipse;

static inline Ellipse ellipse_of(__global const float *splat, int tiles_x, int tiles_y) {
  const uint columns = as_uint(splat[RAY_COLUMNS]), rows = as_uint(splat[RAY_ROWS]);
  Ellipse e = {columns & 0xffff, columns >> 16, rows & 0xffff, rows >> 16, 0};
  e.box = (e.tile_y1 - e.tile_y0) * (e.tile_x1 - e.tile_x0 + (e.tile_x0 > e.tile_x1 ? tiles_x : 0));
  return e;
}

// The tiles [*x0, *x1) of the box in tile row ty. A box that crosses the seam of a panorama has two parts, 0 and 1;
// `part` selects one of them.
#define SPANS 2
static inline void tile_span(const Ellipse *e, int ty, int part, int tiles_x, int *x0, int *x1) {
  const int wraps = e->tile_x0 > e->tile_x1;
  *x0 = wraps && part == 0 ? 0 : e->tile_x0;
  *x1 = wraps && part == 1 ? tiles_x : e->tile_x1;
  if (!wraps && part == 1) *x1 = *x0;
}

#else
typedef struct {
  float mx, my, l11, l12, l22, half_w, half_h;
  float budget;                           // u^2 + v^2 at the ellipse's edge
  float tangent;                          // y of the ellipse's rightmost point, relative to the mean
  int tile_x0, tile_x1, tile_y0, tile_y1; // tiles that the ellipse's box reaches
  int box;                                // number of tiles
} Ellipse;

#ifdef SQUARE_TILE_TEST
// The ellipse's longer half axis in pixels, as in Kerbl et al.'s code: from the larger eigenvalue of the covariance,
// which is recovered from the whitening.
static inline float longest_half_axis(__global const float *splat) {
  const float larger = larger_eigenvalue(splat[SPLAT_L11], splat[SPLAT_L12], splat[SPLAT_L22]);
  return sqrt(EXTENT(splat[SPLAT_LOG2O]) * larger);
}
#endif

static inline Ellipse ellipse_of(__global const float *splat, int tiles_x, int tiles_y) {
  Ellipse e;
  e.mx = splat[SPLAT_PIXEL_X] + splat[SPLAT_SUB_X];
  e.my = splat[SPLAT_PIXEL_Y] + splat[SPLAT_SUB_Y];
  e.half_w = splat[SPLAT_HALF_W];
  e.half_h = splat[SPLAT_HALF_H];
#ifdef SQUARE_TILE_TEST // RasterizerConfig.tile_test: a square, which rounding must not make smaller than the box
  const float radius = longest_half_axis(splat);
  e.half_w = radius > e.half_w ? radius : e.half_w;
  e.half_h = radius > e.half_h ? radius : e.half_h;
#endif
  e.tile_x0 = first_cell(e.mx - e.half_w, (float)TILE, tiles_x);
  e.tile_x1 = end_cell(e.mx + e.half_w, (float)TILE, tiles_x);
  e.tile_y0 = first_cell(e.my - e.half_h, (float)TILE, tiles_y);
  e.tile_y1 = end_cell(e.my + e.half_h, (float)TILE, tiles_y);
  e.box = max(e.tile_x1 - e.tile_x0, 0) * max(e.tile_y1 - e.tile_y0, 0);
  if (e.box > SMALL_BOX) {
    e.l11 = splat[SPLAT_L11];
    e.l12 = splat[SPLAT_L12];
    e.l22 = splat[SPLAT_L22];
    e.budget = EXTENT(splat[SPLAT_LOG2O]);
    e.tangent = -e.l12 * e.l11 / (e.l22 * e.l22 + e.l12 * e.l12) * e.half_w;
  }
  return e;
}

// The ellipse's right edge, relative to the mean, in the rows whose offsets from the mean are in [d0, d1]; the left
// edge follows by symmetry (equation (47) of docs/gradients.md).
static inline float right_edge(const Ellipse *e, float d0, float d1) {
  if (e->tangent >= d0 && e->tangent <= d1) return e->half_w;
  const float dy = e->tangent < d0 ? d0 : d1;
  const float rest = e->budget - e->l22 * e->l22 * dy * dy;
  return (-e->l12 * dy + sqrt(rest > 0.0f ? rest : 0.0f)) / e->l11;
}

// The tiles [*x0, *x1) of tile row ty that the ellipse reaches; all tiles of a small box. `part` is always 0 here.
#define SPANS 1
static inline void tile_span(const Ellipse *e, int ty, int part, int tiles_x, int *x0, int *x1) {
  *x0 = e->tile_x0;
  *x1 = e->tile_x1 > e->tile_x0 ? e->tile_x1 : e->tile_x0;
  if (e->box <= SMALL_BOX) return;
  float d0 = (float)(ty * TILE) + 0.5f - TILE_SLACK - e->my;
  float d1 = (float)(ty * TILE + TILE) - 0.5f + TILE_SLACK - e->my;
  d0 = d0 > -e->half_h ? d0 : -e->half_h;
  d1 = d1 < e->half_h ? d1 : e->half_h;
  if (!(d0 <= d1)) d0 = d1 = (d0 > e->half_h ? e->half_h : -e->half_h);
  const float right = right_edge(e, d0, d1);
  const float left = right_edge(e, -d1, -d0);
  *x0 = first_cell(e->mx - left, (float)TILE, tiles_x);
  *x1 = end_cell(e->mx + right, (float)TILE, tiles_x);
  if (*x1 < *x0) *x1 = *x0;
}
#endif

// The number of tiles that an ellipse reaches, over all tile rows.
static inline uint tile_count(const Ellipse *e, int tiles_x) {
  if (e->box <= SMALL_BOX) return e->box;
  uint count = 0;
  for (int ty = e->tile_y0; ty < e->tile_y1; ++ty)
    for (int part = 0; part < SPANS; ++part) {
      int x0, x1;
      tile_span(e, ty, part, tiles_x, &x0, &x1);
      count += x1 - x0;
    }
  return count;
}

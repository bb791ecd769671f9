// Projection for the camera models along rays (RAYS). Each Gaussian becomes an ellipse on the plane that touches the
// sphere of directions at its mean, where the distortion is smallest. So the poles and the seam of a panorama need no
// special case.
//
// Owner: A work-item owns a Gaussian. Built with one lane; LANES and ITEMS do not change its bits.
// Launch: One work-item for each Gaussian, in groups of 64, or of ITEMS with COUNTS_LISTS; work-items past the end do
//   nothing.
// Buffers: The inputs of project.cl, without NO_FRUSTUM_CULL -> splats (n, RAY_SIZE), with directions in the camera's
//   axes and distances in world units; tile_counts (n). CHUNKS and FIRST_ROWS: see shared/chunks.h. COUNTS_LISTS: see
//   shared/list_counts.h.
// Equations: docs/cameras.md, (8) to (14), (18), (19), (30), (32); colour docs/gradients.md, (12).
#include "shared/math.h"
#define NEEDS_TANGENTS
#define NEEDS_BOXES
#include "shared/tile.h"
#include "shared/list_counts.h"
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/gaussian.h"
#include "shared/sh.h"
#include "shared/rays.h"
#include "shared/tangent.h"
#include "shared/chunks.h"
#ifdef THINNED
#include "shared/random.h"
#endif

// Slack in pixels by which a box is enlarged, in addition to TILE_SLACK: it covers the rounding of float32 angles in a
// picture 32768 pixels wide.
#define BOX_SLACK 0.1f
// Stores in a splat which tiles a box covers. tile.h reads them again (`ellipse_of`).
static inline void store_box(const Box *t, int width, int height, int tiles_x, int tiles_y, __constant float *camera,
                             __global float *splat) {
  int x0 = 0, x1 = tiles_x;
  if (!t->whole_rows) {
    float low = t->low_x - BOX_SLACK, high = t->high_x + BOX_SLACK;
#ifdef WRAPS
    // A full turn of the panorama is `turn` pixels wide and begins at column `begin`; the picture may be narrower.
    const float turn = 2.0f * HALF_TURN * camera[CAMERA_FX], begin = 0.5f * ((float)width - turn);
    const float shift = turn * floor((low - begin) / turn);
    low -= shift;
    high -= shift;
    const int wraps = high >= begin + turn;
    const int last = wraps ? end_cell(high - turn, (float)TILE, tiles_x) : 0;
    x0 = first_cell(low, (float)TILE, tiles_x);
    x1 = wraps ? tiles_x : max(x0, end_cell(high, (float)TILE, tiles_x));
    if (last >= x0) { // the two ends of a wrapped box meet, so the box has all columns
      x0 = wraps ? 0 : x0;
    } else if (last > 0) {
      x0 = x0 == tiles_x ? 0 : x0;
      x1 = last;
    }
#else
    x0 = first_cell(low, (float)TILE, tiles_x);
    x1 = max(x0, end_cell(high, (float)TILE, tiles_x));
#endif
  }
  const int y0 = first_cell(t->low_y - BOX_SLACK, (float)TILE, tiles_y);
  const int y1 = max(y0, end_cell(t->high_y + BOX_SLACK, (float)TILE, tiles_y));
  splat[RAY_COLUMNS] = as_float((uint)x0 | (uint)x1 << 16);
  splat[RAY_ROWS] = as_float((uint)y0 | (uint)y1 << 16);
}

COUNTING_GROUP __kernel void
project_rays(const uint n, const int coefficients, const int width, const int height, __constant float *camera,
             __global const float *means, __global const float *quaternions, __global const float *log_scales,
             __global const float *opacity_logits, __global const float *sh_dc, __global const shT *sh_rest,
             __global float *splats, __global uint *tile_counts
#ifdef SH_DEGREES
             ,
             __global const uchar *sh_degrees
#endif
#ifdef THINNED
             ,
             const uint model_row, const uint key0, const uint key1, const uint threshold, const float factor
#ifdef FIRST_ROWS
             ,
             __global const uint *first_rows
#endif
#endif
                 CHUNK_PARAMETERS COUNT_PARAMETERS) {
  BEGIN_COUNTS
  const int tiles_x = (width + TILE - 1) / TILE, tiles_y = (height + TILE - 1) / TILE;
  const size_t i = get_global_id(0);
  if (i >= n) LEAVE;
  SET_TILE_COUNT(i, 0);
#ifdef CHUNKS
  const long ahead = rows_ahead(chunks, i);
  if (i + ahead >= model_rows) LEAVE;
  MOVE_ROWS(ahead, )
#endif
  float opacity = sigmoidL(opacity_logits[i]);
#ifdef THINNED
  opacity *= thinning((uint)ROW_NUMBER(i) + model_row, key0, key1, threshold, factor);
#endif
  if (!(opacity > ALPHA_MIN)) LEAVE;
  RayProjection p;
  if (!project_ray(i, means, quaternions, log_scales, camera, &p)) LEAVE;
#ifdef ANTIALIASED
  opacity *= compensation(p.det0, p.det);
  if (!(opacity > ALPHA_MIN)) LEAVE;
#endif
  const float *f = p.f;
  const float sxx = p.sxx, sxy = p.sxy, syy = p.syy, det = p.det;

  const float l11 = WHITEN * sqrt(syy / det), l12 = -(sxy / syy) * l11, l22 = WHITEN / sqrt(syy);
  const float log2o = log2L(opacity);
  const float half_difference = 0.5f * (sxx - syy);
  const float largest = 0.5f * (sxx + syy) + sqrt(fma1(half_difference, half_difference, sxy * sxy));
  Box box;
  box_of(f, sqrt(EXTENT(log2o) * largest) / WHITEN * 1.0001f, camera, &box);
  __global float *splat = splats + (size_t)SPLAT_SIZE * i;
  store_box(&box, width, height, tiles_x, tiles_y, camera, splat);
  const Ellipse e = ellipse_of(splat, tiles_x, tiles_y);
  const uint count = tile_count(&e, tiles_x);
  if (count == 0) LEAVE;
  SET_TILE_COUNT(i, count);
  for (int k = 0; k < 3; ++k) {
    splat[RAY_FX + k] = f[k];
    splat[RAY_UX + k] = fma1(l11, p.t.e1[k], l12 * p.t.e2[k]);
  }
  const Tangent t = p.t;
  splat[RAY_VX] = l22 * t.e2[0];
  splat[RAY_VY] = l22 * t.e2[1];
  splat[RAY_VZ] = l22 * t.e2[2];
  splat[RAY_LOG2O] = log2o;
  splat[RAY_DEPTH] = p.distance;

  const float away[3] = {means[3 * i] - camera[CAMERA_PX], means[3 * i + 1] - camera[CAMERA_PY],
                         means[3 * i + 2] - camera[CAMERA_PZ]};
  const float far = sqrt(fma1(away[0], away[0], fma1(away[1], away[1], away[2] * away[2])));
  Lanes basis[16];
  sh_basis(SH_USED(coefficients), away[0] / far, away[1] / far, away[2] / far, &basis[0].all);
  const float4 colour = sh_colour(basis, 0, SH_OF_GAUSSIAN(i, coefficients), coefficients, sh_dc + 3 * i,
                                  sh_rest + 3 * (coefficients - 1) * i);
  if (!colour_is_drawn(colour)) {
    SET_TILE_COUNT(i, 0);
    LEAVE;
  }
  store_colour(colour, splat + RAY_RED);
  KEEP_ELLIPSE(e);
  COUNT_LISTS
}

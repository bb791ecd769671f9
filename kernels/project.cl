// Projection for perspective and orthographic cameras: each Gaussian's ellipse, colour, depth and number of tiles.
//
// Owner: A work-item owns LANES Gaussians. It projects in vectors, and computes tiles and colours one visible Gaussian
//   at a time. RasterizerConfig.extent sets how far a Gaussian reaches (shared/tile.h).
// Launch: One work-item for each LANES Gaussians, in groups of 64, or of ITEMS with COUNTS_LISTS; work-items past the
//   end do nothing.
// Buffers: means (n, 3): in world units. quaternions (n, 4): w x y z. log_scales (n, 3). opacity_logits (n). sh_dc (n,
//     3). sh_rest (n, coefficients - 1, 3).
//   sh_degrees (n), with SH_DEGREES: the highest SH degree that each Gaussian uses.
//   -> splats (n, SPLAT_SIZE): in pixels, depth in world units, written where visible. tile_counts (n): 0 where culled.
//   shown (n), with NO_FRUSTUM_CULL: 1 where a splat is written, including Gaussians without a tile.
//   THINNED leaves out each Gaussian whose random word is under `threshold`, and multiplies the opacities of the others
//     by `factor`. model_row: the first Gaussian's row in the model; key0, key1: the step's random key.
//   CHUNKS and FIRST_ROWS: see shared/chunks.h. COUNTS_LISTS, for LANES == 1: see shared/list_counts.h.
// Equations: docs/gradients.md, (1) to (13), (44) to (47) and (53) to (57); orthographic docs/cameras.md, (15) to (17);
//   Kerbl et al. 2023, section 4.
#include "shared/math.h"
#include "shared/tile.h"
#include "shared/list_counts.h"
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/gaussian.h"
#include "shared/sh.h"
#include "shared/chunks.h"
#ifdef THINNED
#include "shared/random.h"
#endif

COUNTING_GROUP __kernel void project(const uint n, const int coefficients, const int tiles_x, const int tiles_y,
                                     __constant float *camera, __global const float *means,
                                     __global const float *quaternions, __global const float *log_scales,
                                     __global const float *opacity_logits, __global const float *sh_dc,
                                     __global const shT *sh_rest, __global float *splats, __global uint *tile_counts
#ifdef NO_FRUSTUM_CULL
                                     ,
                                     __global uint *shown
#endif
#ifdef SH_DEGREES
                                     ,
                                     __global const uchar *sh_degrees
#endif
#ifdef THINNED
                                     ,
                                     const uint model_row, const uint key0, const uint key1, const uint threshold,
                                     const float factor
#ifdef FIRST_ROWS
                                     ,
                                     __global const uint *first_rows
#endif
#endif
                                         CHUNK_PARAMETERS COUNT_PARAMETERS) {
  BEGIN_COUNTS
#ifdef CHUNKS
  const uint first = get_global_id(0) * LANES;
  if (first >= n) LEAVE;
  // n is a whole number of chunks, so no vector reaches past n.
  for (uint lane = 0; lane < LANES; ++lane) SET_TILE_COUNT(first + lane, 0);
  const long ahead = rows_ahead(chunks, first);
  const uint end = end_of_rows(first, n, ahead, model_rows);
  MOVE_ROWS(ahead, )
#else
  const uint end = n;
#endif
  ROWS_OF_ITEM(end)
  for (uint lane = 0; lane < lanes_used; ++lane) SET_TILE_COUNT(first_row + lane, 0);
#ifdef NO_FRUSTUM_CULL
  for (uint lane = 0; lane < lanes_used; ++lane) shown[first_row + lane] = 0;
#endif
  Projection p;
  if (!project_gaussians(row, means, quaternions, log_scales, camera, &p)) LEAVE;
#ifdef ANTIALIASED
  floatL opacity = sigmoidL(GATHER(opacity_logits, 1, 0)) * compensation(p.det0, p.det);
#else
  floatL opacity = sigmoidL(GATHER(opacity_logits, 1, 0));
#endif
#ifdef THINNED
  Lanes left;
  for (uint lane = 0; lane < LANES; ++lane)
    left.lane[lane] = thinning((uint)ROW_NUMBER(first_row + lane) + model_row, key0, key1, threshold, factor);
  opacity *= left.all;
#endif
  floatL dx = FROM_CAMERA(means, X, 0), dy = FROM_CAMERA(means, Y, 1), dz = FROM_CAMERA(means, Z, 2);
  const floatL length = sqrt(fmaL(dx, dx, fmaL(dy, dy, dz * dz)));
  const intL seen = (length > 0.0f) & (length < FARTHEST);
  IntLanes valid;
  valid.all = p.valid & (opacity > ALPHA_MIN) & seen;
  if (!ANYL(valid.all)) LEAVE;

  Lanes field[SPLAT_SIZE];
  image_position(p.x, p.lx, p.z, p.lz, camera[CAMERA_FX], camera[CAMERA_FX_LOW], camera[CAMERA_CX],
                 camera[CAMERA_CX_LOW], camera[CAMERA_WINDOW_X], &field[SPLAT_PIXEL_X].all, &field[SPLAT_SUB_X].all);
  image_position(p.y, p.ly, p.z, p.lz, camera[CAMERA_FY], camera[CAMERA_FY_LOW], camera[CAMERA_CY],
                 camera[CAMERA_CY_LOW], camera[CAMERA_WINDOW_Y], &field[SPLAT_PIXEL_Y].all, &field[SPLAT_SUB_Y].all);
  // Equations (8), (44) of docs/gradients.md: Sigma^-1 = W^T W with W upper triangular. Stores WHITEN W.
  const floatL l11 = WHITEN * sqrt(p.syy / p.det);
  const floatL log2o = log2L(opacity);
  const floatL budget = (floatL)(EXTENT(log2o));
  field[SPLAT_L11].all = l11;
  field[SPLAT_L12].all = -(p.sxy / p.syy) * l11;
  field[SPLAT_L22].all = WHITEN / sqrt(p.syy);
  field[SPLAT_LOG2O].all = log2o;
  field[SPLAT_HALF_W].all = sqrt(budget * p.sxx) / WHITEN;
  field[SPLAT_HALF_H].all = sqrt(budget * p.syy) / WHITEN;
  field[SPLAT_DEPTH].all = p.z;
  field[SPLAT_INVERSE_L11].all = 1.0f / l11;
  dx = (floatL)(SEEN_ALONG(dx, length, camera[CAMERA_R20]));
  dy = (floatL)(SEEN_ALONG(dy, length, camera[CAMERA_R21]));
  dz = (floatL)(SEEN_ALONG(dz, length, camera[CAMERA_R22]));
  Lanes basis[16];
  sh_basis(SH_USED(coefficients), dx, dy, dz, &basis[0].all);

  for (uint lane = 0; lane < lanes_used; ++lane) {
    if (!valid.lane[lane]) continue;
    const size_t i = first_row + lane;
    __global float *splat = splats + (size_t)SPLAT_SIZE * i;
    const int fields[] = {SPLAT_PIXEL_X, SPLAT_PIXEL_Y, SPLAT_SUB_X, SPLAT_SUB_Y,  SPLAT_L11,    SPLAT_L12,
                          SPLAT_L22,     SPLAT_LOG2O,   SPLAT_DEPTH, SPLAT_HALF_W, SPLAT_HALF_H, SPLAT_INVERSE_L11};
    for (uint k = 0; k < sizeof(fields) / sizeof(fields[0]); ++k) splat[fields[k]] = field[fields[k]].lane[lane];
    const Ellipse e = ellipse_of(splat, tiles_x, tiles_y);
    const uint count = tile_count(&e, tiles_x);
#ifdef NO_FRUSTUM_CULL // RasterizerConfig.frustum_cull is off: a Gaussian counts as visible even without a tile
    shown[i] = 1;
#else
    if (count == 0) continue;
#endif
    SET_TILE_COUNT(i, count);
    const float4 colour = sh_colour(basis, lane, SH_OF_GAUSSIAN(i, coefficients), coefficients, sh_dc + 3 * i,
                                    sh_rest + 3 * (coefficients - 1) * i);
#ifndef UNGUARDED
    if (!colour_is_drawn(colour)) {
      SET_TILE_COUNT(i, 0);
#ifdef NO_FRUSTUM_CULL
      shown[i] = 0;
#endif
      continue;
    }
#endif
    store_colour(colour, splat + SPLAT_RED);
    KEEP_ELLIPSE(e);
  }
  COUNT_LISTS
}

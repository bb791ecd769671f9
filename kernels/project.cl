// Projection (Kerbl et al. 2023, section 4; docs/gradients.md, equations 1 to 13 and 44 to 47): each Gaussian to its
// ellipse, colour, depth and number of tiles. One work-item a Gaussian.
#include "shared/math.h"
#include "shared/splat.h"
#include "shared/tile.h"
#include "shared/gaussian.h"
#include "shared/sh.h"

// means (n, 3), quaternions (n, 4) w x y z, log_scales (n, 3), opacity_logits (n), sh_dc (n, 3),
// sh_rest (n, coefficients - 1, 3); splats (n, SPLAT_SIZE): written where visible; tile_counts (n): 0 where culled.
__kernel void project(const uint n, const int coefficients, const int tiles_x, const int tiles_y,
                      __constant float *camera, __global const float *means, __global const float *quaternions,
                      __global const float *log_scales, __global const float *opacity_logits,
                      __global const float *sh_dc, __global const float *sh_rest, __global float *splats,
                      __global uint *tile_counts) {
  const uint i = get_global_id(0);
  if (i >= n) return;
  tile_counts[i] = 0;
  Projection p;
  if (!project_gaussian(means + 3 * i, quaternions + 4 * i, log_scales + 3 * i, camera, &p)) return;
  const float opacity = sigmoid1(opacity_logits[i]);
  if (!(opacity > ALPHA_MIN)) return;

  __global float *splat = splats + (size_t)SPLAT_SIZE * i;
  image_position(p.x, p.lx, p.z, p.lz, camera[CAMERA_FX], camera[CAMERA_FX_LOW], camera[CAMERA_CX],
                 camera[CAMERA_CX_LOW], splat + SPLAT_PIXEL_X, splat + SPLAT_SUB_X);
  image_position(p.y, p.ly, p.z, p.lz, camera[CAMERA_FY], camera[CAMERA_FY_LOW], camera[CAMERA_CY],
                 camera[CAMERA_CY_LOW], splat + SPLAT_PIXEL_Y, splat + SPLAT_SUB_Y);
  // (8), (44): Sigma^-1 = W^T W with W upper triangular, stored as WHITEN W.
  const float l22 = WHITEN / sqrt(p.syy);
  const float l11 = WHITEN * sqrt(p.syy / p.det);
  const float log2o = log2_1(opacity);
  const float budget = EXTENT(log2o);
  splat[SPLAT_L11] = l11;
  splat[SPLAT_L12] = -(p.sxy / p.syy) * l11;
  splat[SPLAT_L22] = l22;
  splat[SPLAT_LOG2O] = log2o;
  splat[SPLAT_HALF_W] = sqrt(budget * p.sxx) / WHITEN;
  splat[SPLAT_HALF_H] = sqrt(budget * p.syy) / WHITEN;
  splat[SPLAT_DEPTH] = p.z;
  splat[SPLAT_INVERSE_L11] = 1.0f / l11;

  const Ellipse e = ellipse_of(splat, tiles_x, tiles_y);
  uint count = 0;
  for (int ty = e.tile_y0; ty < e.tile_y1; ++ty) {
    int x0, x1;
    tile_span(&e, ty, tiles_x, &x0, &x1);
    count += x1 - x0;
  }
  if (count == 0) return;

  float dx = means[3 * i] - camera[CAMERA_PX], dy = means[3 * i + 1] - camera[CAMERA_PY];
  float dz = means[3 * i + 2] - camera[CAMERA_PZ];
  const float length = sqrt(fma1(dx, dx, fma1(dy, dy, dz * dz)));
  if (!(length > 0.0f)) return;
  float basis[16];
  sh_basis(SH_USED(coefficients), dx / length, dy / length, dz / length, basis);
  float red = fma1(basis[0], sh_dc[3 * i], 0.5f);
  float green = fma1(basis[0], sh_dc[3 * i + 1], 0.5f);
  float blue = fma1(basis[0], sh_dc[3 * i + 2], 0.5f);
  __global const float *f = sh_rest + (size_t)3 * (coefficients - 1) * i;
  for (int k = 1; k < SH_USED(coefficients); ++k, f += 3) {
    red = fma1(basis[k], f[0], red);
    green = fma1(basis[k], f[1], green);
    blue = fma1(basis[k], f[2], blue);
  }
  splat[SPLAT_RED] = red > 0.0f ? red : 0.0f;
  splat[SPLAT_GREEN] = green > 0.0f ? green : 0.0f;
  splat[SPLAT_BLUE] = blue > 0.0f ? blue : 0.0f;
  tile_counts[i] = count;
}

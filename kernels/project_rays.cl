// Projection along rays, for equirectangular (RAYS == 1), fisheye (RAYS == 2) and perspective (RAYS == 3) cameras: each
// Gaussian to its ellipse on the plane that touches the sphere of directions at its mean's, where perspective bends it
// least; there is no pole and no seam.
//
// Owner: A work-item owns a Gaussian. Built with one lane: its bits are those of any shape.
// Launch: One work-item for each Gaussian, in groups of 64; those beyond the last do nothing.
// Buffers: As in project.cl, but for what that can leave out of a model that is held -> splats (n, RAY_SIZE),
//   directions in the camera's axes and distance in world units; tile_counts (n).
// Equations: docs/cameras.md, (8) to (14), (18), (19), (30), (32); colour docs/gradients.md, (12).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/tile.h"
#include "shared/gaussian.h"
#include "shared/sh.h"
#include "shared/angles.h"
#include "shared/rays.h"
#include "shared/tangent.h"
#ifdef THINNED
#include "shared/random.h"
#endif

// Slack of a box in pixels, over TILE_SLACK: what float32 angles lose of a picture 32768 wide.
#define BOX_SLACK 0.1f
#define NO_END 1e15f
#define LEAST_AHEAD 1e-4f // of a direction's length; less is beyond every picture

typedef struct {
  float low_x, high_x, low_y, high_y; // in pixels, not clamped
  int whole_rows;                     // it goes all the way round
} Box;

#if RAYS == 3
// (32), one side: where directions within an angle, of the sine `sine`, of one with the coordinates along and z are on
// the image, in focal lengths; without an end where they reach beyond the camera's plane.
static inline void side_of(float along, float z, float sine, float *low, float *high) {
  const float level = sqrt(fma1(along, along, z * z));
  *low = -NO_END;
  *high = NO_END;
  if (!(sine < 0.999f * level)) return;
  const float ratio = sine / level, cosine = sqrt(1.0f - ratio * ratio);
  const float ahead_low = fma1(cosine, z, ratio * along), ahead_high = fma1(cosine, z, -(ratio * along));
  if (ahead_low > LEAST_AHEAD * level) *low = fma1(cosine, along, -(ratio * z)) / ahead_low;
  if (ahead_high > LEAST_AHEAD * level) *high = fma1(cosine, along, ratio * z) / ahead_high;
}
#endif

// The box of all directions within an angle of f whose tangent is `reach`.
static inline void box_of(const float *f, float reach, __constant float *camera, Box *t) {
  const float fx = camera[CAMERA_FX], fy = camera[CAMERA_FY];
  const float cx = camera[CAMERA_CX] - camera[CAMERA_WINDOW_X], cy = camera[CAMERA_CY] - camera[CAMERA_WINDOW_Y];
  const float sine = reach / sqrt(fma1(reach, reach, 1.0f));
  t->whole_rows = 0;
#if RAYS == 3
  side_of(f[0], f[2], sine, &t->low_x, &t->high_x);
  side_of(f[1], f[2], sine, &t->low_y, &t->high_y);
  t->low_x = fma1(fx, t->low_x, cx);
  t->high_x = fma1(fx, t->high_x, cx);
  t->low_y = fma1(fy, t->low_y, cy);
  t->high_y = fma1(fy, t->high_y, cy);
#else
  const float cap = quarter_atan(reach, 1.0f);
#if RAYS == 1
  const float level = sqrt(fma1(f[0], f[0], f[2] * f[2]));
  const float latitude = f[1] < 0.0f ? -quarter_atan(-f[1], level) : quarter_atan(f[1], level);
  const float longitude = f[0] < 0.0f ? -half_atan(-f[0], f[2]) : half_atan(f[0], f[2]);
  t->low_y = fma1(fy, latitude - cap, cy);
  t->high_y = fma1(fy, latitude + cap, cy);
  if (!(sine < 0.999f * level)) { // a pole is in it, or nearly
    t->whole_rows = 1;
    t->low_x = t->high_x = 0.0f;
    return;
  }
  const float ratio = sine / level;
  const float half_width = quarter_atan(ratio, sqrt(1.0f - ratio * ratio));
  t->low_x = fma1(fx, longitude - half_width, cx);
  t->high_x = fma1(fx, longitude + half_width, cx);
#else
  const float across = sqrt(fma1(f[0], f[0], f[1] * f[1]));
  const float theta = half_atan(across, f[2]);
  const float far = theta + cap < FARTHEST_ANGLE(camera) ? theta + cap : FARTHEST_ANGLE(camera);
  const float outer = radius_of(far, camera);
  float middle_x = 0.0f, middle_y = 0.0f, half_x = outer, half_y = outer;
  if (sine < 0.999f * across && theta > cap && theta + cap < FARTHEST_ANGLE(camera)) {
    // the part of a ring about the axis, in a rectangle along the mean's direction from it
    const float ratio = sine / across, cosine = sqrt(1.0f - ratio * ratio);
    const float c = f[0] / across, s = f[1] / across;
    const float near = radius_of(theta - cap, camera) * cosine;
    const float middle = 0.5f * (near + outer), along = 0.5f * (outer - near), aside = outer * ratio;
    middle_x = middle * c;
    middle_y = middle * s;
    half_x = fma1(fabs(c), along, fabs(s) * aside);
    half_y = fma1(fabs(s), along, fabs(c) * aside);
  }
  t->low_x = fma1(fx, middle_x - half_x, cx);
  t->high_x = fma1(fx, middle_x + half_x, cx);
  t->low_y = fma1(fy, middle_y - half_y, cy);
  t->high_y = fma1(fy, middle_y + half_y, cy);
#endif
#endif
}

// The box's tiles, as `ellipse_of` takes them.
static inline void store_box(const Box *t, int width, int height, int tiles_x, int tiles_y, __constant float *camera,
                             __global float *splat) {
  int x0 = 0, x1 = tiles_x;
  if (!t->whole_rows) {
    float low = t->low_x - BOX_SLACK, high = t->high_x + BOX_SLACK;
#if RAYS == 1
    // The part that is shown begins here and ends a turn on; the picture may be less.
    const float turn = 2.0f * HALF_TURN * camera[CAMERA_FX], begin = 0.5f * ((float)width - turn);
    const float shift = turn * floor((low - begin) / turn);
    low -= shift;
    high -= shift;
    const int wraps = high >= begin + turn;
    const int last = wraps ? end_cell(high - turn, (float)TILE, tiles_x) : 0;
    x0 = first_cell(low, (float)TILE, tiles_x);
    x1 = wraps ? tiles_x : max(x0, end_cell(high, (float)TILE, tiles_x));
    if (last >= x0) { // its ends meet
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

__kernel void project_rays(const uint n, const int coefficients, const int width, const int height,
                           __constant float *camera, __global const float *means, __global const float *quaternions,
                           __global const float *log_scales, __global const float *opacity_logits,
                           __global const float *sh_dc, __global const shT *sh_rest, __global float *splats,
                           __global uint *tile_counts
#ifdef SH_DEGREES
                           ,
                           __global const uchar *sh_degrees
#endif
#ifdef THINNED
                           ,
                           const uint model_row, const uint key0, const uint key1, const uint threshold,
                           const float factor
#endif
) {
  const size_t i = get_global_id(0);
  if (i >= n) return;
  tile_counts[i] = 0;
  float opacity = sigmoidL(opacity_logits[i]);
#ifdef THINNED
  opacity *= thinning((uint)i + model_row, key0, key1, threshold, factor);
#endif
  if (!(opacity > ALPHA_MIN)) return;
  RayProjection p;
  if (!project_ray(i, means, quaternions, log_scales, camera, &p)) return;
#ifdef ANTIALIASED
  opacity *= compensation(p.det0, p.det);
  if (!(opacity > ALPHA_MIN)) return;
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
  const int tiles_x = (width + TILE - 1) / TILE, tiles_y = (height + TILE - 1) / TILE;
  store_box(&box, width, height, tiles_x, tiles_y, camera, splat);
  const Ellipse e = ellipse_of(splat, tiles_x, tiles_y);
  const uint count = tile_count(&e, tiles_x);
  if (count == 0) return;
  tile_counts[i] = count;
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
    tile_counts[i] = 0;
    return;
  }
  store_colour(colour, splat + RAY_RED);
}

// The gradient of colours from spherical harmonics, with respect to the coefficients and the directions. Only the
// library's calls use this kernel; a training uses shared/project_grad.h.
//
// Owner: A work-item owns LANES Gaussians.
// Launch: One work-item for each LANES Gaussians, in groups of 64; work-items past the end do nothing.
// Buffers: harmonics.cl's inputs; d_colours (n, 3).
//   colours (n, 3), with CAMERA: as harmonics.cl wrote them; a channel whose colour is 0 has no gradient.
//   -> d_sh (n, coefficients, 3): zero from coefficient `used` on.
//   d_directions (n, 3), with BY_DIRECTION: the gradients with respect to the directions, or with CAMERA to the means.
//   Masked rows become zero. ADDED adds the gradients to the values in d_sh, ADDED_DIRECTIONS to those in d_directions;
//     masked rows then stay unchanged.
//   by_centre (3, padded), with BY_CENTRE: each Gaussian's gradient with respect to the camera's centre, zero from n
//     on.
// Equations: docs/gradients.md, (38) to (40), (168).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/sh.h"
#include "shared/harmonics.h"

#ifdef ADDED
#define PUT(array, index, value) (array)[index] += (value)
#else
#define PUT(array, index, value) (array)[index] = (value)
#endif
#ifdef ADDED_DIRECTIONS
#define PUT_DIRECTION(array, index, value) (array)[index] += (value)
#else
#define PUT_DIRECTION(array, index, value) (array)[index] = (value)
#endif

__kernel void harmonics_grad(const uint n, const uint padded, const int coefficients, const int used, DIRECTIONS,
                             __global const float *sh, MASK __global const float *d_colours,
#ifdef CAMERA
                             __global const float *colours,
#endif
                             __global float *d_sh
#ifdef BY_DIRECTION
                             ,
                             __global float *d_directions
#endif
#ifdef BY_CENTRE
                             ,
                             __global float *by_centre
#endif
) {
  const uint first_row = get_global_id(0) * LANES;
  if (first_row >= padded) return;
  uint row[LANES];
  for (uint lane = 0; lane < LANES; ++lane) row[lane] = first_row + lane < n ? first_row + lane : n - 1;
  Direction d;
  Lanes basis[MOST_COEFFICIENTS], weight[MOST_COEFFICIENTS];
  IntLanes shown;
  shown.all = (intL)(0);
  direction_of(row, DIRECTIONS_GIVEN, &d);
  sh_basis(used, d.v[0], d.v[1], d.v[2], &basis[0].all);
#ifdef DEGREE_4
  band_4(d.v[0], d.v[1], d.v[2], &basis[0].all);
#endif
  for (int k = 0; k < MOST_COEFFICIENTS; ++k) weight[k].all = (floatL)(0.0f);
  for (uint lane = 0; lane < LANES; ++lane) {
    const size_t i = first_row + lane;
    if (i >= n) break;
    __global const float *f = sh + 3 * coefficients * i;
    __global float *d_f = d_sh + 3 * coefficients * i;
    if (HIDDEN(i)) {
#ifndef ADDED
      for (int k = 0; k < 3 * coefficients; ++k) d_f[k] = 0.0f;
#endif
      continue;
    }
    shown.lane[lane] = -1;
    float red = d_colours[3 * i], green = d_colours[3 * i + 1], blue = d_colours[3 * i + 2];
#ifdef CAMERA
    red = colours[3 * i] > 0.0f ? red : 0.0f;
    green = colours[3 * i + 1] > 0.0f ? green : 0.0f;
    blue = colours[3 * i + 2] > 0.0f ? blue : 0.0f;
#endif
    for (int k = 0; k < used; ++k, f += 3, d_f += 3) {
      const float along = basis[k].lane[lane];
      PUT(d_f, 0, along * red);
      PUT(d_f, 1, along * green);
      PUT(d_f, 2, along * blue);
#ifdef BY_DIRECTION
      weight[k].lane[lane] = fma1(red, f[0], fma1(green, f[1], blue * f[2]));
#endif
    }
#ifndef ADDED
    for (int k = 3 * used; k < 3 * coefficients; ++k, ++d_f) *d_f = 0.0f;
#endif
  }
#ifdef BY_DIRECTION
  floatL by_unit[3];
  Lanes by[3];
  sh_direction_gradient(used, d.v[0], d.v[1], d.v[2], &weight[0].all, by_unit);
#ifdef DEGREE_4
  add_band_4_gradient(d.v[0], d.v[1], d.v[2], &weight[0].all, by_unit);
#endif
  const floatL along = fmaL(by_unit[0], d.v[0], fmaL(by_unit[1], d.v[1], by_unit[2] * d.v[2]));
  FOR_AXES(k) by[k].all = shown.all ? d.scale * fmaL(-along, d.v[k], by_unit[k]) : (floatL)(0.0f);
  for (uint lane = 0; lane < LANES; ++lane) {
    const size_t i = first_row + lane;
    if (i >= n) break;
#ifdef ADDED_DIRECTIONS
    if (HIDDEN(i)) continue;
#endif
    for (int k = 0; k < 3; ++k) PUT_DIRECTION(d_directions, 3 * i + k, by[k].lane[lane]);
  }
#ifdef BY_CENTRE
  FOR_AXES(k) STOREL(-by[k].all, by_centre + (size_t)k * padded + first_row);
#endif
#endif
}

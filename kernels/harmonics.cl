// Colours from spherical harmonics, in given directions or in the directions from a camera's centre to the means. Only
// the library's calls use this kernel; renders and trainings use project.cl and shared/sh.h.
//
// Owner: A work-item owns LANES Gaussians. It computes the SH bases in vectors, and the colours one Gaussian at a time.
// Launch: One work-item for each LANES Gaussians, in groups of 64; work-items past the end do nothing.
// Buffers: directions (n, 3): of any length. With CAMERA, their place is taken by means (n, 3) in world units and
//     centre (6), high parts before low parts.
//   sh (n, coefficients, 3): the first `used` coefficients are read, up to 25 with DEGREE_4.
//   mask (n, mask_width), with MASKED: rows whose first entry is not positive are skipped.
//   -> colours (n, 3): zero in skipped rows. With CAMERA, 0.5 is added and the colour is clamped at 0. A direction of
//     length 0 uses only the first coefficient.
// Equations: docs/gradients.md, (12) and (167); the basis is in docs/conventions.md.
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/sh.h"
#include "shared/harmonics.h"

__kernel void harmonics(const uint n, const int coefficients, const int used, DIRECTIONS, __global const float *sh,
                        MASK __global float *colours) {
  ROWS_OF_ITEM(n)
  Direction d;
  Lanes basis[MOST_COEFFICIENTS];
  direction_of(row, DIRECTIONS_GIVEN, &d);
  sh_basis(used, d.v[0], d.v[1], d.v[2], &basis[0].all);
#ifdef DEGREE_4
  band_4(d.v[0], d.v[1], d.v[2], &basis[0].all);
#endif
  for (uint lane = 0; lane < lanes_used; ++lane) {
    const size_t i = first_row + lane;
    if (HIDDEN(i)) {
      for (int k = 0; k < 3; ++k) colours[3 * i + k] = 0.0f;
      continue;
    }
    __global const float *f = sh + 3 * coefficients * i;
    float4 colour = (float4)(COLOUR_OFFSET);
    for (int k = 0; k < used; ++k, f += 3)
      colour = sh_fma(basis[k].lane[lane], sh_channels(f, k + 1 == coefficients), colour);
#ifdef CAMERA
    store_colour(colour, colours + 3 * i);
#else
    colours[3 * i] = colour.x;
    colours[3 * i + 1] = colour.y;
    colours[3 * i + 2] = colour.z;
#endif
  }
}

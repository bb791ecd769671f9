// The colour model `ppisp`: removes a photograph's gains, its colour mixes and its lens's vignette from its pixels, and
// computes the gradient with respect to them. It is for photographs by cameras that process colours differently.
//
// Owner: As in shared/develop.h, which contains the kernels.
// Launch: As in shared/develop.h.
// Buffers: As in shared/develop.h. A photograph's entries are three gains, then six mixes: for each channel c, the
//   mixes from channels c + 1 and c + 2, modulo 3. A lens's entries are the coefficients of its vignette.
// Equations: docs/gradients.md, "Colours and vignettes".
#include "shared/math.h"
#include "shared/lanes.h"

#define ENTRIES 9
#define LENS_ENTRIES 3
#define MOST_FALLOFF 16.0f

static inline void developed(floatL *colour, const floatL s, __global const float *gain, __global const float *logs,
                             __global const float *vignette) {
  __global const float *mix = logs + 3;
  const floatL falloff = s * fmaL(s, fmaL(s, (floatL)(vignette[2]), (floatL)(vignette[1])), (floatL)(vignette[0]));
  const floatL lens_light = exp2L(clamp(falloff, (floatL)(-MOST_FALLOFF), (floatL)(MOST_FALLOFF)));
  const floatL r = colour[0] / (gain[0] * lens_light), g = colour[1] / (gain[1] * lens_light),
               b = colour[2] / (gain[2] * lens_light);
  colour[0] = fmaL((floatL)(mix[1]), r - b, fmaL((floatL)(mix[0]), r - g, r));
  colour[1] = fmaL((floatL)(mix[3]), g - r, fmaL((floatL)(mix[2]), g - b, g));
  colour[2] = fmaL((floatL)(mix[5]), b - g, fmaL((floatL)(mix[4]), b - r, b));
}

static inline void add_terms(floatL *sums, const floatL *colour, const floatL *by_colour, const floatL s) {
  const floatL r = colour[0], g = colour[1], b = colour[2];
  const floatL by_r = by_colour[0], by_g = by_colour[1], by_b = by_colour[2];
  sums[0] = fmaL(r, by_r, sums[0]), sums[1] = fmaL(g, by_g, sums[1]), sums[2] = fmaL(b, by_b, sums[2]);
  sums[3] = fmaL(g - r, by_r, sums[3]), sums[4] = fmaL(b - r, by_r, sums[4]);
  sums[5] = fmaL(b - g, by_g, sums[5]), sums[6] = fmaL(r - g, by_g, sums[6]);
  sums[7] = fmaL(r - b, by_b, sums[7]), sums[8] = fmaL(g - b, by_b, sums[8]);
  const floatL brighter = fmaL(b, by_b, fmaL(g, by_g, r * by_r)), s2 = s * s;
  sums[9] = fmaL(s, brighter, sums[9]), sums[10] = fmaL(s2, brighter, sums[10]);
  sums[11] = fmaL(s2 * s, brighter, sums[11]);
}

#include "shared/develop.h"

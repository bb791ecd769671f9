// The colour model `exposure`: removes a photograph's gain in each channel, its exposure and white balance, from its
// pixels, and computes the gradient with respect to the gains.
//
// Owner: As in shared/develop.h, which contains the kernels.
// Launch: As in shared/develop.h.
// Buffers: As in shared/develop.h; a photograph's entries are three gains; a lens has no entries.
// Equations: docs/gradients.md, "Appearance".
#include "shared/math.h"
#include "shared/lanes.h"

#define ENTRIES 3
#define LENS_ENTRIES 0

static inline void developed(floatL *colour, const floatL s, __global const float *gain, __global const float *logs,
                             __global const float *lens) {
  for (int c = 0; c < 3; ++c) colour[c] /= gain[c];
}

static inline void add_terms(floatL *sums, const floatL *colour, const floatL *by_colour, const floatL s) {
  for (int c = 0; c < 3; ++c) sums[c] = fmaL(colour[c], by_colour[c], sums[c]);
}

#include "shared/develop.h"

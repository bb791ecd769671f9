// The kernels of a colour model (exposure.cl, ppisp.cl). They remove a photograph's own colours pixel by pixel, and
// compute the gradient with respect to the model's entries. appearance.cl updates the entries. A colour model's file
// defines, before it includes this header:
//   ENTRIES: number of entries of a photograph, of which the first three are gains. LENS_ENTRIES: number of entries of
//     a lens.
//   developed: removes a photograph's own colours from LANES pixels, in place.
//   add_terms: adds the terms of LANES pixels to the gradient's ENTRIES + LENS_ENTRIES sums. The sums for gains and for
//     lenses leave out a factor ln 2, which appearance.cl applies.
// The argument s of both functions is the squared distance of the pixels from the principal point, in squared half
// diagonals; 0 for panoramas.
//
// Owner: A work-item owns LANES neighbouring pixels (develop), or LANES columns of a tile row (entry_sums). Sums are
//   added in the same order on every device, and with any LANES and ITEMS.
// Launch: Grids of work-items: stride / LANES x rows (develop) and stride / LANES x tiles_y (entry_sums).
// Buffers: target, image, gradient (3, rows, stride): colour, or the loss's gradient with respect to colour; gains,
//   logs (photographs, ENTRIES): gains are 2^logs; lenses (lenses, LENS_ENTRIES); partials (ENTRIES + LENS_ENTRIES,
//   tiles_y, stride).

#define SUMS (ENTRIES + LENS_ENTRIES)

// The squared distances of LANES pixels from the point (across, down) of the image, times `scale`.
static inline floatL spread(const int x, const int y, const float across, const float down, const float scale) {
  const floatL from_x = (floatL)((float)x + 0.5f) + LANE_INDEX - across;
  const float from_y = (float)y + 0.5f - down;
  return fmaL(from_x, from_x, (floatL)(from_y * from_y)) * scale;
}

// Removes a photograph's own colours from `target`, in place; the render is compared with the result. logs: the entries
// of all photographs; gains: 2^logs; lenses: the entries of all lenses.
__kernel void develop(const int photograph, const int lens, const int stride, const int plane, const float across,
                      const float down, const float scale, __global const float *gains, __global const float *logs,
                      __global const float *lenses, __global float *target) {
  const int x = LANES * get_global_id(0), y = get_global_id(1);
  const size_t at = (size_t)stride * y + x, next = plane + at, last = (size_t)plane * 2 + at;
  floatL colour[3] = {LOADL(target + at), LOADL(target + next), LOADL(target + last)};
  developed(colour, spread(x, y, across, down, scale), gains + ENTRIES * photograph, logs + ENTRIES * photograph,
            lenses + LENS_ENTRIES * lens);
  STOREL(colour[0], target + at), STOREL(colour[1], target + next), STOREL(colour[2], target + last);
}

// Sums the gradients with respect to the entries over the rows of a tile. image: the render; gradient: the loss's
// gradient with respect to the render -> partials.
__kernel void entry_sums(const int height, const int stride, const int plane, const int tiles_y, const float across,
                         const float down, const float scale, __global const float *image,
                         __global const float *gradient, __global float *partials) {
  const int x = LANES * get_global_id(0), y0 = get_global_id(1) * TILE, y1 = min(y0 + TILE, height);
  floatL sums[SUMS];
  for (int k = 0; k < SUMS; ++k) sums[k] = (floatL)(0.0f);
  for (int y = y0; y < y1; ++y) {
    const size_t at = (size_t)stride * y + x, next = plane + at, last = (size_t)plane * 2 + at;
    const floatL colour[3] = {LOADL(image + at), LOADL(image + next), LOADL(image + last)};
    const floatL by_colour[3] = {LOADL(gradient + at), LOADL(gradient + next), LOADL(gradient + last)};
    add_terms(sums, colour, by_colour, spread(x, y, across, down, scale));
  }
  const size_t of_sum = (size_t)tiles_y * stride;
  for (int k = 0; k < SUMS; ++k) STOREL(sums[k], partials + k * of_sum + (size_t)stride * get_global_id(1) + x);
}

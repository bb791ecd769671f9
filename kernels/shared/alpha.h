// The pixels of a tile, and the alpha of a Gaussian there: blend and blend_grad must agree to the last bit, or the
// transmittance that the gradient recovers by division is another one.
//
// A tile has VECTORS vectors of LANES pixels, HALVES to a row; vector v is pixels [LANES (v % HALVES), ...) of row
// v / HALVES. A group has ITEMS work-items; item k owns vectors k, k + ITEMS, ...
#define HALVES (TILE / LANES)
#define VECTORS (TILE * HALVES)
#if ITEMS > VECTORS
#error "more work-items than vectors in a tile"
#endif
#define OWNED (VECTORS / ITEMS)

// log2 of alpha before the cap: base = LOG2O - v^2 of the row, u along the row.
static inline floatL log2_alpha(floatL offset_u, float l12_dy, float base) {
  const floatL u = offset_u + l12_dy;
  return fmaL(-u, u, (floatL)(base));
}

// Rows [*y0, *y1) and halves [*h0, *h1) of the tile at (x, y) that the Gaussian's box reaches.
static inline void tile_box(__global const float *splat, float x, float y, int *y0, int *y1, int *h0, int *h1) {
  const float my = splat[SPLAT_MY] - y, mx = splat[SPLAT_MX] - x;
  const float half_h = splat[SPLAT_HALF_H], half_w = splat[SPLAT_HALF_W];
  *y0 = first_cell(my - half_h, 1.0f, TILE);
  *y1 = end_cell(my + half_h, 1.0f, TILE);
#if HALVES == 1
  *h0 = 0;
  *h1 = 1;
#else
  *h0 = first_cell(mx - half_w, (float)LANES, HALVES);
  *h1 = end_cell(mx + half_w, (float)LANES, HALVES);
#endif
}

// Visit the owned vectors within the box: a nested loop on a CPU, a test of each owned one otherwise.
#if ITEMS == 1
#define FOR_VECTORS(row, part, k)                                                                                     \
  for (int row = y0; row < y1; ++row)                                                                                 \
    for (int part = h0, k = row * HALVES + h0; part < h1; ++part, ++k)
#else
#define FOR_VECTORS(row, part, k)                                                                                     \
  for (int k = 0, vector = get_local_id(0), row = vector / HALVES, part = vector % HALVES; k < OWNED;                 \
       ++k, vector += ITEMS, row = vector / HALVES, part = vector % HALVES)                                           \
    if (row >= y0 && row < y1 && part >= h0 && part < h1)
#endif

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

#define FINISHED -100.0f // log2 of an alpha that reaches nothing, for pixels that take no more

// Whether a vector has a pixel that the Gaussian reaches: `open` is log2(alpha), `power` the same but for FINISHED in
// pixels that take no more. RasterizerConfig: vector_skip, early_stop.
#ifdef NO_VECTOR_SKIP
#define REACHES(open, power) 1
#elif defined(NO_EARLY_STOP)
#define REACHES(open, power) ANYL((open) >= LOG2_ALPHA_MIN)
#else
#define REACHES(open, power) ANYL((power) >= LOG2_ALPHA_MIN)
#endif

// log2 of alpha before the cap: base = LOG2O - v^2 of the row, u along the row.
static inline floatL log2_alpha(floatL offset_u, float l12_dy, float base) {
  const floatL u = offset_u + l12_dy;
  return fmaL(-u, u, (floatL)(base));
}

// From the first pixel's centre to the mean: whole pixels apart from the rest, which a float32 of the sum would cut.
#define FROM_TILE(splat, axis, origin)                                                                                \
  ((splat[SPLAT_PIXEL_##axis] - (float)(origin)) + (splat[SPLAT_SUB_##axis] - 0.5f))

// Rows [*y0, *y1) and halves [*h0, *h1) of the tile at (x, y) that the Gaussian's box reaches.
static inline void tile_box(__global const float *splat, float x, float y, int *y0, int *y1, int *h0, int *h1) {
  const float mx = (splat[SPLAT_PIXEL_X] - x) + splat[SPLAT_SUB_X];
  const float my = (splat[SPLAT_PIXEL_Y] - y) + splat[SPLAT_SUB_Y];
  const float half_h = splat[SPLAT_HALF_H], half_w = splat[SPLAT_HALF_W];
#ifdef NO_ROW_SKIP
  *y0 = 0;
  *y1 = TILE;
#else
  *y0 = first_cell(my - half_h, 1.0f, TILE);
  *y1 = end_cell(my + half_h, 1.0f, TILE);
#endif
#if HALVES == 1 || defined(NO_COLUMN_SKIP)
  *h0 = 0;
  *h1 = HALVES;
#else
  *h0 = first_cell(mx - half_w, (float)LANES, HALVES);
  *h1 = end_cell(mx + half_w, (float)LANES, HALVES);
#endif
}

// Visit the owned vectors within the box, part by part and down the rows: on a CPU a loop whose sums stay in registers
// and whose end is mispredicted once a part; otherwise a test of each vector that the item owns.
#if ITEMS == 1
#define FOR_PARTS(part) for (int part = h0; part < h1; ++part)
#define FOR_ROWS(row, k, part) for (int row = y0, k = y0 * HALVES + part; row < y1; ++row, k += HALVES)
#else
#if ITEMS % HALVES
#error "an item's vectors must all lie in one part of the rows"
#endif
#define FOR_PARTS(part)                                                                                               \
  for (int part = get_local_id(0) % HALVES, left = part >= h0 && part < h1; left; left = 0)
#define FOR_ROWS(row, k, part)                                                                                        \
  for (int k = 0, row = get_local_id(0) / HALVES; k < OWNED; ++k, row += ITEMS / HALVES)                              \
    if (row >= y0 && row < y1)
#endif

// The gradient of blending with one Gaussian per work-item (BY_GAUSSIAN), for blend_grad.cl. The items of a group pass
// over the pixels of a tile, one item behind the other. Each item has a Gaussian and its sums in registers; the state
// of the pixels is in local memory.
//
// The pixels are divided into ITEMS chunks, each a part of a row. In round r item j processes chunk (r - j) % ITEMS,
// and a barrier ends the round. So the Gaussians come to each chunk in order. After all chunks, an item begins its next
// Gaussian in the next round. Values that are constant in a row are computed once per chunk.
#if ITEMS < 16 || ITEMS > 128
#error "a chunk is a row of a tile, or a part of one of two pixels or more"
#endif
#define CHUNK (TILE * TILE / ITEMS) // number of pixels of a chunk
#define ROW_CHUNKS (TILE / CHUNK)
// CHUNK_BLOCKS: number of blocks (blocks.h) that a chunk's pixels are in. CHUNK_BLOCK: the first of these blocks.
#define CHUNK_BLOCKS (CHUNK < BLOCK_W ? 1 : CHUNK / BLOCK_W)
#define CHUNK_BLOCK(chunk) ((chunk) / ROW_CHUNKS / BLOCK_H * BLOCK_COLUMNS + (chunk) % ROW_CHUNKS * CHUNK / BLOCK_W)

// The index of pixel (x, y) in the arrays of Passing and of Fixed. Items at adjacent chunks read adjacent elements.
#define PLACE(x, y) ((x) % CHUNK * ITEMS + (y) * ROW_CHUNKS + (x) / CHUNK)

// A pixel in local memory. Passing has the values that change, the transmittance and the light behind (behind.h). Fixed
// has the image's gradient, and the bits of the pixel's entry of `stops`.
typedef float2 Passing;
typedef float4 Fixed;

// The Gaussian that an item currently processes. i: the index of the pair, less than `begin` if there is none; blocks:
// the blocks that the ellipse reaches; slot: the pair's slot.
typedef struct {
  float mx, my, l11, l12, l22, log2o, red, green, blue;
  int i;
  uint blocks, slot;
#ifdef NEARNESS
  float near;
#endif
} Walker;

// With NEARNESS, `near` is the gradient with respect to the nearness of a tile's pixels, in the order of Passing and
// Fixed.
#ifdef NEARNESS
#define NEAR_OF_STAGED , s.near
#define NEAR_PIXELS , near
#define NEAR_PIXELS_PARAMETER , __local const float *near
#else
#define NEAR_OF_STAGED
#define NEAR_PIXELS
#define NEAR_PIXELS_PARAMETER
#endif

// Undoes the blending of *w's pair in a chunk of pixels (CHUNK pixels of one row of the tile), and adds their gradients
// to `sums`, the pair's SLOT_STRIDE sums. Pixels to which the pair was not added are processed with alpha 0, without a
// branch. Of 32 items, one nearly always has a pixel to which its pair was added, so branches would only serialise the
// pixels of a chunk.
static inline void take_chunk(const Walker *w, int chunk, __local Passing *passing, __local const Fixed *fixed,
                              float *sums NEAR_PIXELS_PARAMETER) {
  const float dy = w->my - (float)(chunk / ROW_CHUNKS), v = w->l22 * dy;
  const float left = (float)(chunk % ROW_CHUNKS * CHUNK);
  float g_row = 0.0f, gu_row = 0.0f; // sums of g and g u; v is constant in a row
  _Pragma("unroll") for (int k = 0; k < CHUNK; ++k) {
    const int place = k * ITEMS + chunk;
    const Fixed pixel = fixed[place];
    const Passing state = passing[place];
    const float u = whitened_u(w->l11, w->l12, w->mx - (left + (float)k), dy);
    const float power = log2_alpha(u, v, w->log2o);
    const int taken = MASKL(power >= LOG2_ALPHA_MIN) & MASKL(w->i < as_int(pixel.w));
    const float uncapped = as_float(as_int(exp2L(power)) & taken);
    float t = state.x, behind = state.y, difference = -behind;
#ifdef NEARNESS
    difference = fmaL(near[place], w->near, difference);
#endif
    difference = fmaL(pixel.x, w->red, fmaL(pixel.y, w->green, fmaL(pixel.z, w->blue, difference)));
    const Share share = take_out_of(&t, &behind, uncapped, difference);
    const float g = share.g, weight = share.weight, gu = g * u;
    passing[place] = (Passing)(t, behind);
    sums[SLOT_RED] = fmaL(weight, pixel.x, sums[SLOT_RED]);
    sums[SLOT_GREEN] = fmaL(weight, pixel.y, sums[SLOT_GREEN]);
    sums[SLOT_BLUE] = fmaL(weight, pixel.z, sums[SLOT_BLUE]);
    sums[SLOT_GUU] = fmaL(gu, u, sums[SLOT_GUU]);
    g_row += g;
    gu_row += gu;
#ifdef ABSOLUTE_GRADIENTS
    sums[SLOT_ABSX] += fabs(g * (w->l11 * u));
    sums[SLOT_ABSY] += fabs(g * fmaL(w->l12, u, w->l22 * v));
#endif
#ifdef CONTRIBUTIONS
    sums[SLOT_WEIGHT] += weight;
#endif
#ifdef NEARNESS
    sums[SLOT_NEAR] = fmaL(weight, near[place], sums[SLOT_NEAR]);
#endif
  }
  const float gv_row = v * g_row;
  sums[SLOT_G] += g_row;
  sums[SLOT_GU] += gu_row;
  sums[SLOT_GV] += gv_row;
  sums[SLOT_GUV] = fmaL(v, gu_row, sums[SLOT_GUV]);
  sums[SLOT_GVV] = fmaL(v, gv_row, sums[SLOT_GVV]);
}

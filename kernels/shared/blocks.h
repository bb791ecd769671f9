// The counterpart of cells.h for a group of ITEMS work-items that share a tile. A cell is one pixel of a block of 4 x 8
// pixels. Each block has 32 items, one per pixel, so that items that run together skip a block together. In groups of
// fewer than 32 items, blocks have fewer rows. Items that own the same blocks are called a warp here, whether or not
// the device runs 32 items together.
//
// Item i owns pixel i % 32 of each of OWNED blocks; these pixels are its cells 0, 1 and so on. An item's blocks in a
// row of blocks are side by side, so that the item computes values that depend only on y once for all of them. Splats
// pass through local memory in batches, each splat with the set of blocks that its ellipse reaches.
#if LANES > 1
#error "a group of work-items has one pixel a vector"
#endif
#define BLOCK_ITEMS (ITEMS < 32 ? ITEMS : 32)
#define BLOCK_W 4
#define BLOCK_H (BLOCK_ITEMS / BLOCK_W)
#define BLOCK_COLUMNS (TILE / BLOCK_W)
#define BLOCK_ROWS (TILE / BLOCK_H)
#define OWNED (TILE * TILE / ITEMS)
#define ITEM ((int)get_local_id(0))
#define WARPS (ITEMS / BLOCK_ITEMS)
#if ITEMS <= 32
#define WARP 0
#define LANE ITEM
#else
#define WARP (ITEM / BLOCK_ITEMS)
#define LANE (ITEM % BLOCK_ITEMS)
#endif

#define OWN_BLOCK(cell) (WARP * OWNED + (cell))
#define CELL_X(cell) ((WARP * OWNED % BLOCK_COLUMNS + (cell) % BLOCK_COLUMNS) * BLOCK_W + LANE % BLOCK_W)
#define CELL_Y(cell) ((WARP * OWNED / BLOCK_COLUMNS + (cell) / BLOCK_COLUMNS) * BLOCK_H + LANE / BLOCK_W)
#define CELL_IN_PLANE(cell) (stride * (tile_y + CELL_Y(cell)) + tile_x + CELL_X(cell))
#define LANE_IN_PLANE(lane) 0
#define PIXELS_X(cell) ((float)CELL_X(cell))
#define PIXELS_Y(cell) ((float)CELL_Y(cell))
#define AT_X(cell) PIXELS_X(cell)
#define AT_Y(cell) PIXELS_Y(cell)
#define PIXEL_TABLES
#define LOAD_CELL(type, p, stride) (*(p))
#define STORE_CELL(type, x, p, stride) (*(p) = (x))

#if TILE * TILE / ITEMS <= 8 // cells that fit in registers, with constant indices
#define UNROLLED _Pragma("unroll")
#else
#define UNROLLED
#endif
#define ROLLED _Pragma("unroll 1")
#define ALL_CELLS(cell) UNROLLED for (int cell = 0; cell < OWNED; ++cell)

typedef int Open; // number of the item's cells with an open pixel
#define OPEN_CELL(open, cell) (++(open))
#define CLOSE_CELL(open, cell) (--(open))

// A set of blocks: one bit for each block, beginning with the item's first block.
typedef uint Reach;
#define BLOCKS (BLOCK_COLUMNS * BLOCK_ROWS)
#define ALL_BLOCKS (0xffffffffu >> (32 - BLOCKS))
#define FIRST_BLOCKS(count) (0xffffffffu >> (32 - (count)))
#define OF_FIRST_WARP FIRST_BLOCKS(OWNED)
#define FROM_OWN(blocks) ((blocks) >> (WARP * OWNED))
#define FOR_CELLS(cell, reach) ALL_CELLS(cell) if ((reach) >> cell & 1)

// Returns all blocks: in kernels that read one splat at a time, testing blocks would cost more than blending their
// pixels.
static inline Reach reach_of(__global const float *splat, int tile_x, int tile_y) { return ALL_BLOCKS; }

#if defined(RAYS) || (defined(NO_ROW_SKIP) && defined(NO_COLUMN_SKIP))
#define ALL_REACHED 1
static inline uint blocks_of(const float *splat, int tile_x, int tile_y) { return ALL_BLOCKS; }
#else
#define ALL_REACHED 0
// The right edge of an ellipse in the rows whose offsets from the mean are in [d0, d1], relative to the mean
// (equation (47) of docs/gradients.md). The square root, and so the edge, may be up to 0.2 % too large.
static inline float block_edge(float d0, float d1, float tangent, float half_w, float l12, float l22, float inverse_l11,
                               float budget) {
  const float dy = tangent < d0 ? d0 : d1, v = l22 * dy;
  const float rest = max(budget - v * v, 0.0f);
  const float y = as_float(0x5f375a86 - (as_int(rest) >> 1)), root = rest * y; // Newton's step, as in cells.h
  const float edge = (root * (1.502f - 0.5f * (root * y)) - l12 * dy) * inverse_l11;
  return tangent >= d0 && tangent <= d1 ? half_w : edge;
}

// The blocks that an ellipse reaches, a bit for each block.
static inline uint blocks_of(const float *splat, int tile_x, int tile_y) {
  const float mx = (splat[SPLAT_PIXEL_X] - (float)tile_x) + splat[SPLAT_SUB_X];
  const float my = (splat[SPLAT_PIXEL_Y] - (float)tile_y) + splat[SPLAT_SUB_Y];
  const float half_w = splat[SPLAT_HALF_W], half_h = splat[SPLAT_HALF_H];
  const float l12 = splat[SPLAT_L12], l22 = splat[SPLAT_L22], inverse_l11 = splat[SPLAT_INVERSE_L11];
  const float budget = EXTENT(splat[SPLAT_LOG2O]) + 0.01f;
  const float tangent = -l12 * splat[SPLAT_L11] / (l22 * l22 + l12 * l12) * half_w;
  uint blocks = 0;
  for (int row = 0; row < BLOCK_ROWS; ++row) {
    float d0 = (float)(row * BLOCK_H) + (0.5f - TILE_SLACK) - my;
    float d1 = d0 + ((float)BLOCK_H - 1.0f + 2.0f * TILE_SLACK);
#ifdef NO_ROW_SKIP // RasterizerConfig.row_skip is off
    d0 = -half_h;
    d1 = half_h;
#endif
    d0 = max(d0, -half_h);
    d1 = min(d1, half_h);
    const float right = mx + block_edge(d0, d1, tangent, half_w, l12, l22, inverse_l11, budget);
    const float left = mx - block_edge(-d1, -d0, tangent, half_w, l12, l22, inverse_l11, budget);
    for (int column = 0; column < BLOCK_COLUMNS; ++column) {
      const float first = (float)(column * BLOCK_W) + (0.5f - TILE_SLACK);
#ifdef NO_COLUMN_SKIP // RasterizerConfig.column_skip is off
      const int reached = d0 <= d1;
#else
      const int reached = d0 <= d1 && right >= first && left <= first + ((float)BLOCK_W - 1.0f + 2.0f * TILE_SLACK);
#endif
      blocks |= reached ? 1u << (row * BLOCK_COLUMNS + column) : 0;
    }
  }
  return blocks;
}
#endif

// BATCH: number of splats that the group's items fetch together into local memory, where all items read them. Every
// item fetches the same number of splats, and at the list's end the last splat again. The reason: a compiler that
// vectorises across items may read memory for idle items too.
#ifndef BATCH
#define BATCH (ITEMS < 64 ? 64 : ITEMS)
#endif
#define FETCHES ((BATCH + ITEMS - 1) / ITEMS) // number of splats of a batch that each item fetches
#define FOR_FETCHES(fetch) UNROLLED for (int fetch = 0; fetch < FETCHES; ++fetch)
typedef struct {
  float mx, my, l11, l12; // mx, my: the mean, relative to the tile's first pixel
  float l22, log2o, red, green;
  float blue;
  uint kept, blocks, slot; // kept: see KEPT; blocks: those that the ellipse reaches; slot: the pair's slot
#ifdef NEARNESS
  float near;     // nearness, 1 / depth
  uint unused[3]; // padding to 16 bytes; set to 0, so that copies read no uninitialised memory
#endif
} __attribute__((aligned(16))) Staged;

// The index that is stored with a splat in local memory (Staged). With RAYS it is the Gaussian's index, because each
// pixel reads the splat in global memory; otherwise it is the pair's index.
#ifdef RAYS
#define KEPT(gaussian, pair) (gaussian)
#else
#define KEPT(gaussian, pair) (pair)
#endif

// Copies the splat of a Gaussian to *place in local memory. All loads are issued before a value is used, so that their
// latencies overlap. Returns the blocks of the set `among` that the splat reaches.
static inline uint stage(__local Staged *place, uint gaussian, uint kept, uint slot, uint among,
                         __global const float *splats, int tile_x, int tile_y) {
  __global const float4 *row = (__global const float4 *)splats + (size_t)(SPLAT_SIZE / 4) * gaussian;
  const float4 a = row[0], b = row[1], c = row[2], d = row[3];
  const float splat[SPLAT_SIZE] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w, c.x, c.y, c.z, c.w, d.x, d.y, d.z, d.w};
  place->mx = FROM_TILE(splat, X, tile_x);
  place->my = FROM_TILE(splat, Y, tile_y);
  place->l11 = splat[SPLAT_L11];
  place->l12 = splat[SPLAT_L12];
  place->l22 = splat[SPLAT_L22];
  place->log2o = splat[SPLAT_LOG2O];
  place->red = splat[SPLAT_RED];
  place->green = splat[SPLAT_GREEN];
  place->blue = splat[SPLAT_BLUE];
  place->kept = kept;
  place->slot = slot;
#ifdef NEARNESS
  place->near = 1.0f / splat[SPLAT_DEPTH];
  for (int k = 0; k < 3; ++k) place->unused[k] = 0;
#endif
  const uint blocks = blocks_of(splat, tile_x, tile_y) & among;
  place->blocks = blocks;
  return blocks;
}

// The set of blocks b for which numbers[b] is above `floor`, a bit for each block.
static inline uint blocks_above(int floor, __local const int *numbers) {
  uint blocks = 0;
  _Pragma("unroll") for (int block = 0; block < BLOCKS; ++block) blocks |= (uint)(numbers[block] > floor) << block;
  return blocks;
}

// Lists of pairs: a warp loops over only those pairs of a batch that reach one of its blocks. First each pair is marked
// for each set of blocks that has a list. Then the marked pairs of each set are listed in order.
#define LIST (BATCH + 2) // capacity of a list; elements after its end are read ahead, but not used

// Marks the j-th pair of a batch for each of `sets` sets of `own` blocks: `marks` has a byte for each set and pair, 1
// or 0. blocks: the blocks that the pair reaches.
static inline void mark(__local uint *marks, int j, uint blocks, int sets, int own) {
  _Pragma("unroll") for (int set = 0; set < sets; ++set)((__local uchar *)marks)[set * BATCH + j] =
      (blocks >> set * own & FIRST_BLOCKS(own)) != 0;
}

// An entry of a list: the pair's number in its batch, with the bit DENSE if the pair reaches more than half of the
// set's blocks. It is then quicker to process all of the item's cells without a branch. SPARSE: the largest number of
// reached blocks without DENSE; spare: SPARSE minus the number of reached blocks.
#define DENSE 0x80000000u
#define ENTRY_OF(j, spare) ((uint)(j) | ((uint)(spare) & DENSE))
#define PAIR_OF(entry) ((int)((entry) & ~DENSE))
#define SPARSE(own) (ALL_REACHED ? (own) : (own) / 2)
#define IS_DENSE(entry, own) (SPARSE(own) == 0 || (SPARSE(own) < (own) && ((entry) & DENSE)))

// The marks of BLOCK_ITEMS pairs of a batch from `begin` on, a bit for each pair. A multiplication collects the marks
// of four pairs in the top byte of the product.
static inline uint marked_from(__local const uint *marks, int begin) {
  uint marked = 0;
  _Pragma("unroll") for (int four = 0; four < BLOCK_ITEMS; four += 4) marked |=
      marks[(begin + four) / 4] * 0x01020408u >> 24 << four;
  return marked;
}

// Lists the pairs that are marked for a set of blocks. ENTRY(j): the entry of the j-th pair. Defines `count`, the
// number of entries.
#define LIST_MARKED(count, marks, list, ENTRY)                                                                         \
  int count = 0;                                                                                                       \
  _Pragma("unroll") for (int begin_ = 0; begin_ < BATCH; begin_ += BLOCK_ITEMS) {                                      \
    const uint marked = marked_from(marks, begin_), until = marked << (31 - LANE); /* marks up to the item's pair */   \
    if (until >> 31) (list)[count + popcount(until) - 1] = ENTRY(begin_ + LANE);                                       \
    count += popcount(marked);                                                                                         \
  }

// Defines position, whitening, opacity and colour of a splat as variables, from the splat `s` in local memory (Staged).
// SPLAT_HERE defines all but the colour, from a splat in global memory.
#define SPLAT_STAGED(s)                                                                                                \
  __global const float *splat = splats + (size_t)SPLAT_SIZE * s.kept;                                                  \
  const float mx = s.mx, my = s.my, l11 = s.l11, l12 = s.l12, l22 = s.l22, log2o = s.log2o;                            \
  const float c_red = s.red, c_green = s.green, c_blue = s.blue;

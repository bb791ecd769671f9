// Divides the pixels of a tile into cells, and finds the cells that a Gaussian reaches. If several work-items share a
// tile, blocks.h does this. Otherwise one work-item has the whole tile, and a cell is a block of CELL_W x CELL_H pixels
// in a vector, row by row. An ellipse reaches fewer such blocks than rows with as many pixels. Cell c is in column c %
// COLUMNS and row c / COLUMNS.
#if ITEMS > 1
#include "shared/blocks.h"
#else
#define CELL_W (LANES == 1 ? 1 : 4)
#define CELL_H (LANES / CELL_W)
#define COLUMNS (TILE / CELL_W)
#define ROWS (TILE / CELL_H)
#define CELLS (COLUMNS * ROWS)
#define OWNED CELLS // number of cells of a work-item
#define ALL_CELLS(cell) for (int cell = 0; cell < OWNED; ++cell)
#define CELL_X(cell) ((cell) % COLUMNS * CELL_W)
#define CELL_Y(cell) ((cell) / COLUMNS * CELL_H)

// The index of a cell's first pixel in a plane.
#define CELL_IN_PLANE(cell) (stride * (tile_y + CELL_Y(cell)) + tile_x + CELL_X(cell))

// The index in a plane of a lane's pixel, relative to the first pixel of the cell.
#define LANE_IN_PLANE(lane) (stride * ((lane) / CELL_W) + (lane) % CELL_W)

// PIXELS_X, PIXELS_Y: the coordinates in the tile of a cell's pixels. LOAD_CELL, STORE_CELL: access to a cell at
// address p of a plane with rows of `stride` values.
#define PIXELS_X(cell) ((floatL)(CELL_X(cell)) + LANE_X)
#define PIXELS_Y(cell) ((floatL)(CELL_Y(cell)) + LANE_Y)
#if LANES == 1
#define LANE_X 0.0f
#define LANE_Y 0.0f
#define LOAD_CELL(type, p, stride) (*(p))
#define STORE_CELL(type, x, p, stride) (*(p) = (x))
#else
typedef float4 float4U __attribute__((aligned(4)));
typedef int4 int4U __attribute__((aligned(4)));
#define LOAD4(type, p) (*(__global const type##4U *)(p))
#define STORE4(type, x, p) (*(__global type##4U *)(p) = (x))
#if LANES == 4
#define LANE_X ((floatL)(0, 1, 2, 3))
#define LANE_Y ((floatL)(0.0f))
#define LOAD_CELL(type, p, stride) LOAD4(type, p)
#define STORE_CELL(type, x, p, stride) STORE4(type, x, p)
#elif LANES == 8
#define LANE_X ((floatL)(0, 1, 2, 3, 0, 1, 2, 3))
#define LANE_Y ((floatL)(0, 0, 0, 0, 1, 1, 1, 1))
#define LOAD_CELL(type, p, stride) ((type##8)(LOAD4(type, p), LOAD4(type, (p) + (stride))))
#define STORE_CELL(type, x, p, stride) (STORE4(type, (x).lo, p), STORE4(type, (x).hi, (p) + (stride)))
#else
#define LANE_X ((floatL)(0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3))
#define LANE_Y ((floatL)(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3))
#define LOAD_CELL(type, p, stride)                                                                                     \
  ((type##16)(LOAD4(type, p), LOAD4(type, (p) + (stride)), LOAD4(type, (p) + 2 * (stride)),                            \
              LOAD4(type, (p) + 3 * (stride))))
#define STORE_CELL(type, x, p, stride)                                                                                 \
  (STORE4(type, (x).lo.lo, p), STORE4(type, (x).lo.hi, (p) + (stride)), STORE4(type, (x).hi.lo, (p) + 2 * (stride)),   \
   STORE4(type, (x).hi.hi, (p) + 3 * (stride)))
#endif
#endif

// Reach: the set of cells that a Gaussian reaches. For tiles of at most 32 cells, Reach has a bit for each cell, set if
// the cell has a pixel in the ellipse. Otherwise Reach is the range of cells that the ellipse's box reaches.
#if LANES >= 8
#ifndef RAYS // with RAYS every cell of a tile is visited
#define CELLS_BY_ELLIPSE
#endif
typedef uint Reach;
#if defined(__has_builtin)
#if __has_builtin(__builtin_ctz)
#define LOWEST(bits) __builtin_ctz(bits)
#endif
#endif
#ifndef LOWEST
#define LOWEST(bits) (31 - clz((bits) & -(bits)))
#endif

// sqrt(x), up to 0.2 % too large: one step of Newton's method from an estimate of 1 / sqrt(x) by its bits. In PoCL the
// sqrt of a vector is a function call.
static inline float8 over_sqrt(float8 x) {
  const float8 y = as_float8((int8)(0x5f375a86) - (as_int8(x) >> 1));
  const float8 root = x * y;
  return root * (1.502f - 0.5f * (root * y));
}

// Computes the ellipse's chords in eight rows of pixels: *low and *end are their ends, in pixels and not clamped. In
// row y a chord is |l11 (mx - x) + l12 (my - y)| <= sqrt(rest), with rest = budget - (l22 (my - y))^2. Returns rest;
// where it is negative the ellipse misses the row, and the chord is a single point.
static inline float8 chord(float8 dy, float mx, float l12, float l22, float inverse_l11, float budget, float8 *low,
                           float8 *end) {
  const float8 v = l22 * dy, shift = l12 * dy;
  const float8 rest = budget - v * v;
  const float8 reach = over_sqrt(rest > 0.0f ? rest : (float8)(0.0f));
  *low = (shift - reach) * inverse_l11 + mx;
  *end = (shift + reach) * inverse_l11 + mx;
  return rest;
}

// The columns of cells that the ellipse reaches in eight pairs of pixel rows, a bit for each column.
static inline int8 reached_columns(float my, float mx, float l12, float l22, float inverse_l11, float budget) {
  const float8 dy = my - (float8)(0, 2, 4, 6, 8, 10, 12, 14);
  float8 low, end, low2, end2;
  const float8 rest = chord(dy, mx, l12, l22, inverse_l11, budget, &low, &end);
  const float8 rest2 = chord(dy - 1.0f, mx, l12, l22, inverse_l11, budget, &low2, &end2);
  low = (low < low2 ? low : low2) - TILE_SLACK;
  end = (end > end2 ? end : end2) + (TILE_SLACK + 1.0f);
  low = low > 0.0f ? low : (float8)(0.0f);
  low = low < (float)TILE ? low : (float8)(TILE);
  end = end > 0.0f ? end : (float8)(0.0f);
  end = end < (float)TILE ? end : (float8)(TILE);
  const int8 whole = convert_int8(low);
  const int8 first = whole - (convert_float8(whole) < low), last = convert_int8(end) - 1; // a true comparison is -1
  const int8 bits = ((int8)(2) << (last >> 2)) - ((int8)(1) << (first >> 2));
  const int8 none = (int8)(0);
  const int8 some = last >= first ? bits : none;
  return (rest > rest2 ? rest : rest2) > 0.0f ? some : none;
}

static inline uint join_rows(int8 bits) {
  const int4 a = bits.lo | bits.hi;
  const int2 b = a.lo | a.hi;
  return (uint)(b.x | b.y);
}

static inline Reach reach_of(__global const float *splat, int tile_x, int tile_y) {
#if (defined(NO_ROW_SKIP) && defined(NO_COLUMN_SKIP)) || defined(RAYS)
  return CELLS == 32 ? 0xffffffffu : (1u << (CELLS % 32)) - 1;
#else
  const float mx = FROM_TILE(splat, X, tile_x), my = FROM_TILE(splat, Y, tile_y);
  const float l12 = splat[SPLAT_L12], l22 = splat[SPLAT_L22], inverse = splat[SPLAT_INVERSE_L11];
  const float budget = EXTENT(splat[SPLAT_LOG2O]) + 0.01f;
  int8 bits = reached_columns(my, mx, l12, l22, inverse, budget);
#ifdef NO_COLUMN_SKIP // RasterizerConfig.column_skip is off
  bits = bits != 0 ? (int8)(15) : (int8)(0);
#endif
#ifdef NO_ROW_SKIP // RasterizerConfig.row_skip is off
  bits = (int8)((int)join_rows(bits));
#endif
#if LANES == 8
  return join_rows(bits << (int8)(0, 4, 8, 12, 16, 20, 24, 28));
#else
  return join_rows(bits << (int8)(0, 0, 4, 4, 8, 8, 12, 12));
#endif
#endif
}

// Tables of the pixels' coordinates. Without them, some compilers convert integers in the inner loop by a long chain of
// dependent instructions. A cell has the same index in all tables and arrays, which saves address arithmetic.
#define PIXEL_TABLES                                                                                                   \
  floatL table_x[CELLS], table_y[CELLS];                                                                               \
  ALL_CELLS(cell) {                                                                                                    \
    table_x[cell] = PIXELS_X(cell);                                                                                    \
    table_y[cell] = PIXELS_Y(cell);                                                                                    \
  }
#define AT_X(cell) table_x[cell]
#define AT_Y(cell) table_y[cell]

// A set of cells that have open pixels, as bits.
typedef uint Open;
#define OPEN_CELL(open, cell) ((open) |= 1u << (cell))
#define CLOSE_CELL(open, cell) ((open) &= ~(1u << (cell)))
#ifdef NO_EARLY_STOP
#define IN_OPEN(reach, open) (reach)
#else
#define IN_OPEN(reach, open) ((reach) & (open))
#endif

#define FOR_CELLS(cell, reach) for (uint left = (reach), cell = 0; left && ((cell = LOWEST(left)), 1); left &= left - 1)

// Records of cells, which blend.cl writes for blend_grad.cl. A cell is one vector of the shape's width, or two that
// widened.h has combined (VECTORS); a record has a bit for each of these vectors. RECORDED(mask) <<
// FIRST_RECORDED(cell): the bits of a cell's vectors that have a lane set in `mask`. CELLS_OF(recorded): the cells that
// the set bits belong to. PLACE_OF(bit): the index of the vector with this bit, if an array of cells is read as an
// array of vectors (floatS).
#if VECTORS == 1
#define FIRST_RECORDED(cell) (cell)
#define RECORDED(mask) ((uint)(ANYL(mask) != 0))
#define CELLS_OF(recorded) (recorded)
#define PLACE_OF(bit) (bit)
#else // two vectors, one below the other
#define FIRST_RECORDED(cell) ((cell) / COLUMNS * (2 * COLUMNS) + (cell) % COLUMNS)
#define RECORDED(mask) recorded_of(mask)
#define CELLS_OF(recorded) cells_of(recorded)
#define PLACE_OF(bit) place_of[bit]
__constant uchar place_of[2 * CELLS] = {0,  2,  4,  6,  1,  3,  5,  7,  8,  10, 12, 14, 9,  11, 13, 15,
                                        16, 18, 20, 22, 17, 19, 21, 23, 24, 26, 28, 30, 25, 27, 29, 31};
static inline uint recorded_of(intL mask) {
  const long4 upper = as_long4(mask.lo), lower = as_long4(mask.hi);
  const long2 a = upper.lo | upper.hi, b = lower.lo | lower.hi;
  return (uint)((a.x | a.y) != 0) | (uint)((b.x | b.y) != 0) << COLUMNS;
}
static inline uint cells_of(uint recorded) {
  const uint rows = (recorded | recorded >> COLUMNS) & 0x0f0f0f0f;
  const uint pairs = (rows | rows >> 4) & 0x00ff00ff;
  return (pairs | pairs >> 8) & 0xffff;
}
#endif
#else
typedef struct {
  int x0, x1, y0, y1;
} Reach;

static inline Reach reach_of(__global const float *splat, int tile_x, int tile_y) {
  Reach reach = {0, COLUMNS, 0, ROWS};
#ifndef RAYS
  const float x = (splat[SPLAT_PIXEL_X] - (float)tile_x) + splat[SPLAT_SUB_X];
  const float y = (splat[SPLAT_PIXEL_Y] - (float)tile_y) + splat[SPLAT_SUB_Y];
#ifndef NO_COLUMN_SKIP
  reach.x0 = first_cell(x - splat[SPLAT_HALF_W], (float)CELL_W, COLUMNS);
  reach.x1 = end_cell(x + splat[SPLAT_HALF_W], (float)CELL_W, COLUMNS);
#endif
#ifndef NO_ROW_SKIP
  reach.y0 = first_cell(y - splat[SPLAT_HALF_H], (float)CELL_H, ROWS);
  reach.y1 = end_cell(y + splat[SPLAT_HALF_H], (float)CELL_H, ROWS);
#endif
#endif
  return reach;
}

#define PIXEL_TABLES
#define AT_X(cell) PIXELS_X(cell)
#define AT_Y(cell) PIXELS_Y(cell)

typedef int Open; // number of open cells
#define OPEN_CELL(open, cell) (++(open))
#define CLOSE_CELL(open, cell) (--(open))
#define IN_OPEN(reach, open) (reach)

#define FOR_CELLS(cell, reach)                                                                                         \
  for (int row = (reach).y0; row < (reach).y1; ++row)                                                                  \
    for (int cell = row * COLUMNS + (reach).x0, end_ = cell + (reach).x1 - (reach).x0; cell < end_; ++cell)
#endif
#endif

// Code that values.cl and values_grad.cl share, which blend any number of values per Gaussian. Include cells.h before
// this file.
#ifndef VALUES
#error "VALUES must be defined: values of a Gaussian that a pass has, 1 to 32"
#endif

// The coordinates of a lane's pixel in the cell.
#if ITEMS == 1
#define LANE_PIXEL_X(lane) ((lane) % CELL_W)
#define LANE_PIXEL_Y(lane) ((lane) / CELL_W)
#else
#define LANE_PIXEL_X(lane) 0
#define LANE_PIXEL_Y(lane) 0
#endif

// A loop over the values of a pass, unrolled if LANES is 1 (lanes.h).
#define FOR_VALUES(k) UNROLL for (int k = 0; k < VALUES; ++k)

// The cells that may have a pixel to which the i-th pair is added.
#ifdef RECORD_CELLS // blend.cl has recorded the cells
#define CELLS_OF_PAIR(i, splat) cells_from_sorted[i]
#else
#define CELLS_OF_PAIR(i, splat) reach_of(splat, tile_x, tile_y)
#endif

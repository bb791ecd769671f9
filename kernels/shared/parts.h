// Parts of long lists, with which several groups of blend_grad.cl walk one list at the same time. Only groups of
// several work-items divide lists. A list [begin, end) has a boundary after every PART_PAIRS pairs, as long as pairs
// follow. At a boundary blend.cl stores the state of the tile's pixels, and blend_grad.cl begins there.
//
// Boundary k = 1, 2, ... of a list belongs to the state number begin / PART_PAIRS + k - 1. A tile owns the states from
// begin / PART_PAIRS to end / PART_PAIRS, without the last. Lists follow one another, so all of these are different,
// and leave no gap. Some have no boundary.
//
// Buffers: states (pairs / PART_PAIRS, STATE_SIZE, TILE * TILE): the fields below; with STATE_SIZE 5 also STATE_NEAR.
//     Only pixels that go on past the boundary have a state.
//   tile_of_state (pairs / PART_PAIRS): the tile of the launch that owns each state.
#ifdef PART_PAIRS
#include "shared/count.h"

#define STATE_T 0 // transmittance
#define STATE_RED 1
#define STATE_GREEN 2
#define STATE_BLUE 3
#define STATE_NEAR 4 // sum of weight / depth
// The address of a field of a state for a cell's pixel. In groups of any size, a state's pixels are stored in blocks of
// 4 x 8, which are the blocks of groups of 32 items or more (blocks.h).
#define PIXEL_IN_STATE(cell)                                                                                           \
  ((CELL_Y(cell) / 8 * (TILE / BLOCK_W) + CELL_X(cell) / BLOCK_W) * (8 * BLOCK_W) + CELL_Y(cell) % 8 * BLOCK_W +       \
   CELL_X(cell) % BLOCK_W)
#define IN_STATE(state, field, cell)                                                                                   \
  states[((size_t)(state) * STATE_SIZE + (field)) * (TILE * TILE) + PIXEL_IN_STATE(cell)]
#define FIRST_STATE(begin) ((begin) / PART_PAIRS)

// Defines the same as TILE_OF_GROUP, except that [begin, end) is only the group's part of the list. Group number
// `state` below `most_states` has the part before the boundary of this state, and ends the kernel if there is no such
// boundary. Further groups, one for each tile, have the part of the tile's list behind its last boundary.
#define PART_OF_GROUP                                                                                                  \
  const int state = get_group_id(0), within = state < most_states;                                                     \
  if (within && state >= FIRST_STATE((int)pairs)) return;                                                              \
  const int listed_tile = within ? tile_of_state[state] : LISTED_TILE(state - most_states);                            \
  TILE_OF_LIST(list_begin, list_end)                                                                                   \
  const int end = within ? list_begin + (state + 1 - FIRST_STATE(list_begin)) * PART_PAIRS : list_end;                 \
  if (within && end >= list_end) return;                                                                               \
  const int begin =                                                                                                    \
      within ? end - PART_PAIRS : list_begin + max(list_end - list_begin - 1, 0) / PART_PAIRS * PART_PAIRS;
#endif

// Maps the rows of a launch that covers only some chunks of a model to rows of the model. With CHUNKS, a kernel has the
// parameters CHUNK_PARAMETERS at its end. `chunks` (n / CHUNK_ROWS): for each CHUNK_ROWS rows of the launch the number
// of the model's chunk, or NO_CHUNK as padding at the end; `model_rows`: the number of rows of the model. The chunks of
// a streamed model lie in the slots of a pool, in any order; `chunks` then lists slots, and `model_rows` is the number
// of rows of all slots. With FIRST_ROWS, a kernel over slots has the parameter `first_rows` (n / CHUNK_ROWS): the
// number that the first row of each chunk has in the whole model.
//
// Arrays of a view, such as splats and tile_counts, have the rows of the launch. Parameters, moments and statistics
// have the rows of the model.
#ifdef CHUNKS
#define CHUNK_PARAMETERS , __global const uint *chunks, const uint model_rows

// The model's row minus the launch's row, which is the same for all rows of a chunk. It is negative if the chunk's slot
// comes before the chunk's place in the launch.
static inline long rows_ahead(__global const uint *chunks, uint row) {
  const uint place = row / CHUNK_ROWS;
  return (long)CHUNK_ROWS * ((long)chunks[place] - place);
}

// Returns the end of the rows that exist in the model, for a work-item that begins at `row` of a launch with `n` rows:
// n, or less if the model's last chunk is not full. Returns `row` if no row exists, as in padding by NO_CHUNK. ahead:
// the result of rows_ahead; model_rows: the number of rows of the model.
static inline uint end_of_rows(uint row, uint n, long ahead, uint model_rows) {
  return row + ahead >= model_rows ? row : (uint)min((long)n, model_rows - ahead);
}

// Shifts the pointers to a model's arrays by `ahead` rows, so that they can be indexed by rows of the launch.
#define MOVE_ROWS(ahead, prefix)                                                                                       \
  prefix##means += 3 * (ahead), prefix##quaternions += 4 * (ahead), prefix##log_scales += 3 * (ahead);                 \
  prefix##opacity_logits += (ahead), prefix##sh_dc += 3 * (ahead);                                                     \
  prefix##sh_rest += (long)3 * (coefficients - 1) * (ahead);
#define ROW_OF_MODEL(row) ((row) + rows_ahead(chunks, row))
#else
#define CHUNK_PARAMETERS
#define ROW_OF_MODEL(row) (row)
#endif

// The number that a row of the launch has in the whole model, even if the kernel gets the slots of a pool.
#ifdef FIRST_ROWS
#define ROW_NUMBER(row) (first_rows[(row) / CHUNK_ROWS] + (row) % CHUNK_ROWS)
#else
#define ROW_NUMBER(row) ROW_OF_MODEL(row)
#endif

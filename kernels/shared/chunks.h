// The rows of a launch that covers only some chunks of a model. With CHUNKS, a kernel has the parameters
// CHUNK_PARAMETERS at its end: `chunks` (n / CHUNK_ROWS), for each CHUNK_ROWS rows of the launch the chunk of the model
// that they are, then NO_CHUNK; and `model_rows`, the number of rows of the model. Of a streamed model, whose chunks
// are in the slots of a pool in any order, `chunks` has slots and `model_rows` the rows of all slots. Arrays by view,
// such as splats and tile_counts, have the rows of the launch; parameters, moments and statistics those of the model.
// With FIRST_ROWS, of slots, a kernel has the parameter `first_rows` (n / CHUNK_ROWS): the number that the first row of
// each of these chunks has in the whole model.
#ifdef CHUNKS
#define CHUNK_PARAMETERS , __global const uint *chunks, const uint model_rows

// How far the model's row is ahead of the row of the launch, for all rows of a chunk. Negative where a slot stands
// before the chunk's place in the launch.
static inline long rows_ahead(__global const uint *chunks, uint row) {
  const uint place = row / CHUNK_ROWS;
  return (long)CHUNK_ROWS * ((long)chunks[place] - place);
}

// Where the rows of a launch that has `n` rows end: at n, or earlier in the model's last chunk. `row` if the model has
// no such row.
static inline uint end_of_rows(uint row, uint n, long ahead, uint model_rows) {
  return row + ahead >= model_rows ? row : (uint)min((long)n, model_rows - ahead);
}

// Moves pointers to a model's arrays, so that they are indexed by rows of the launch.
#define MOVE_ROWS(ahead, prefix)                                                                                       \
  prefix##means += 3 * (ahead), prefix##quaternions += 4 * (ahead), prefix##log_scales += 3 * (ahead);                 \
  prefix##opacity_logits += (ahead), prefix##sh_dc += 3 * (ahead);                                                     \
  prefix##sh_rest += (long)3 * (coefficients - 1) * (ahead);
#define ROW_OF_MODEL(row) ((row) + rows_ahead(chunks, row))
#else
#define CHUNK_PARAMETERS
#define ROW_OF_MODEL(row) (row)
#endif

// The number of a row in the whole model, also of a row in a slot.
#ifdef FIRST_ROWS
#define ROW_NUMBER(row) (first_rows[(row) / CHUNK_ROWS] + (row) % CHUNK_ROWS)
#else
#define ROW_NUMBER(row) ROW_OF_MODEL(row)
#endif

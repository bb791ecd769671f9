// Copies chunks between their records and the pool, which has an array for each field.
//
// Owner: An item of copy_chunks copies a vector of four words of one field as integers, so that every bit of a NaN
//   stays. An item of copy_caught copies a word.
// Launch: copy_chunks: entries * block / 4 items for each field; copy_caught: `entries` items.
// Buffers: slots (entries): the pool's slot of each record.
//   records (entries, record): `record` words with all fields of a chunk. The copied field begins at word `offset`.
//     After all records, from word `at` on, the last step up to which each chunk has been caught up (catch_up.cl).
//   array (slots of the pool, block): the copied field in each slot, `block` words for CHUNK_ROWS rows.
//   caught (slots of the pool): the last step up to which the chunk in each slot has been caught up.
//   With TO_RECORDS, array -> records, caught -> records; without TO_RECORDS, records -> array, records -> caught.
// Equations: none.
__kernel void copy_chunks(const ulong vectors, const ulong record, const ulong offset, const ulong block,
                          __global const uint *slots, __global uint4 *records, __global uint4 *array) {
  const size_t i = get_global_id(0);
  if (i >= vectors) return;
  const size_t entry = i / (block / 4), within = i % (block / 4);
  const size_t in_record = entry * (record / 4) + offset / 4 + within, in_slot = slots[entry] * (block / 4) + within;
#ifdef TO_RECORDS
  records[in_record] = array[in_slot];
#else
  array[in_slot] = records[in_record];
#endif
}

__kernel void copy_caught(const uint entries, const ulong at, __global const uint *slots, __global uint *records,
                          __global uint *caught) {
  const uint entry = get_global_id(0);
  if (entry >= entries) return;
#ifdef TO_RECORDS
  records[at + entry] = caught[slots[entry]];
#else
  caught[slots[entry]] = records[at + entry];
#endif
}

// Copies one field of chunks between their records and the pool, which has an array for each field.
//
// Owner: An item copies a vector of four words as integers, so that every bit of a NaN stays.
// Launch: entries * block / 4 items.
// Buffers: slots (entries): the pool's slot of each record.
//   records (entries, record): `record` words with all fields of a chunk. The copied field begins at word `offset`.
//   array (slots of the pool, block): the copied field in each slot, `block` words for CHUNK_ROWS rows.
//   With TO_RECORDS, array -> records; without TO_RECORDS, records -> array.
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

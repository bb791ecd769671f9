// One pass of a stable least-significant-digit radix sort in three launches: the histogram of each chunk, the scan of
// each digit's counts over the chunks, and the scatter. No group waits for another group. If a single work-item sorts
// all keys, one launch (radix_sort) does all passes. Sort keys and their bits: clsplat/stages/duplicate.py.
//
// Owner: A group owns a chunk, and in radix_offsets `rows` digits. In the scatter, a group of one item moves its keys
//   one by one. A larger group loads TILE keys at a time, sorts them by digit in local memory, and writes the keys of a
//   digit side by side. Such a batch of keys is called a tile in this file.
// Launch: One group of ITEMS work-items for each chunk; in radix_offsets one group for each `rows` digits.
// Buffers: keys, values (n), histograms (digits, groups), totals (digits) -> keys_out, values_out (n); counters
//   (digits) in local memory.
// Equations: none; docs/decisions/0001-split-sort.md.
#include "shared/math.h"
#include "shared/group.h"
#include "shared/count.h"

// Digits are taken from key - `base`, where base is at most the smallest key.
#define DIGIT(key) ((((key) - base) >> shift) & (digits - 1))

#if ITEMS == 1
#define COUNT(counter) (counter) += 1
#else
#define COUNT(counter) atomic_inc(&(counter))
#endif

// Counts the digits of each chunk: keys (n) -> histograms (digits, groups).
GROUP __kernel void radix_histogram(ELEMENTS(n), const uint chunk, const uint base, const uint shift, const uint digits,
                                    __global const uint *keys, __global uint *histograms, __local uint *counters) {
  FIND_ELEMENTS(n)
  const uint item = get_local_id(0);
  const uint begin = get_group_id(0) * chunk, end = min(begin + chunk, n);
  for (uint digit = item; digit < digits; digit += ITEMS) counters[digit] = 0;
  BARRIER_LOCAL();
  for (uint i = begin + item; i < end; i += ITEMS) COUNT(counters[DIGIT(keys[i])]);
  BARRIER_LOCAL();
  for (uint digit = item; digit < digits; digit += ITEMS) {
    histograms[digit * get_num_groups(0) + get_group_id(0)] = counters[digit];
  }
}

// Scans each digit's counts over the chunks. histograms (digits, groups): each count becomes the number of keys with
// the same digit in earlier chunks; totals (digits): each digit's count over all chunks. A group owns `rows` digits.
GROUP __kernel void radix_offsets(const uint groups, const uint digits, const uint rows, __global uint *histograms,
                                  __global uint *totals) {
  __local uint scratch[ITEMS];
  const uint end = min((uint)(get_group_id(0) + 1) * rows, digits);
  for (uint digit = get_group_id(0) * rows; digit < end; ++digit) {
    __global uint *row = histograms + digit * groups;
    uint running = 0;
    for (uint first = 0; first < groups; first += ITEMS) {
      const uint group = first + get_local_id(0);
      uint all;
      const uint before = group_exclusive_scan(group < groups ? row[group] : 0, scratch, &all);
      if (group < groups) row[group] = running + before;
      running += all;
    }
    if (get_local_id(0) == 0) totals[digit] = running;
  }
}

#define SCATTER                                                                                                        \
  ELEMENTS(n), const uint chunk, const uint base, const uint shift, const uint digits, const int identity,             \
      __global const uint *keys, __global const uint *values, __global const uint *histograms,                         \
      __global const uint *totals, __global uint *keys_out, __global uint *values_out, __local uint *places

// Moves a chunk's keys to their destinations. keys, values (n), histograms and totals of radix_offsets -> keys_out,
// values_out (n). If `identity` is not 0, positions are used as values. places[digit]: the destination of the next key
// with this digit.
#if ITEMS == 1
static inline void scatter(const uint begin, const uint end, const uint base, const uint shift, const uint digits,
                           const int identity, __global const uint *keys, __global const uint *values,
                           __global uint *keys_out, __global uint *values_out, __local uint *places) {
  for (uint i = begin; i < end; ++i) {
    const uint key = keys[i];
    const uint place = places[DIGIT(key)]++;
    keys_out[place] = key;
    values_out[place] = identity ? i : values[i];
  }
}

GROUP __kernel void radix_scatter(SCATTER) {
  FIND_ELEMENTS(n)
  const uint begin = get_group_id(0) * chunk, end = min(begin + chunk, n);
  uint before = 0;
  for (uint digit = 0; digit < digits; ++digit) {
    places[digit] = before + histograms[digit * get_num_groups(0) + get_group_id(0)];
    before += totals[digit];
  }
  scatter(begin, end, base, shift, digits, identity, keys, values, keys_out, values_out, places);
}

// Sorts all keys by one work-item: keys (n) -> sorted keys and their positions. They are in keys0 and values0 after an
// odd number of passes, else in keys1 and values1.
GROUP __kernel void radix_sort(ELEMENTS(n), const uint base, const uint digit_bits, const uint passes,
                               __global const uint *keys, __global uint *keys0, __global uint *values0,
                               __global uint *keys1, __global uint *values1, __local uint *places) {
  FIND_ELEMENTS(n)
  const uint digits = 1u << digit_bits;
  __global const uint *values = values1;
  for (uint pass = 0; pass < passes; ++pass) {
    const uint shift = pass * digit_bits;
    __global uint *keys_out = pass % 2 ? keys1 : keys0, *values_out = pass % 2 ? values1 : values0;
    for (uint digit = 0; digit < digits; ++digit) places[digit] = 0;
    for (uint i = 0; i < n; ++i) COUNT(places[DIGIT(keys[i])]);
    uint before = 0;
    for (uint digit = 0; digit < digits; ++digit) {
      const uint count = places[digit];
      places[digit] = before;
      before += count;
    }
    scatter(0, n, base, shift, digits, pass == 0, keys, values, keys_out, values_out, places);
    keys = keys_out, values = values_out;
  }
}
#else
// RUN: number of consecutive keys of a tile that one item ranks. WORDS: number of words of an item's 16 counters, one
// counter for each value of four bits and two counters to a word. Arrays in local memory have a gap after each 32
// words. So 32 items that read 8 or 16 words apart use 32 different banks.
#define RUN 16
#define WORDS 8
#define TILE (RUN * ITEMS)
#define GAPPED(i) ((i) + ((i) >> 5))

// Sorts a tile, a batch of TILE keys, stably by the four bits that start at bit `shift`.
static inline void sort_tile(uint shift, __local uint *tile, __local uint *counters, __local uint *scratch) {
  const uint item = get_local_id(0);
  uint entries[RUN], ranks[RUN], words[WORDS], all;
#pragma unroll
  for (uint word = 0; word < WORDS; ++word) counters[GAPPED(word * ITEMS + item)] = 0;
#pragma unroll
  for (uint k = 0; k < RUN; ++k) {
    entries[k] = tile[GAPPED(item * RUN + k)];
    const uint value = (entries[k] >> shift) & 15, lift = value / WORDS * 16;
    __local uint *counter = counters + GAPPED(value % WORDS * ITEMS + item);
    ranks[k] = (*counter >> lift) & 0xffff;
    *counter += 1u << lift;
  }
  BARRIER_LOCAL();
  uint sum = 0;
#pragma unroll
  for (uint word = 0; word < WORDS; ++word) {
    words[word] = counters[GAPPED(item * WORDS + word)];
    sum += words[word];
  }
  uint before = group_exclusive_scan(sum, scratch, &all);
  before += all << 16; // keys with the values 8 to 15 follow those with 0 to 7
#pragma unroll
  for (uint word = 0; word < WORDS; ++word) {
    counters[GAPPED(item * WORDS + word)] = before;
    before += words[word];
  }
  BARRIER_LOCAL();
#pragma unroll
  for (uint k = 0; k < RUN; ++k) {
    const uint value = (entries[k] >> shift) & 15;
    const uint first = counters[GAPPED(value % WORDS * ITEMS + item)] >> (value / WORDS * 16);
    tile[GAPPED((first & 0xffff) + ranks[k])] = entries[k];
  }
  BARRIER_LOCAL();
}

// Moves a chunk's keys to their destinations, a tile (TILE keys) at a time. Digits have at most 8 bits.
GROUP __kernel void radix_scatter(SCATTER) {
  FIND_ELEMENTS(n)
  __local uint tile[GAPPED(TILE)]; // digit << 16 | position in the tile
  __local uint counters[GAPPED(WORDS * ITEMS)];
  __local uint scratch[ITEMS];
  const uint item = get_local_id(0);
  const uint begin = get_group_id(0) * chunk, end = min(begin + chunk, n);
  uint running = 0;
  for (uint first = 0; first < digits; first += ITEMS) {
    const uint digit = first + item;
    uint all;
    const uint before = group_exclusive_scan(digit < digits ? totals[digit] : 0, scratch, &all);
    if (digit < digits) {
      places[digit] = running + before + histograms[digit * get_num_groups(0) + get_group_id(0)];
    }
    running += all;
  }
  for (uint tile_begin = begin; tile_begin < end; tile_begin += TILE) {
    const uint count = min((uint)TILE, end - tile_begin);
    // Padding after the last key gets the largest digit, so that the stable sort leaves it after all keys.
    for (uint i = item; i < TILE; i += ITEMS) {
      tile[GAPPED(i)] = (i < count ? DIGIT(keys[tile_begin + i]) : digits - 1) << 16 | i;
    }
    BARRIER_LOCAL();
    for (uint bits = 0; digits >> bits > 1; bits += 4) sort_tile(16 + bits, tile, counters, scratch);
    // While a tile of keys is written, places[digit] is the destination of the digit's first key in the tile, minus
    // this key's position in the tile.
    for (uint i = item; i < count; i += ITEMS) {
      const uint digit = tile[GAPPED(i)] >> 16;
      if (i == 0 || tile[GAPPED(i - 1)] >> 16 != digit) places[digit] -= i;
    }
    BARRIER_LOCAL();
    for (uint i = item; i < count; i += ITEMS) {
      const uint entry = tile[GAPPED(i)];
      const uint place = places[entry >> 16] + i;
      const uint from = tile_begin + (entry & 0xffff);
      keys_out[place] = keys[from];
      values_out[place] = identity ? from : values[from];
    }
    BARRIER_LOCAL();
    for (uint i = item; i < count; i += ITEMS) {
      const uint digit = tile[GAPPED(i)] >> 16;
      if (i + 1 == count || tile[GAPPED(i + 1)] >> 16 != digit) places[digit] += i + 1;
    }
    BARRIER_LOCAL();
  }
}
#endif

// Random words from counters: a row and a key give the same word in any order and on any device.

// A bijective mixing of a word, in which each input bit affects half of the output bits.
static inline uint mixed(uint x) {
  x = (x ^ (x >> 16)) * 0x7feb352du;
  x = (x ^ (x >> 15)) * 0x846ca68bu;
  return x ^ (x >> 16);
}

// The word of a row and a step: docs/gradients.md, (101).
static inline uint random_word(const uint row, const uint key0, const uint key1) {
  return mixed(mixed(row ^ key0) + key1);
}

// The opacity factor of a model row in a thinning step: 0 leaves it out, if the row's word is under the threshold.
static inline float thinning(const uint row, const uint key0, const uint key1, const uint threshold,
                             const float factor) {
  return random_word(row, key0, key1) < threshold ? 0.0f : factor;
}

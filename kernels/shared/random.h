// Random words from counters: the same for the same row and key, in any order and on any device.

// Mixes a word so that each bit of it sways half of the result's; no two words have one result.
static inline uint mixed(uint x) {
  x = (x ^ (x >> 16)) * 0x7feb352du;
  x = (x ^ (x >> 15)) * 0x846ca68bu;
  return x ^ (x >> 16);
}

// A word of a row and a step: docs/gradients.md, (101).
static inline uint random_word(const uint row, const uint key0, const uint key1) {
  return mixed(mixed(row ^ key0) + key1);
}

// Factor of the opacity of a row of the model in a step that leaves out those whose word is under the threshold.
static inline float thinning(const uint row, const uint key0, const uint key1, const uint threshold,
                             const float factor) {
  return random_word(row, key0, key1) < threshold ? 0.0f : factor;
}

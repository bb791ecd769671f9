// Random words from counters: the word of a row and a key does not depend on the order of calls or on the device.

// A permutation of all 32-bit words. On average, each input bit changes half of the output bits.
static inline uint mixed(uint x) {
  x = (x ^ (x >> 16)) * 0x7feb352du;
  x = (x ^ (x >> 15)) * 0x846ca68bu;
  return x ^ (x >> 16);
}

// The word of a row and a step: docs/gradients.md, (101).
static inline uint random_word(const uint row, const uint key0, const uint key1) {
  return mixed(mixed(row ^ key0) + key1);
}

// The factor of a Gaussian's opacity in a step with thinning. It is 0, if the row's word is below the threshold.
static inline float thinning(const uint row, const uint key0, const uint key1, const uint threshold,
                             const float factor) {
  return random_word(row, key0, key1) < threshold ? 0.0f : factor;
}

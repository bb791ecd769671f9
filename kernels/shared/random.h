// A counter-based random generator: the random word of a row and a key depends neither on the order of calls nor on the
// device.

// A permutation of all 32-bit words. On average, each input bit changes half of the output bits.
static inline uint mixed(uint x) {
  x = (x ^ (x >> 16)) * 0x7feb352du;
  x = (x ^ (x >> 15)) * 0x846ca68bu;
  return x ^ (x >> 16);
}

// The random word of a row in a step with the key (key0, key1): equation (101) of docs/gradients.md.
static inline uint random_word(const uint row, const uint key0, const uint key1) {
  return mixed(mixed(row ^ key0) + key1);
}

// The factor of a Gaussian's opacity in a step with thinning: 0 if the row's random word is below the threshold,
// otherwise `factor`.
static inline float thinning(const uint row, const uint key0, const uint key1, const uint threshold,
                             const float factor) {
  return random_word(row, key0, key1) < threshold ? 0.0f : factor;
}

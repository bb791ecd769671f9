// Combines two vectors of 8 lanes into one of 16 if the processor has vectors of 16 floats. A kernel includes this
// before lanes.h. No bit changes, because sums over pixels are in floatS, which keeps 8 lanes. With COUNT_PAIRS vectors
// are not combined, so that counts are the same on all processors.
#if ITEMS == 1 && LANES == 8 && defined(__AVX512F__) && !defined(RAYS) && !defined(COUNT_PAIRS) && !defined(NARROW)
#undef LANES
#define LANES 16
#define VECTORS 2
#endif

// Combines two vectors of the shape into one, in kernels that include this before lanes.h, if the processor has vectors
// of 16. No bit changes, because sums over pixels are in floatS, vectors of the shape. With COUNT_PAIRS vectors are not
// combined, so that counts are the same on all processors.
#if ITEMS == 1 && LANES == 8 && defined(__AVX512F__) && !defined(RAYS) && !defined(COUNT_PAIRS) && !defined(NARROW)
#undef LANES
#define LANES 16
#define VECTORS 2
#endif

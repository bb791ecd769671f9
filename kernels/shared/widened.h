// Combines two of the shape's vectors into one, for kernels that include this before lanes.h, if the compiler targets
// 16-wide vectors. No bit changes: sums over pixels are in floatS, the shape's own vectors. COUNT_PAIRS keeps the
// shape's own vectors, so that counts agree between processors.
#if ITEMS == 1 && LANES == 8 && defined(__AVX512F__) && !defined(RAYS) && !defined(COUNT_PAIRS) && !defined(NARROW)
#undef LANES
#define LANES 16
#define VECTORS 2
#endif

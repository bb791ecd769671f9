// Two vectors of the shape in one, for kernels that include this before lanes.h, where the compiler makes code for
// vectors of 16. No bit changes: what is added up over pixels is added up in floatS, the shape's vectors. Pairs are
// counted by the shape's vectors, so that processors agree.
#if ITEMS == 1 && LANES == 8 && defined(__AVX512F__) && !defined(RAYS) && !defined(COUNT_PAIRS) && !defined(NARROW)
#undef LANES
#define LANES 16
#define VECTORS 2
#endif

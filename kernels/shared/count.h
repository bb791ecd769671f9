// The number of elements that a kernel processes: ELEMENTS(n) declares its parameter, and FIND_ELEMENTS(n) defines n.
// Without BY_CAPACITY n is an argument. With BY_CAPACITY it is n_counts[n_place] in device memory, which an earlier
// kernel has written. The launch is then large enough for the capacity, and excess items and chunks do nothing.
#ifdef BY_CAPACITY
#define ELEMENTS(n) __global const uint *n##_counts, const uint n##_place
#define FIND_ELEMENTS(n) const uint n = n##_counts[n##_place];
#else
#define ELEMENTS(n) const uint n
#define FIND_ELEMENTS(n)
#endif

// The number of elements that a kernel processes. It is an argument, or with BY_CAPACITY a number in device memory, at
// n_counts[n_place], written by an earlier kernel. The launch then covers at least as many elements, and excess items
// and chunks do nothing.
#ifdef BY_CAPACITY
#define ELEMENTS(n) __global const uint *n##_counts, const uint n##_place
#define FIND_ELEMENTS(n) const uint n = n##_counts[n##_place];
#else
#define ELEMENTS(n) const uint n
#define FIND_ELEMENTS(n)
#endif

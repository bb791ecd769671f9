// The number of elements that a kernel is for: an argument, or BY_CAPACITY a number in device memory, at n_place of
// n_counts, that a kernel before it has left there. The launch is then for at least as many, and items and chunks
// beyond the last element find nothing to do.
#ifdef BY_CAPACITY
#define ELEMENTS(n) __global const uint *n##_counts, const uint n##_place
#define FIND_ELEMENTS(n) const uint n = n##_counts[n##_place];
#else
#define ELEMENTS(n) const uint n
#define FIND_ELEMENTS(n)
#endif

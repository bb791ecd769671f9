// Prefetches the data of Gaussians that a loop needs AHEAD iterations later. The data may be anywhere in memory, and
// the loop's body is too long for the processor to look so far ahead itself. GPUs need no prefetching, because they
// hide latency with other work-items. NVIDIA's compiler has the built-in function too, but accepts no pointer type of
// OpenCL C 1.2.
#define AHEAD 16
#if ITEMS == 1 && defined(__has_builtin) && !defined(__NV_CL_C_VERSION)
#if __has_builtin(__builtin_prefetch)
#define PREFETCH(pointer) __builtin_prefetch((const void *)(size_t)(pointer))
#endif
#endif
#ifndef PREFETCH
#define PREFETCH(pointer)
#endif

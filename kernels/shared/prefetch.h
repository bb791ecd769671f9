// Prefetches the data of Gaussians that a loop will need a few iterations later. They may lie anywhere in memory, and a
// loop's body is too long for the processor to look that far ahead. It is only a hint; GPUs hide latency with other
// work-items. NVIDIA's compiler has the built-in function too, but accepts no pointer type of OpenCL C 1.2.
#define AHEAD 16
#if ITEMS == 1 && defined(__has_builtin) && !defined(__NV_CL_C_VERSION)
#if __has_builtin(__builtin_prefetch)
#define PREFETCH(pointer) __builtin_prefetch((const void *)(size_t)(pointer))
#endif
#endif
#ifndef PREFETCH
#define PREFETCH(pointer)
#endif

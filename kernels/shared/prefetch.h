// Ask for memory some Gaussians ahead: a tile's Gaussians, or those next in depth, lie anywhere, and a loop's body is
// too long for the processor to look so far forward by itself. Only a hint; GPUs hide latency by other work-items.
// NVIDIA's compiler has the built-in function too, but takes no pointer that can be written in OpenCL C 1.2.
#define AHEAD 16
#if ITEMS == 1 && defined(__has_builtin) && !defined(__NV_CL_C_VERSION)
#if __has_builtin(__builtin_prefetch)
#define PREFETCH(pointer) __builtin_prefetch((const void *)(size_t)(pointer))
#endif
#endif
#ifndef PREFETCH
#define PREFETCH(pointer)
#endif

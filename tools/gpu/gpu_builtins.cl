// SPDX-License-Identifier: Apache-2.0
// Bodies of the OpenCL built-ins that the kernels call, for clang's targets of NVIDIA and AMD; clang's own header
// declares them. Compiled to bitcode by itself, of which a kernel takes what it calls.
//
// Division and sqrt are rounded correctly, as the package asks drivers that can do it. A barrier orders memory within a
// group; an atomic is relaxed, as OpenCL C 1.2 has it.
#pragma OPENCL FP_CONTRACT OFF
#define BUILTIN __attribute__((overloadable, always_inline))
#define BY_AXIS(f, d) ((d) == 0 ? f(x) : (d) == 1 ? f(y) : f(z))

#if defined(__NVPTX__)
#define LOCAL_ID(axis) __nvvm_read_ptx_sreg_tid_##axis()
#define GROUP_ID(axis) __nvvm_read_ptx_sreg_ctaid_##axis()
#define LOCAL_SIZE(axis) __nvvm_read_ptx_sreg_ntid_##axis()
#define GROUPS(axis) __nvvm_read_ptx_sreg_nctaid_##axis()
#define BARRIER() __nvvm_bar_sync(0)
#elif defined(__AMDGCN__)
#define LOCAL_ID(axis) __builtin_amdgcn_workitem_id_##axis()
#define GROUP_ID(axis) __builtin_amdgcn_workgroup_id_##axis()
#define LOCAL_SIZE(axis) __builtin_amdgcn_workgroup_size_##axis()
#define GROUPS(axis) (__builtin_amdgcn_grid_size_##axis() / LOCAL_SIZE(axis))
#define BARRIER()                                                                                                      \
  (__builtin_amdgcn_fence(__ATOMIC_RELEASE, "workgroup"), __builtin_amdgcn_s_barrier(),                                \
   __builtin_amdgcn_fence(__ATOMIC_ACQUIRE, "workgroup"))
#endif

BUILTIN size_t get_local_id(uint d) { return BY_AXIS(LOCAL_ID, d); }
BUILTIN size_t get_group_id(uint d) { return BY_AXIS(GROUP_ID, d); }
BUILTIN size_t get_local_size(uint d) { return BY_AXIS(LOCAL_SIZE, d); }
BUILTIN size_t get_num_groups(uint d) { return BY_AXIS(GROUPS, d); }
BUILTIN size_t get_global_size(uint d) { return get_num_groups(d) * get_local_size(d); }
BUILTIN size_t get_global_id(uint d) { return get_group_id(d) * get_local_size(d) + get_local_id(d); }
BUILTIN size_t get_global_offset(uint d) { return 0; }

__attribute__((overloadable, always_inline, convergent)) void barrier(cl_mem_fence_flags flags) { BARRIER(); }

BUILTIN float fma(float a, float b, float c) { return __builtin_fmaf(a, b, c); }
BUILTIN float mad(float a, float b, float c) { return a * b + c; }
BUILTIN float sqrt(float x) { return __builtin_sqrtf(x); }
BUILTIN float4 sqrt(float4 x) { return (float4)(sqrt(x.x), sqrt(x.y), sqrt(x.z), sqrt(x.w)); }
BUILTIN float fabs(float x) { return __builtin_fabsf(x); }
BUILTIN float4 fabs(float4 x) { return (float4)(fabs(x.x), fabs(x.y), fabs(x.z), fabs(x.w)); }
BUILTIN float ceil(float x) { return __builtin_ceilf(x); }
BUILTIN float floor(float x) { return __builtin_floorf(x); }
BUILTIN float trunc(float x) { return __builtin_truncf(x); }
BUILTIN float rint(float x) { return __builtin_rintf(x); }
BUILTIN float fmin(float a, float b) { return __builtin_fminf(a, b); }
BUILTIN float fmax(float a, float b) { return __builtin_fmaxf(a, b); }
BUILTIN float min(float a, float b) { return b < a ? b : a; }
BUILTIN float max(float a, float b) { return a < b ? b : a; }
BUILTIN float clamp(float x, float low, float high) { return min(max(x, low), high); }
BUILTIN float2 fma(float2 a, float2 b, float2 c) { return __builtin_elementwise_fma(a, b, c); }
BUILTIN float3 fma(float3 a, float3 b, float3 c) { return __builtin_elementwise_fma(a, b, c); }
BUILTIN float4 fma(float4 a, float4 b, float4 c) { return __builtin_elementwise_fma(a, b, c); }

#define WHOLE(type)                                                                                                    \
  BUILTIN type min(type a, type b) { return b < a ? b : a; }                                                           \
  BUILTIN type max(type a, type b) { return a < b ? b : a; }                                                           \
  BUILTIN type clamp(type x, type low, type high) { return min(max(x, low), high); }
WHOLE(int)
WHOLE(uint)
WHOLE(long)
WHOLE(ulong)

#define BITS(type)                                                                                                     \
  BUILTIN type clz(type x) { return x ? __builtin_clz(x) : 32; }                                                       \
  BUILTIN type popcount(type x) { return __builtin_popcount(x); }                                                      \
  BUILTIN type mul24(type a, type b) { return a * b; }                                                                 \
  BUILTIN type mad24(type a, type b, type c) { return a * b + c; }
BITS(int)
BITS(uint)
BUILTIN uint mul_hi(uint a, uint b) { return (ulong)a * b >> 32; }
BUILTIN int select(int a, int b, int c) { return c ? b : a; }
BUILTIN uint select(uint a, uint b, uint c) { return c ? b : a; }
BUILTIN float select(float a, float b, int c) { return c ? b : a; }

#define ATOMIC(name, operation, space, type, scope)                                                                    \
  BUILTIN type name(volatile space type *p, type value) {                                                              \
    return __scoped_atomic_fetch_##operation(p, value, __ATOMIC_RELAXED, scope);                                       \
  }
#define ATOMICS_OF(space, type, scope)                                                                                 \
  ATOMIC(atomic_add, add, space, type, scope)                                                                          \
  ATOMIC(atomic_sub, sub, space, type, scope)                                                                          \
  ATOMIC(atomic_min, min, space, type, scope)                                                                          \
  ATOMIC(atomic_max, max, space, type, scope)                                                                          \
  ATOMIC(atomic_and, and, space, type, scope)                                                                          \
  ATOMIC(atomic_or, or, space, type, scope)                                                                            \
  ATOMIC(atomic_xor, xor, space, type, scope)                                                                          \
  BUILTIN type atomic_inc(volatile space type *p) { return atomic_add(p, (type)1); }                                   \
  BUILTIN type atomic_dec(volatile space type *p) { return atomic_sub(p, (type)1); }                                   \
  BUILTIN type atomic_xchg(volatile space type *p, type value) {                                                       \
    return __scoped_atomic_exchange_n(p, value, __ATOMIC_RELAXED, scope);                                              \
  }
ATOMICS_OF(__local, int, __MEMORY_SCOPE_WRKGRP)
ATOMICS_OF(__local, uint, __MEMORY_SCOPE_WRKGRP)
ATOMICS_OF(__global, int, __MEMORY_SCOPE_DEVICE)
ATOMICS_OF(__global, uint, __MEMORY_SCOPE_DEVICE)

#define MEMORY4(space, type)                                                                                           \
  BUILTIN type##4 vload4(size_t i, const space type *p) {                                                              \
    p += 4 * i;                                                                                                        \
    return (type##4)(p[0], p[1], p[2], p[3]);                                                                          \
  }                                                                                                                    \
  BUILTIN void vstore4(type##4 v, size_t i, space type *p) {                                                           \
    p += 4 * i;                                                                                                        \
    p[0] = v.x, p[1] = v.y, p[2] = v.z, p[3] = v.w;                                                                    \
  }
MEMORY4(__global, float)
MEMORY4(__local, float)
MEMORY4(__global, int)
MEMORY4(__local, int)
MEMORY4(__global, uint)
MEMORY4(__local, uint)

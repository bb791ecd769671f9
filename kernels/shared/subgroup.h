// Exchange of values between the items of a sub-group. A sub-group has SUBGROUP items; without exchange SUBGROUP is 1.
// An item's number in its sub-group is the lowest bits of its local id (clsplat/device/context.py tests this).
#ifndef SUBGROUP
#define SUBGROUP 1
#endif
#ifdef SUBGROUP_IS_ASKED // for drivers on which a kernel must request its sub-group size
#define SUBGROUPED __attribute__((intel_reqd_sub_group_size(SUBGROUP)))
#else
#define SUBGROUPED
#endif

// EXCHANGED(x, step): the value of x in the item whose number differs from this item's number in the bit `step`. Every
// item must execute it.
#if defined(SHUFFLE_KHR)
#pragma OPENCL EXTENSION cl_khr_subgroup_shuffle : enable
#define EXCHANGED(x, step) sub_group_shuffle_xor(x, (uint)(step))
#elif defined(SHUFFLE_INTEL)
#pragma OPENCL EXTENSION cl_intel_subgroups : enable
#define EXCHANGED(x, step) intel_sub_group_shuffle_xor(x, (uint)(step))
#elif defined(SHUFFLE_PTX)
#define EXCHANGED(x, step) exchanged(x, step)
static inline float exchanged(float x, int step) {
  int got;
  __asm__ volatile("shfl.sync.bfly.b32 %0, %1, %2, 31, -1;" : "=r"(got) : "r"(as_int(x)), "r"(step));
  return as_float(got);
}
#elif defined(SHUFFLE_AMD) // a wave (sub-group in hardware) may have twice as many items as SUBGROUP
#define EXCHANGED(x, step) exchanged(x, step)
static inline float exchanged(float x, int step) {
  const int lane = __builtin_amdgcn_mbcnt_hi(-1, __builtin_amdgcn_mbcnt_lo(-1, 0));
  return as_float(__builtin_amdgcn_ds_bpermute(4 * (lane ^ step), as_int(x)));
}
#elif SUBGROUP == 1
#define EXCHANGED(x, step) (x)
#endif

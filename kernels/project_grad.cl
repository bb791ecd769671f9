// The gradient of projection: sums a Gaussian's slots in the order of its tiles, then applies the chain rule to reach
// its parameters. project_step also updates the parameters by Adam, so that it writes no gradient to memory.
//
// Owner: A work-item owns LANES Gaussians, in add_slots one; project_grad skips invisible Gaussians. A group of
//   project_step owns ROWS Gaussians, and processes one array of the model after another.
// Launch: One work-item for each LANES Gaussians, in add_slots for each Gaussian, in groups of 64; work-items past the
//   end do nothing. project_step: groups of one item; if LANES is 1, of ROWS items.
// Buffers: slots (pairs, SLOT_STRIDE): of blend_grad.cl; or with ADDED_UP their sums (n, SLOT_STRIDE).
//   tile_counts (n); first_slots (n): the prefix sums of tile_counts. Parameters, splats and camera are those of
//     project.cl.
//   -> screen (n, 2): the gradient, plain or absolute, with respect to the mean's image position, per pixel.
//   contributions (n), with CONTRIBUTIONS: each Gaussian's blending weights, summed over all pixels.
//   by_lens (n, 4), with LENS: each Gaussian's gradient with respect to the logs of the focal lengths and, per pixel,
//     to the principal point.
//   project_grad writes gradients in the parameters' shapes, with CHUNKS (shared/chunks.h) those of the launch, but no
//     rows of invisible Gaussians. With REGION (shared/region.h) visible ones outside the region have zeros.
//   PENALTIES adds the gradient of opacity_weight o + scale_weight (s_0 + s_1 + s_2), with the opacity o and the scales
//     s_k.
// Equations: docs/gradients.md, (25) to (41) in the forms (50), (52) and (58) to (61); (55); (42); (91); (144) and
//   (145). With RAYS docs/cameras.md, (22) to (29).
#if defined(ADAM) && LANES == 1
#define OWN_ROW
#endif
#include "shared/math.h"
#ifdef RAYS
#define NEEDS_TANGENTS
#else
#define NEEDS_GRADIENT
#endif
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/splat.h"
#include "shared/gaussian.h"
#include "shared/sh.h"
#include "shared/chunks.h"
#include "shared/region.h"
#ifdef RAYS
#include "shared/rays.h"
#include "shared/tangent.h"
#endif
#include "shared/project_grad.h"
#ifdef ADAM
#include "shared/adam.h"
#endif

#ifndef ADAM
// Adds the slots of a band of tiles to each Gaussian's sums. tile_counts, first_slots (n), slots (pairs, SLOT_STRIDE)
// of the band -> sums (n, SLOT_STRIDE). After all bands in order, the sums have the same bits as those in project_grad.
__kernel void add_slots(const uint n, __global const uint *tile_counts, __global const uint *first_slots,
                        __global const float *slots, __global float *sums) {
  const uint i = get_global_id(0);
  if (i >= n) return;
  const uint count = tile_counts[i];
  if (count == 0) return;
  __global const float *slot = slots + (size_t)SLOT_STRIDE * first_slots[i];
  float own[SLOT_STRIDE];
  for (int field = 0; field < SLOT_STRIDE; ++field) own[field] = sums[(size_t)SLOT_STRIDE * i + field];
  for (uint k = 0; k < count; ++k, slot += SLOT_STRIDE)
    for (int field = 0; field < SLOT_STRIDE; ++field) own[field] += slot[field];
  for (int field = 0; field < SLOT_STRIDE; ++field) sums[(size_t)SLOT_STRIDE * i + field] = own[field];
}
#endif

#ifdef LENS
#define LENS_ROWS , by_lens
#else
#define LENS_ROWS
#endif
#ifdef CONTRIBUTIONS
#define VIEW_ARRAYS screen, contributions LENS_ROWS
#else
#define VIEW_ARRAYS screen LENS_ROWS
#endif

#ifndef ADAM
__kernel void project_grad(const uint n, const int coefficients, __constant float *camera,
                           __global const uint *tile_counts, __global const uint *first_slots,
                           __global const float *slots, __global const float *splats, __global const float *means,
                           __global const float *quaternions, __global const float *log_scales,
                           __global const float *opacity_logits, __global const float *sh_dc,
                           __global const float *sh_rest, __global float *d_means, __global float *d_quaternions,
                           __global float *d_log_scales, __global float *d_opacity_logits, __global float *d_sh_dc,
                           __global float *d_sh_rest, __global float *screen
#ifdef CONTRIBUTIONS
                           ,
                           __global float *contributions
#endif
#ifdef LENS
                           ,
                           __global float *by_lens
#endif
                               PENALTY_PARAMETERS CHUNK_PARAMETERS REGION_PARAMETERS) {
  const uint first_row = get_global_id(0) * LANES;
  if (first_row >= n) return;
#ifdef CHUNKS
  const long ahead = rows_ahead(chunks, first_row);
  const uint end = end_of_rows(first_row, n, ahead, model_rows);
  if (first_row >= end) return;
  MOVE_ROWS(ahead, )
#else
  const uint end = n;
#endif
  int shown[LANES];
  Gradients d;
  if (!gradients_of(end, first_row, coefficients, camera, tile_counts, first_slots, slots, splats, means, quaternions,
                    log_scales, opacity_logits, sh_rest, VIEW_ARRAYS,
                    d_sh_rest + (size_t)3 * (coefficients - 1) * first_row, shown, &d PENALTY_WEIGHTS REGION_NUMBERS))
    return;
  for (uint lane = 0; lane < LANES; ++lane) {
    const size_t i = first_row + lane;
    if (!shown[lane]) continue;
    for (int k = 0; k < 3; ++k) d_means[3 * i + k] = d.mean[k].lane[lane];
    for (int k = 0; k < 4; ++k) d_quaternions[4 * i + k] = d.quaternion[k].lane[lane];
    for (int k = 0; k < 3; ++k) d_log_scales[3 * i + k] = d.scale[k].lane[lane];
    d_opacity_logits[i] = d.opacity.lane[lane];
    for (int k = 0; k < 3; ++k) d_sh_dc[3 * i + k] = SH_CONSTANT * d.colour[k].lane[lane];
  }
}
#else

#define BLOCKS (ROWS / LANES)
#define ROW_ALIGNED __attribute__((aligned(4 * ABREAST)))
#define SH_FLOATS (3 * SH_HIGHER) // number of floats in a Gaussian's SH bands from degree 1 on
// MODEL(EACH) calls the macro EACH for each array of the model, with the array's number, its name, floats per row,
// gradients or their place, and values of the fields root and limit2 of Step (shared/adam.h).
#ifdef NO_SH_REST
#define ARRAYS 5
#define SH_REST(EACH)
#else
#define ARRAYS 6
#define SH_REST(EACH) EACH(5, sh_rest, sh_width, by_sh_rest, root_sh_rest, limit2_sh)
#endif
#define MODEL(EACH)                                                                                                    \
  EACH(0, means, 3, by_mean, root, limit2)                                                                             \
  EACH(1, quaternions, 4, by_quaternion, root, limit2)                                                                 \
  EACH(2, log_scales, 3, by_log_scale, root, limit2)                                                                   \
  EACH(3, opacity_logits, 1, by_opacity, root, limit2)                                                                 \
  EACH(4, sh_dc, 3, by_sh_dc, root, limit2_sh)                                                                         \
  SH_REST(EACH)

#if LANES > 1
// Updates LANES rows by Adam, or fewer at the end of the n rows. gradients (LANES, width): zero in rows that are not
// `shown`.
static inline void step_rows(const uint n, const uint first_row, const uint width, const int *shown,
                             const float *gradients, Step s, Stepped model) {
  const size_t begin = (size_t)first_row * width;
  const uint count = min((uint)LANES, n - first_row) * width;
#if defined(SPARSE) || defined(VISIBLE)
  int some = 0;
  for (uint lane = 0; lane < LANES; ++lane) some |= shown[lane];
  if (!some) return;
#endif
#ifdef VISIBLE
  int taken[SH_FLOATS * LANES] ROW_ALIGNED;
  for (uint lane = 0; lane < LANES; ++lane)
    for (uint k = 0; k < width; ++k) taken[lane * width + k] = -shown[lane];
#define TAKEN(k, g) *(const intL *)(taken + (k) * LANES)
#elif defined(SPARSE)
#define TAKEN(k, g) ((g) != 0.0f)
#else
#define TAKEN(k, g) (intL)(-1)
#endif
  ulong left = 0; // a bit for each vector that has a refused element or goes past the last row
  for (uint k = 0; k < width; ++k) {
    const floatL g = *(const floatL *)(gradients + k * LANES);
    if ((k + 1) * LANES > count || !step_vector(begin + k * LANES, g, TAKEN(k, g), s, model)) left |= (ulong)1 << k;
  }
  if (left == 0) return;
  for (uint i = 0; i < count; ++i) {
    if (!(left >> (i / LANES) & 1)) continue;
#ifdef VISIBLE
    if (!shown[i / width]) continue;
#elif defined(SPARSE)
    if (gradients[i] == 0.0f) continue;
#endif
    step_element(begin + i, gradients[i], s, model);
  }
}
#else
#define ROLLED _Pragma("unroll 1")
// Arguments for the update of one array of the model by a work-group. begin: where the array's gradients (rows, width)
// begin in local memory; the other scalars are as in Step. These structs are in local memory, because so many pointers
// do not fit into the scalar registers of AMD's GPUs.
typedef struct {
  Stepped model;
  ushort begin, width;
  float rate, root, limit2;
} GroupStep;
#endif

// Computes the gradients, and updates the parameters and their moments `first` and `second` by Adam. Invisible
// Gaussians are updated with gradients of zero; with VISIBLE they do not change. With SPARSE, elements with a zero
// gradient do not change. readback (READBACK_SIZE) counts refusals; after a stopped pass (duplicate.cl) nothing
// changes. The other scalars are those of Step (shared/adam.h), one per parameter group where they differ. CHUNKS: see
// shared/chunks.h.
__kernel void project_step(
    const uint n, const int coefficients, __constant float *camera, __global const uint *tile_counts,
    __global const uint *first_slots, __global const float *slots, __global const float *splats, __global float *screen
#ifdef CONTRIBUTIONS
    ,
    __global float *contributions
#endif
        PENALTY_PARAMETERS REGION_PARAMETERS,
    const float beta1, const float beta2, const float epsilon, const float root, const float root_sh_rest,
    const float rate_means, const float rate_quaternions, const float rate_log_scales, const float rate_opacity_logits,
    const float rate_sh_dc, const float rate_sh_rest, const float limit2, const float limit2_sh,
    __global uint *readback, __global float *means, __global float *quaternions, __global float *log_scales,
    __global float *opacity_logits, __global float *sh_dc, __global float *sh_rest, __global float *first_means,
    __global float *first_quaternions, __global float *first_log_scales, __global float *first_opacity_logits,
    __global float *first_sh_dc, __global float *first_sh_rest, __global float *second_means,
    __global float *second_quaternions, __global float *second_log_scales, __global float *second_opacity_logits,
    __global float *second_sh_dc, __global float *second_sh_rest CHUNK_PARAMETERS) {
#ifdef CHUNKS // defines `end`, where the rows from `row` on end, and moves the model's arrays to these rows
#define MODEL_ROWS(row)                                                                                                \
  const long ahead = (row) < n ? rows_ahead(chunks, row) : 0;                                                          \
  const uint end = (row) < n ? end_of_rows(row, n, ahead, model_rows) : 0;                                             \
  MOVE_ROWS(ahead, )                                                                                                   \
  MOVE_ROWS(ahead, first_)                                                                                             \
  MOVE_ROWS(ahead, second_)
#else
#define MODEL_ROWS(row) const uint end = n;
#endif
#define STEP_OF(group, root, limit2)                                                                                   \
  const Stepped model = {group, first_##group, second_##group};                                                        \
  const Step s = {rate_##group, root, beta1, beta2, epsilon, limit2, readback};
  Gradients d;
  const uint sh_width = 3 * (coefficients - 1);
#if LANES > 1
  // Updates one array of the model after another, so that accesses run long enough for the processor's prefetcher.
  const uint begin = get_global_id(0) * BLOCKS * LANES;
  if (begin >= n || readback[READBACK_STOPPED]) return;
  MODEL_ROWS(begin)
  if (begin >= end) return;
  int shown[ROWS];
  const uint blocks = min((end - begin - 1) / LANES + 1, (uint)BLOCKS);
  float by_mean[3 * ROWS] ROW_ALIGNED, by_quaternion[4 * ROWS] ROW_ALIGNED, by_log_scale[3 * ROWS] ROW_ALIGNED;
  float by_opacity[ROWS] ROW_ALIGNED, by_sh_dc[3 * ROWS] ROW_ALIGNED, by_sh_rest[SH_FLOATS * ROWS] ROW_ALIGNED;
#ifndef NO_SH_REST
  for (uint k = 0; k < sh_width * blocks; ++k) *(floatL *)(by_sh_rest + k * LANES) = (floatL)(0.0f);
#endif
  for (uint block = 0; block < blocks; ++block) {
    int *seen = shown + block * LANES;
    const int any = gradients_of(end, begin + block * LANES, coefficients, camera, tile_counts, first_slots, slots,
                                 splats, means, quaternions, log_scales, opacity_logits, sh_rest, VIEW_ARRAYS,
                                 by_sh_rest + block * LANES * sh_width, seen, &d PENALTY_WEIGHTS REGION_NUMBERS);
    for (uint lane = 0; lane < LANES; ++lane) {
      const uint i = block * LANES + lane;
      const int one = any && seen[lane];
      for (int k = 0; k < 3; ++k) by_mean[3 * i + k] = one ? d.mean[k].lane[lane] : 0.0f;
      for (int k = 0; k < 4; ++k) by_quaternion[4 * i + k] = one ? d.quaternion[k].lane[lane] : 0.0f;
      for (int k = 0; k < 3; ++k) by_log_scale[3 * i + k] = one ? d.scale[k].lane[lane] : 0.0f;
      by_opacity[i] = one ? d.opacity.lane[lane] : 0.0f;
      for (int k = 0; k < 3; ++k) by_sh_dc[3 * i + k] = one ? SH_CONSTANT * d.colour[k].lane[lane] : 0.0f;
    }
  }
#define STEP_ARRAY(number, group, width, gradients, root, limit2)                                                      \
  {                                                                                                                    \
    STEP_OF(group, root, limit2)                                                                                       \
    for (uint block = 0; block < blocks; ++block)                                                                      \
      step_rows(end, begin + block * LANES, width, shown + block * LANES, gradients + block * LANES * (width), s,      \
                model);                                                                                                \
  }
  MODEL(STEP_ARRAY)

#else // LANES == 1
  // Each item computes the gradients of a Gaussian. Then the items together update one array of the model after
  // another.
  //
  // `gradients` has the SH coefficients, then the gradients of sh_rest, and once sh_rest is stepped, all others.
  // So a group takes little local memory, and more groups fit into a unit. The constants are the arrays' places in it.
  __local float gradients[SH_FLOATS * ROWS] ROW_ALIGNED;
  enum {
    by_sh_rest = 0,
    by_mean = 0,
    by_quaternion = 3 * ROWS,
    by_log_scale = 7 * ROWS,
    by_opacity = 10 * ROWS,
    by_sh_dc = 11 * ROWS
  };
#if defined(SPARSE) || defined(VISIBLE)
  __local int in_view[ROWS];
#define ROW_SHOWN(k, width) -in_view[(k) / (width)]
#else
#define ROW_SHOWN(k, width) -1
#endif
#ifdef SPARSE
#define TAKEN(k, width, gradient) -((gradient) != 0.0f)
#else
#define TAKEN(k, width, gradient) ROW_SHOWN(k, width)
#endif
  __local GroupStep steps[ARRAYS];
  const uint me = get_local_id(0), first_row = get_global_id(0) - me;
  MODEL_ROWS(first_row)
  const uint rows = first_row < end ? min((uint)get_local_size(0), end - first_row) : 0;
  const uint stopped = readback[READBACK_STOPPED];
  const uint own = ABREAST * me, stride = ABREAST * get_local_size(0);
  const int aligned = first_row % ABREAST == 0; // false only if a driver allows fewer than ABREAST items in a group
#define GROUP_STEP(number, group, columns, by, root, limit2) /* the last array is stepped first */                     \
  steps[(number + 1) % ARRAYS] =                                                                                       \
      (GroupStep){{group, first_##group, second_##group}, by, columns, rate_##group, root, limit2};
  if (me == 0) {
    MODEL(GROUP_STEP)
  }
#if defined(SPARSE) || defined(VISIBLE)
  in_view[me] = me < rows && tile_counts[first_row + me] > 0;
  barrier(CLK_LOCAL_MEM_FENCE);
#endif
  // Adjacent items read adjacent SH coefficients. If each item read its own row, every access would touch a cache line
  // per item.
  __global const float *from = sh_rest + (size_t)sh_width * first_row;
  const uint floats = sh_width * rows, whole_floats = aligned ? floats / ABREAST * ABREAST : 0;
#define WANTED(k) ((k) < whole_floats && (ROW_SHOWN(k, sh_width) | ROW_SHOWN((k) + ABREAST - 1, sh_width)))
  // An item waits once for all its parameters, and once for each six vectors of SH coefficients.
  const size_t mine = first_row + me;
  float mean[3], quaternion[4], log_scale[3], logit[1];
  uint tiles[1] = {0}, slot[1] = {0};
  if (me < rows && ROW_SHOWN(me, 1)) {
    tiles[0] = tile_counts[mine];
    slot[0] = first_slots[mine];
    UNROLL for (int k = 0; k < 3; ++k) mean[k] = means[3 * mine + k];
    UNROLL for (int k = 0; k < 4; ++k) quaternion[k] = quaternions[4 * mine + k];
    UNROLL for (int k = 0; k < 3; ++k) log_scale[k] = log_scales[3 * mine + k];
    logit[0] = opacity_logits[mine];
  }
  for (uint k = own; k < whole_floats; k += 6 * stride) {
    floatA ahead[6];
    UNROLL for (uint i = 0; i < 6; ++i) {
      if (WANTED(k + i * stride)) ahead[i] = LOADA(from + k + i * stride);
    }
    UNROLL for (uint i = 0; i < 6; ++i) {
      if (WANTED(k + i * stride)) *(__local floatA *)(gradients + k + i * stride) = ahead[i];
    }
  }
  for (uint k = whole_floats + me; k < floats; k += stride / ABREAST) gradients[k] = from[k];
  barrier(CLK_LOCAL_MEM_FENCE);
  __local float *own_sh_rest = gradients + sh_width * me; // gradients_of replaces the coefficients by their gradients
  int any = 0, shown[1] = {0};
  if (me < rows && !stopped)
    any = gradients_of(end, mine, coefficients, camera, tiles, slot, slots, splats, mean, quaternion, log_scale, logit,
                       sh_rest, VIEW_ARRAYS, own_sh_rest, shown, &d PENALTY_WEIGHTS REGION_NUMBERS);
#ifndef NO_SH_REST
  for (uint k = any ? 3 * (SH_USED(coefficients) - 1) : 0; k < sh_width; ++k) own_sh_rest[k] = 0.0f;
#endif
  barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);     // the gradients of sh_rest are complete
  ROLLED for (int number = 0; number < ARRAYS; ++number) { // not unrolled: the code would be six times as long
    if (number == ARRAYS - 5) {                            // sh_rest is done
      barrier(CLK_LOCAL_MEM_FENCE);
      UNROLL for (int k = 0; k < 3; ++k) gradients[by_mean + 3 * me + k] = any ? d.mean[k].all : 0.0f;
      UNROLL for (int k = 0; k < 4; ++k) gradients[by_quaternion + 4 * me + k] = any ? d.quaternion[k].all : 0.0f;
      UNROLL for (int k = 0; k < 3; ++k) gradients[by_log_scale + 3 * me + k] = any ? d.scale[k].all : 0.0f;
      gradients[by_opacity + me] = any ? d.opacity.all : 0.0f;
      UNROLL for (int k = 0; k < 3; ++k) gradients[by_sh_dc + 3 * me + k] = any ? SH_CONSTANT * d.colour[k].all : 0.0f;
      barrier(CLK_LOCAL_MEM_FENCE);
    }
    const GroupStep step = steps[number];
    __local const float *by = gradients + step.begin;
    const Step s = {step.rate, step.root, beta1, beta2, epsilon, step.limit2, readback};
    const uint width = step.width, count = stopped ? 0 : rows * width, whole = aligned ? count : 0;
    const size_t begin = (size_t)width * first_row, at = begin + own;
    Stepped model = {step.model.parameters + at, step.model.first + at, step.model.second + at};
    uint left = 0; // a bit for each vector that has a refused element or goes past the last row
    ROLLED for (uint k = own, bit = 1; k < count; k += stride, bit += bit) {
      const floatA g = *(__local const floatA *)(by + k);
      const intA taken =
          (intA)(TAKEN(k, width, g.x), TAKEN(k + 1, width, g.y), TAKEN(k + 2, width, g.z), TAKEN(k + 3, width, g.w));
      if (ANYA(taken) && (k + ABREAST > whole || !step_vector(0, g, taken, s, model))) left |= bit;
      model.parameters += stride, model.first += stride, model.second += stride;
    }
    for (uint k = own; left != 0; k += stride, left >>= 1)
      for (uint i = k; (left & 1) && i < min(k + ABREAST, count); ++i)
        if (TAKEN(i, width, by[i])) step_element(begin + i, by[i], s, step.model);
  }
#endif
}
#endif

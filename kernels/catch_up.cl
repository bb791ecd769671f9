// Catches up chunks of a model that the views of the last steps did not show: takes the steps of Adam that these chunks
// missed, with gradients of zero. The result has the same bits as if each step had updated all rows.
//
// Owner: If LANES > 1, a group owns ROWS rows of a chunk. Otherwise a group owns ITEMS vectors of one array of a chunk.
// Launch: If LANES > 1, groups of one item, CHUNK_ROWS / ROWS for each entry of `chunks`. Otherwise groups of ITEMS
//   items; for each entry of `chunks`, PIECES groups for each float of a row.
// Buffers: chunks (entries): numbers of chunks, or NO_CHUNK.
//   last (entries): the last step that updated the chunk with its gradients.
//   caught (chunks of the model): the step up to which each chunk has been caught up.
//   table (steps, TABLE_NUMBERS), a row for each step from `first_step` on: the field `root` of Step, first for all
//     groups but sh_rest, then for sh_rest (0 if the step does not update sh_rest); then the rates of the six parameter
//     groups.
//   Parameters and both moments (model_rows rows): updated up to step `step`.
//   readback (READBACK_SIZE): counts refusals. After a stopped pass (duplicate.cl) nothing changes.
//   sh_width: floats of sh_rest in a row. limit2_sh: the field `limit2` of Step for sh_dc and sh_rest;
//   limit2: for the other groups. The other scalars are fields of Step (shared/adam.h).
// Equations: docs/gradients.md, (42); (193) tells when a parameter no longer changes, so that further steps only
//   multiply its moments.
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/adam.h"

#define TABLE_NUMBERS 8
#define TABLE_ROOT 0
#define TABLE_ROOT_SH_REST 1
#define TABLE_RATES 2

#if LANES > 1
#define AS_INTA AS_INTL
#else
#define AS_INTA as_int4
#endif

#define BLOCK 16         // number of steps between two checks for parameters that no longer change
#define LEAST_BETA2 0.9f // least beta2 for which equation (193) of docs/gradients.md holds throughout a block of steps
// 2^-28. A movement below this fraction of a parameter changes no bit of it, as half an ulp is 2^-25 of it or more.
#define STILL 3.725290298e-9f

// The missed steps of one array of a chunk. rates, roots: the array's columns of the table, from the first missed step
// on; highest: the largest rate, or INFINITY if equation (193) of docs/gradients.md does not apply.
typedef struct {
  __global const float *rates, *roots;
  uint steps;
  float highest;
  Step constants;
} Missed;

static inline Missed missed_steps(__global const float *rates, __global const float *roots, uint steps, Step s) {
  Missed missed = {rates, roots, steps, s.beta2 >= LEAST_BETA2 ? 0.0f : INFINITY, s};
  for (uint k = 0; k < steps; ++k) missed.highest = fmax(missed.highest, rates[TABLE_NUMBERS * k]);
  return missed;
}

// Takes the missed steps of element i, from the missed step with index `from` on.
RARE void catch_up_element(size_t i, uint from, Missed missed, Stepped model) {
  Step s = missed.constants;
  for (uint k = from; k < missed.steps; ++k) {
    s.rate = missed.rates[TABLE_NUMBERS * k];
    s.root = missed.roots[TABLE_NUMBERS * k];
    if (s.root != 0.0f) step_element(i, 0.0f, s, model);
  }
}

// Takes the missed steps of ABREAST elements from i on. The result has the same bits as steps by step_vector.
__attribute__((always_inline)) static inline void catch_up_vector(size_t i, Missed missed, Stepped model) {
  const Step s = missed.constants;
  const floatA beta1 = s.beta1, beta2 = s.beta2, none = 0.0f;
  floatA p = LOADA(model.parameters + i), m = LOADA(model.first + i), v = LOADA(model.second + i);
  for (uint begin = 0; begin < missed.steps; begin += BLOCK) {
    const uint end = min(begin + BLOCK, missed.steps);
    const intA lost = missed.highest * fabs(m) < STILL * fabs(p) * sqrt(v);
    const intA still = (m == 0.0f & v >= 0.0f | lost) & fmaA(p, p, v) < s.limit2;
    if (!ANYA(~still)) { // no parameter changes in this block
      const floatA next_m = fmaA(beta1, m, none), next_v = fmaA(beta2, v, none);
      if (ANYA(AS_INTA(next_m) != AS_INTA(m))) {
        for (uint k = begin; k < end; ++k) {
          if (missed.roots[TABLE_NUMBERS * k] == 0.0f) continue;
          m = fmaA(beta1, m, none);
          v = fmaA(beta2, v, none);
        }
      } else if (ANYA(AS_INTA(next_v) != AS_INTA(v))) {
        for (uint k = begin; k < end; ++k)
          if (missed.roots[TABLE_NUMBERS * k] != 0.0f) v = fmaA(beta2, v, none);
      } else {
        break; // neither the moments nor the parameter change any more
      }
      continue;
    }
    const floatA p_before = p, m_before = m, v_before = v;
    intA taken = (intA)(-1);
    for (uint k = begin; k < end; ++k) {
      const float rate = missed.rates[TABLE_NUMBERS * k], root = missed.roots[TABLE_NUMBERS * k];
      if (root == 0.0f) continue;
      m = fmaA(beta1, m, none);
      v = fmaA(beta2, v, none);
      p = p - movement(rate, root, s.epsilon, m, v);
      taken &= fmaA(p, p, v) < s.limit2;
    }
    if (ANYA(~taken)) { // a step of some element is refused in this block
      STOREA(p_before, model.parameters + i);
      STOREA(m_before, model.first + i);
      STOREA(v_before, model.second + i);
      for (uint lane = 0; lane < ABREAST; ++lane) catch_up_element(i + lane, begin, missed, model);
      return;
    }
  }
  STOREA(p, model.parameters + i);
  STOREA(m, model.first + i);
  STOREA(v, model.second + i);
}

#define MODEL(EACH)                                                                                                    \
  EACH(0, means, 3, TABLE_ROOT, limit2)                                                                                \
  EACH(1, quaternions, 4, TABLE_ROOT, limit2)                                                                          \
  EACH(2, log_scales, 3, TABLE_ROOT, limit2)                                                                           \
  EACH(3, opacity_logits, 1, TABLE_ROOT, limit2)                                                                       \
  EACH(4, sh_dc, 3, TABLE_ROOT, limit2_sh)                                                                             \
  EACH(5, sh_rest, sh_width, TABLE_ROOT_SH_REST, limit2_sh)

__kernel void catch_up(__global const uint *chunks, const uint model_rows, __global const uint *last,
                       __global const uint *caught, const uint step, __global const float *table, const uint first_step,
                       const uint sh_width, const float beta1, const float beta2, const float epsilon,
                       const float limit2, const float limit2_sh, __global uint *readback, __global float *means,
                       __global float *quaternions, __global float *log_scales, __global float *opacity_logits,
                       __global float *sh_dc, __global float *sh_rest, __global float *first_means,
                       __global float *first_quaternions, __global float *first_log_scales,
                       __global float *first_opacity_logits, __global float *first_sh_dc, __global float *first_sh_rest,
                       __global float *second_means, __global float *second_quaternions,
                       __global float *second_log_scales, __global float *second_opacity_logits,
                       __global float *second_sh_dc, __global float *second_sh_rest) {
#if LANES > 1
  const uint pieces = CHUNK_ROWS / ROWS;
#else
#define PIECES (CHUNK_ROWS / ABREAST / ITEMS) // number of groups for one column of a chunk
  const uint pieces = PIECES * (14 + sh_width);
#endif
  const uint place = get_group_id(0) / pieces, piece = get_group_id(0) % pieces;
  const size_t chunk_row = (size_t)CHUNK_ROWS * chunks[place];
  // Intel's compiler moves this load before the return below, so the load must be valid for NO_CHUNK too.
  const uint taken = max(last[place], caught[chunk_row < model_rows ? chunks[place] : 0]);
  if (chunk_row >= model_rows || readback[READBACK_STOPPED]) return;
  // The second condition holds only in a trial of the kernel, where all arrays are zero.
  if (taken >= step || taken + 1 < first_step) return;
  const uint rows = min((size_t)CHUNK_ROWS, model_rows - chunk_row), steps = step - taken;
  __global const float *from = table + (size_t)TABLE_NUMBERS * (taken + 1 - first_step);
#if LANES > 1
  // Updates one array of the model after another, so that accesses run long enough for the processor's prefetcher.
  const uint first = ROWS * piece;
  if (first >= rows) return;
  const uint end = min(first + ROWS, rows);
#define CATCH_UP_ARRAY(number, group, width, root_at, limit)                                                           \
  {                                                                                                                    \
    const Stepped model = {group + (width) * chunk_row, first_##group + (width) * chunk_row,                           \
                           second_##group + (width) * chunk_row};                                                      \
    const Step s = {0.0f, 0.0f, beta1, beta2, epsilon, limit, readback};                                               \
    const Missed missed = missed_steps(from + TABLE_RATES + number, from + root_at, steps, s);                         \
    uint i = (width) * first;                                                                                          \
    for (; i + LANES <= (width) * end; i += LANES) catch_up_vector(i, missed, model);                                  \
    for (; i < (width) * end; ++i) catch_up_element(i, 0, missed, model);                                              \
  }
  MODEL(CATCH_UP_ARRAY)
#else
  Stepped model = {means, first_means, second_means};
  uint width = 0, rates_at = 0, roots_at = 0, past = 0, vector = 0;
  float limit = 0.0f;
#define FIND_ARRAY(number, group, columns, root_at, limit2_of_group)                                                   \
  if (piece >= past && piece < past + PIECES * (columns)) {                                                            \
    model = (Stepped){group, first_##group, second_##group};                                                           \
    width = columns, rates_at = TABLE_RATES + number, roots_at = root_at, limit = limit2_of_group;                     \
    vector = (piece - past) * ITEMS + get_local_id(0);                                                                 \
  }                                                                                                                    \
  past += PIECES * (columns);
  MODEL(FIND_ARRAY)
  const size_t ahead = width * chunk_row;
  model.parameters += ahead, model.first += ahead, model.second += ahead;
  const Step s = {0.0f, 0.0f, beta1, beta2, epsilon, limit, readback};
  const Missed missed = missed_steps(from + rates_at, from + roots_at, steps, s);
  const uint begin = ABREAST * vector, end = width * rows;
  if (begin + ABREAST <= end) {
    catch_up_vector(begin, missed, model);
  } else {
    for (uint i = begin; i < end; ++i) catch_up_element(i, 0, missed, model);
  }
#endif
}

// Notes that the chunks are caught up: caught (chunks of the model) becomes `step` for each of the `entries` chunks. So
// a step that is repeated does not catch them up again. After a stopped pass nothing changes.
__kernel void note_caught_up(const uint entries, const uint model_rows, __global const uint *chunks, const uint step,
                             __global const uint *readback, __global uint *caught) {
  const uint place = get_global_id(0);
  if (place >= entries || readback[READBACK_STOPPED]) return;
  if ((size_t)CHUNK_ROWS * chunks[place] < model_rows) caught[chunks[place]] = step;
}

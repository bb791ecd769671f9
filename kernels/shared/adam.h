// Adam's step, (42) of docs/gradients.md (Kingma and Ba 2015, algorithm 1), for one element and for LANES consecutive
// elements.
//
// No parameter and no moment becomes NaN or infinite here. An element stays unchanged if its new values would be NaN or
// infinite, or if the square of its new parameter would reach `limit2`. Such refusals are counted in the last four
// entries of `readback` (the first four belong to compact_visible). They count by cause: the old parameter, the
// gradient, the moments, or only the step itself. Broken moments restart from zero. In the other cases the second
// moment becomes infinite and the first 0: every step is then refused until the host has repaired the row
// (docs/decisions/0016-never-a-nan.md).

// Constants of a step, and the counters of refused elements. rate: the learning rate / (1 - beta1^t); root: 1 / sqrt(1
// - beta2^t).
typedef struct {
  float rate, root, beta1, beta2, epsilon, limit2;
  __global uint *readback;
} Step;

// A parameter group with its moments.
typedef struct {
  __global float *parameters, *first, *second;
} Stepped;

// The change to subtract from a vector of parameters; *m and *v become the new moments.
static inline floatL change(floatL g, Step s, floatL *m, floatL *v) {
  *m = fmaL((floatL)(s.beta1), *m, (1.0f - s.beta1) * g);
  *v = fmaL((floatL)(s.beta2), *v, (1.0f - s.beta2) * (g * g));
  return s.rate * *m / fmaL(sqrt(*v), (floatL)(s.root), (floatL)(s.epsilon));
}

// Refuses the step of an element; p, g, m and v are its values before the step.
static inline void refuse(size_t i, Step s, float p, float g, float m, float v, __global float *first,
                          __global float *second) {
  const int parameter = p * p < s.limit2, gradient = fabs(g) < INFINITY;
  const int moments = fabs(m) < INFINITY && v >= 0.0f && v < INFINITY, marked = m == 0.0f && v == INFINITY;
  const int again = parameter && gradient && !moments && !marked;
  first[i] = 0.0f;
  second[i] = again ? 0.0f : INFINITY;
  atomic_inc(s.readback + (!parameter  ? READBACK_REFUSED_PARAMETERS
                           : !gradient ? READBACK_REFUSED_GRADIENTS
                           : again     ? READBACK_REFUSED_MOMENTS
                                       : READBACK_REFUSED_STEPS));
}

// With vectors, single elements are stepped only where one is refused. That is rare, and inlining this function
// everywhere made one compiler take half a minute.
#if LANES > 1
#define RARE __attribute__((noinline)) static
#else
#define RARE static inline
#endif

// Takes Adam's step for element i along its gradient g, like `change`.
RARE void step_element(size_t i, float g, Step s, Stepped model) {
  const float before = model.parameters[i], m_before = model.first[i], v_before = model.second[i];
  const float m = fma1(s.beta1, m_before, (1.0f - s.beta1) * g);
  const float v = fma1(s.beta2, v_before, (1.0f - s.beta2) * (g * g));
  const float p = before - s.rate * m / fma1(sqrt(v), s.root, s.epsilon);
#ifndef UNGUARDED
  if (!(fma1(p, p, v) < s.limit2)) {
    refuse(i, s, before, g, m_before, v_before, model.first, model.second);
    return;
  }
#endif
  model.first[i] = m;
  model.second[i] = v;
  model.parameters[i] = p;
}

// The step of the `taken` elements from i on. Returns 0 and stores nothing if any has to be refused. The second moment
// is a square like p * p, so one test of their sum checks both.
static inline int step_vector(size_t i, floatL g, intL taken, Step s, Stepped model) {
  const floatL before = LOADL(model.parameters + i), m_before = LOADL(model.first + i);
  const floatL v_before = LOADL(model.second + i);
  floatL m = m_before, v = v_before;
  const floatL by = change(g, s, &m, &v);
  const floatL p = before - (taken ? by : (floatL)(0.0f));
#ifndef UNGUARDED
  if (ANYL(~MASKL(fmaL(p, p, v) < s.limit2) & taken)) return 0;
#endif
  STOREL(taken ? m : m_before, model.first + i);
  STOREL(taken ? v : v_before, model.second + i);
  STOREL(p, model.parameters + i);
  return 1;
}

// Adam's step, (42) of docs/gradients.md (Kingma and Ba 2015, algorithm 1): of an element, and of LANES elements that
// follow each other.
//
// No parameter and no moment becomes NaN or infinite here. An element is left as it is where its new values would be,
// or where its parameter's square would not be less than `limit2`. It is counted in the last four of `readback`, of
// which compact_visible has the first four: by the parameter that it had, its gradient, its moments, or all of these
// well and the step not. Moments that are broken begin again from zero. In the other cases the second moment becomes
// infinite and the first 0, which refuses every step until the host has seen to the row
// (docs/decisions/0016-never-a-nan.md).

// Constants of a step, and where refused elements are counted. rate: the learning rate / (1 - beta1^t); root:
// 1 / sqrt(1 - beta2^t).
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

// Refuses the step of an element: p, g, m and v as they were before it.
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

// With vectors an element has a step of its own where one is refused: rarely, and a compiler took half a minute to put
// it everywhere.
#if LANES > 1
#define RARE __attribute__((noinline)) static
#else
#define RARE static inline
#endif

// The step of element i along its gradient g, by `change`.
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

// The step of those elements from i on that are `taken`. Returns 0, with nothing stored, where one is to be refused: a
// second moment is a square as well, so that the sum is one test of both.
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

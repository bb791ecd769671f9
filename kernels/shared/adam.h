// Adam, equation (42) of docs/gradients.md (Kingma and Ba 2015, algorithm 1), for one element and for ABREAST
// consecutive elements.
//
// Adam writes no NaN, and no infinity except as a mark of refusal. It refuses the step of an element if the new values
// would be NaN or infinite, or if the square of the new parameter would reach `limit2`. The last four entries of
// `readback` count refusals by cause: the old parameter, the gradient, the moments, or only the new values. If only the
// old moments are not finite, they restart at zero. Otherwise the first moment becomes 0 and the second infinite, so
// that all later steps are refused until the host repairs the row (docs/decisions/0016-never-a-nan.md).

// Number of elements that a work-item updates together: LANES, or four if LANES is 1. So a GPU reads 16 bytes at a
// time, and issues three reads before it waits for the first.
#if LANES > 1
#define ABREAST LANES
#define fmaA fmaL
#define ANYA(m) any_lane(m)
#define LOADA LOADL
#define STOREA STOREL
#else
#define ABREAST 4
#define fmaA fma
#define ANYA(m) (((m).x | (m).y | (m).z | (m).w) != 0)
#define LOADA(p) (*(__global const float4 *)(p))
#define STOREA(x, p) (*(__global float4 *)(p) = (x))
#endif
typedef CAT(float, ABREAST) floatA;
typedef CAT(int, ABREAST) intA;

// The constants of a step of Adam. rate: the learning rate / (1 - beta1^t); root: 1 / sqrt(1 - beta2^t); limit2: the
// square of the limit of a parameter; readback: counts refusals.
typedef struct {
  float rate, root, beta1, beta2, epsilon, limit2;
  __global uint *readback;
} Step;

// A parameter group with its moments.
typedef struct {
  __global float *parameters, *first, *second;
} Stepped;

// Refuses the step of element i: counts the refusal by cause, and sets the first moment to 0. The second becomes
// infinity, a mark of refusal, or 0 if only the old moments were not finite. p, g, m, v: the element's parameter,
// gradient and moments before the step.
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

// If LANES > 1, step_element runs only where an element of a vector is refused. That is rare, and a compiler took half
// a minute to inline the function everywhere.
#if LANES > 1
#define RARE __attribute__((noinline)) static
#else
#define RARE static inline
#endif

// Updates element i by Adam, with the gradient g.
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

// The amount that a step subtracts from parameters. m, v: the moments after the step.
__attribute__((always_inline)) static inline floatA movement(float rate, float root, float epsilon, floatA m,
                                                             floatA v) {
  return rate * m / fmaA(sqrt(v), (floatA)(root), (floatA)(epsilon));
}

// Updates those of the ABREAST elements from i on that are `taken`. If LANES is 1, i is a multiple of 4. Returns 0 and
// stores nothing if the step of some element must be refused. The second moment and p * p are not negative, so one test
// of their sum checks both. The function is always inlined, because AMD's compiler would otherwise keep Step in memory.
__attribute__((always_inline)) static inline int step_vector(size_t i, floatA g, intA taken, Step s, Stepped model) {
  const floatA before = LOADA(model.parameters + i), m_before = LOADA(model.first + i);
  const floatA v_before = LOADA(model.second + i);
  const floatA m = fmaA((floatA)(s.beta1), m_before, (1.0f - s.beta1) * g);
  const floatA v = fmaA((floatA)(s.beta2), v_before, (1.0f - s.beta2) * (g * g));
  const floatA by = movement(s.rate, s.root, s.epsilon, m, v);
  const floatA p = before - (taken ? by : (floatA)(0.0f));
#ifndef UNGUARDED
  if (ANYA(~(fmaA(p, p, v) < s.limit2) & taken)) return 0;
#endif
  STOREA(taken ? m : m_before, model.first + i);
  STOREA(taken ? v : v_before, model.second + i);
  STOREA(p, model.parameters + i);
  return 1;
}

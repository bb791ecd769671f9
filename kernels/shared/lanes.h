// Vectors of LANES floats (floatL) and ints (intL), for pixels or Gaussians: float, float4, float8 or float16 under one
// name. MASKL(comparison) is an intL in which all bits of a lane are set or clear. At LANES == 1 a comparison alone
// gives 0 or 1.
#ifndef LANES
#error "LANES must be defined: pixels per vector, 1, 4, 8 or 16"
#endif
#ifndef VECTORS // number of the shape's vectors in a floatL; widened.h makes it 2
#define VECTORS 1
#endif
#define CAT_(a, b) a##b
#define CAT(a, b) CAT_(a, b)
#if LANES == 1
typedef float floatL;
typedef int intL;
#define AS_INTL(x) as_int(x)
#define AS_FLOATL(x) as_float(x)
#define MASKL(condition) (-(condition))
#define TO_INTL(x) ((int)(x))
#define TO_FLOATL(x) ((float)(x))
#define LOADL(p) (*(p))
#define STOREL(x, p) (*(p) = (x))
#define ANYL(m) ((m) != 0)
#define LANE_INDEX 0.0f
#else
typedef CAT(float, LANES) floatL;
typedef CAT(int, LANES) intL;
#define AS_INTL(x) CAT(as_int, LANES)(x)
#define AS_FLOATL(x) CAT(as_float, LANES)(x)
#define MASKL(condition) (condition)
#define TO_INTL(x) CAT(convert_int, LANES)(x)
#define TO_FLOATL(x) CAT(convert_float, LANES)(x)
typedef floatL floatU __attribute__((aligned(4))); // vload and vstore are slow function calls in PoCL 3.0
#define LOADL(p) (*(__global const floatU *)(p))
#define STOREL(x, p) (*(__global floatU *)(p) = (x))
#define ANYL(m) any_lane(m)
#if LANES == 4
#define LANE_INDEX ((floatL)(0, 1, 2, 3))
#elif LANES == 8
#define LANE_INDEX ((floatL)(0, 1, 2, 3, 4, 5, 6, 7))
#else
#define LANE_INDEX ((floatL)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#endif
#endif

#if LANES > 1
// True if any lane of a mask is set. Some drivers do not inline any().
static inline int any_lane(intL m) {
#if LANES == 16
  const int8 a = m.lo | m.hi;
#else
#define a m
#endif
#if LANES == 4
  const long2 b = as_long2(a);
#else
  const long4 c = as_long4(a);
  const long2 b = c.lo | c.hi;
#endif
#undef a
  return (b.x | b.y) != 0;
}
#endif

static inline floatL fmaL(floatL a, floatL b, floatL c) {
#ifdef FMA_BY_CONTRACTION
#pragma OPENCL FP_CONTRACT ON
  return a * b + c;
#else
  return fma(a, b, c);
#endif
}

#if VECTORS == 1 || defined(SUMS_OF_LANES)
typedef floatL floatS;
#define fmaS fmaL
#else
#define SUMS_OF_EIGHT
typedef float8 floatS;
static inline floatS fmaS(floatS a, floatS b, floatS c) {
#ifdef FMA_BY_CONTRACTION
#pragma OPENCL FP_CONTRACT ON
  return a * b + c;
#else
  return fma(a, b, c);
#endif
}
#endif

static inline int maxL(intL x) {
#if LANES == 16
  const int8 a = max(x.lo, x.hi);
  const int4 b = max(a.lo, a.hi);
  const int2 c = max(b.lo, b.hi);
  return max(c.x, c.y);
#elif LANES == 8
  const int4 b = max(x.lo, x.hi);
  const int2 c = max(b.lo, b.hi);
  return max(c.x, c.y);
#elif LANES == 4
  const int2 c = max(x.lo, x.hi);
  return max(c.x, c.y);
#else
  return x;
#endif
}

// The sum of the lanes in a fixed order: adds lanes that are LANES / 2 apart, then LANES / 4, and so on.
static inline float sumL(floatL x) {
#if LANES == 16
  const float8 a = x.lo + x.hi;
  const float4 b = a.lo + a.hi;
  const float2 c = b.lo + b.hi;
  return c.x + c.y;
#elif LANES == 8
  const float4 b = x.lo + x.hi;
  const float2 c = b.lo + b.hi;
  return c.x + c.y;
#elif LANES == 4
  const float2 c = x.lo + x.hi;
  return c.x + c.y;
#else
  return x;
#endif
}

#ifndef SUMS_OF_EIGHT
#define sumS sumL
#else
static inline float sumS(floatS x) {
  const float4 b = x.lo + x.hi;
  const float2 c = b.lo + b.hi;
  return c.x + c.y;
}
#endif

#if LANES >= 8
#if LANES == 16 && !defined(SUMS_OF_EIGHT)
#define EIGHT(x) ((x).lo + (x).hi)
#else
#define EIGHT(x) (x)
#endif
// The sums of eight vectors, each in the order of sumS, in fewer steps than eight separate calls.
static inline float8 sums8(floatS x0, floatS x1, floatS x2, floatS x3, floatS x4, floatS x5, floatS x6, floatS x7) {
  const float8 a = EIGHT(x0), b = EIGHT(x1), c = EIGHT(x2), d = EIGHT(x3);
  const float8 e = EIGHT(x4), f = EIGHT(x5), g = EIGHT(x6), h = EIGHT(x7);
  const float8 ae = (float8)(a.lo, e.lo) + (float8)(a.hi, e.hi);
  const float8 bf = (float8)(b.lo, f.lo) + (float8)(b.hi, f.hi);
  const float8 cg = (float8)(c.lo, g.lo) + (float8)(c.hi, g.hi);
  const float8 dh = (float8)(d.lo, h.lo) + (float8)(d.hi, h.hi);
  const float8 abef = (float8)(ae.s01, bf.s01, ae.s45, bf.s45) + (float8)(ae.s23, bf.s23, ae.s67, bf.s67);
  const float8 cdgh = (float8)(cg.s01, dh.s01, cg.s45, dh.s45) + (float8)(cg.s23, dh.s23, cg.s67, dh.s67);
  return (float8)(abef.s02, cdgh.s02, abef.s46, cdgh.s46) + (float8)(abef.s13, cdgh.s13, abef.s57, cdgh.s57);
}
#endif

// 2^x for x in [-126, 1], relative error under 2.1e-7; arbitrary for x below -126. x is rounded to the nearest integer
// by addition of 1.5 * 2^23. The polynomial is minimax of degree 5 on [-1/2, 1/2] and is 1 at 0. An integer addition
// sets the exponent. The polynomial is evaluated in Estrin's order, because the speed of blending depends on the
// longest chain of dependent instructions.
//
// `zero` is always 0, but the compiler must not know it. An instruction of a GPU can contain one constant; NVIDIA's
// compiler loads a second constant into a register before each use. A constant that depends on the variable `zero`
// stays in a register. Callers for which speed does not matter pass the literal 0.
#define IN_REGISTER(constant) ((floatL)(as_float(as_int(constant) + zero)))
static inline floatL exp2_by(floatL x, int zero) {
  const floatL t = x + 12582912.0f;
  const floatL f = x + (12582912.0f - t);
  const floatL f2 = f * f;
  const floatL low = fmaL(f, (floatL)(6.931469025e-1f), IN_REGISTER(1.0f));
  const floatL middle = fmaL(f, IN_REGISTER(5.550900067e-2f), (floatL)(2.402225277e-1f));
  const floatL high = fmaL(f, IN_REGISTER(1.321160340e-3f), (floatL)(9.671293494e-3f));
  const floatL p = fmaL(f2, fmaL(f2, high, middle), low);
  return AS_FLOATL(AS_INTL(p) + (AS_INTL(t) << 23));
}
static inline floatL exp2L(floatL x) { return exp2_by(x, 0); }

// GATHER: element `field` of each of the rows row[0] to row[LANES - 1] of an array with `width` elements per row.
#define ROW_(array, width, field, lane) (array)[(size_t)(width) * row[lane] + (field)]
#define ROW4_(a, w, f, i) ROW_(a, w, f, i), ROW_(a, w, f, i + 1), ROW_(a, w, f, i + 2), ROW_(a, w, f, i + 3)
#if LANES == 1
#define GATHER(array, width, field) ROW_(array, width, field, 0)
#elif LANES == 4
#define GATHER(array, width, field) ((floatL)(ROW4_(array, width, field, 0)))
#elif LANES == 8
#define GATHER(array, width, field) ((floatL)(ROW4_(array, width, field, 0), ROW4_(array, width, field, 4)))
#else
#define GATHER(array, width, field)                                                                                    \
  ((floatL)(ROW4_(array, width, field, 0), ROW4_(array, width, field, 4), ROW4_(array, width, field, 8),               \
            ROW4_(array, width, field, 12)))
#endif

// Unrolls a short loop if LANES is 1: a GPU would keep an array with variable indices in memory instead of registers.
#if LANES == 1
#define UNROLL _Pragma("unroll")
#else
#define UNROLL
#endif
#define FOR_AXES(k) UNROLL for (int k = 0; k < 3; ++k)

// Defines the rows of a work-item that owns LANES of n rows: first_row, row[LANES] and lanes_used. Past the end, `row`
// repeats the last row. An item without rows executes LEAVE (list_counts.h), or else returns.
#ifndef LEAVE
#define LEAVE return
#endif
#define ROWS_OF_ITEM(n)                                                                                                \
  const uint first_row = get_global_id(0) * LANES;                                                                     \
  if (first_row >= (n)) LEAVE;                                                                                         \
  uint row[LANES];                                                                                                     \
  for (uint lane = 0; lane < LANES; ++lane) row[lane] = first_row + lane < (n) ? first_row + lane : (n) - 1;           \
  const uint lanes_used = (n) - first_row < LANES ? (n) - first_row : LANES;

// A vector whose lanes can be accessed one by one.
typedef union {
  floatL all;
  float lane[LANES];
} Lanes;
typedef union {
  intL all;
  int lane[LANES];
} IntLanes;

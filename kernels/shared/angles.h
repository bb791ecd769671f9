// Angles by arctangents, as scalars, with the same bits on every driver. Include math.h before this file.
#define HALF_TURN 3.14159265f
#define QUARTER_TURN 1.57079633f

// Coefficients for atan(x) with x in [0, 1], relative error 6e-8: atan(x) is x + x^3 times this minimax polynomial in
// x^2, highest coefficient first.
#define ATAN0 2.849871991e-03f
#define ATAN1 -1.606855914e-02f
#define ATAN2 4.269140586e-02f
#define ATAN3 -7.504285127e-02f
#define ATAN4 1.064092964e-01f
#define ATAN5 -1.420364380e-01f
#define ATAN6 1.999261975e-01f
#define ATAN7 -3.333307207e-01f

// atan(y / x) for y, x >= 0, not both 0.
static inline float quarter_atan(float y, float x) {
  const int steep = y > x;
  const float ratio = steep ? x / y : y / x, t = ratio * ratio;
  float p = fma1(t, ATAN0, ATAN1);
  p = fma1(t, p, ATAN2);
  p = fma1(t, p, ATAN3);
  p = fma1(t, p, ATAN4);
  p = fma1(t, p, ATAN5);
  p = fma1(t, p, ATAN6);
  p = fma1(t, p, ATAN7);
  p = fma1(t * p, ratio, ratio);
  return steep ? QUARTER_TURN - p : p;
}

// The angle of (x, y) from the x axis, for y >= 0: 0 to half a turn, in radians.
static inline float half_atan(float y, float x) {
  return x < 0.0f ? HALF_TURN - quarter_atan(y, -x) : quarter_atan(y, x);
}

// The angle of (x, y) from the x axis, with the sign of y, in radians; 0 for (0, 0).
static inline float signed_atan(float y, float x) {
  if (!(x != 0.0f || y != 0.0f)) return 0.0f;
  return y < 0.0f ? -half_atan(-y, x) : half_atan(y, x);
}

// Real spherical harmonics up to degree 3, with the signs and order of Kerbl et al. 2023, at the unit direction (x, y,
// z); and the colour of a Gaussian.

#define SH_CONSTANT 0.28209479177387814f
// Limit of a colour channel. No picture is so bright, and below it the squares in SSIM are finite.
#define COLOUR_LIMIT 1e9f

// The number of stored coefficients per channel that are used (RasterizerConfig.sh_degree_limit).
#ifdef SH_LIMIT
#define SH_USED(coefficients) ((coefficients) < SH_LIMIT ? (coefficients) : SH_LIMIT)
#else
#define SH_USED(coefficients) (coefficients)
#endif

static inline void sh_basis(int coefficients, floatL x, floatL y, floatL z, floatL *basis) {
  basis[0] = (floatL)(SH_CONSTANT);
  if (coefficients < 4) return;
  basis[1] = -0.4886025119029199f * y;
  basis[2] = 0.4886025119029199f * z;
  basis[3] = -0.4886025119029199f * x;
  if (coefficients < 9) return;
  const floatL xx = x * x, yy = y * y, zz = z * z;
  basis[4] = 1.0925484305920792f * x * y;
  basis[5] = -1.0925484305920792f * y * z;
  basis[6] = 0.31539156525252005f * (2.0f * zz - xx - yy);
  basis[7] = -1.0925484305920792f * x * z;
  basis[8] = 0.5462742152960396f * (xx - yy);
  if (coefficients < 16) return;
  basis[9] = -0.5900435899266435f * y * (3.0f * xx - yy);
  basis[10] = 2.890611442640554f * x * y * z;
  basis[11] = -0.4570457994644658f * y * (4.0f * zz - xx - yy);
  basis[12] = 0.3731763325901154f * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
  basis[13] = -0.4570457994644658f * x * (4.0f * zz - xx - yy);
  basis[14] = 1.445305721320277f * z * (xx - yy);
  basis[15] = -0.5900435899266435f * x * (xx - 3.0f * yy);
}

// Computes d (3): the sum over k of weight[k] times the gradient of basis[k] with respect to (x, y, z).
static inline void sh_direction_gradient(int coefficients, floatL x, floatL y, floatL z, const floatL *weight,
                                         floatL *d) {
  d[0] = d[1] = d[2] = (floatL)(0.0f);
  if (coefficients < 4) return;
  d[0] = -0.4886025119029199f * weight[3];
  d[1] = -0.4886025119029199f * weight[1];
  d[2] = 0.4886025119029199f * weight[2];
  if (coefficients < 9) return;
  const float c4 = 1.0925484305920792f, c6 = 0.31539156525252005f, c8 = 0.5462742152960396f;
  d[0] += c4 * y * weight[4] - 2.0f * c6 * x * weight[6] - c4 * z * weight[7] + 2.0f * c8 * x * weight[8];
  d[1] += c4 * x * weight[4] - c4 * z * weight[5] - 2.0f * c6 * y * weight[6] - 2.0f * c8 * y * weight[8];
  d[2] += -c4 * y * weight[5] + 4.0f * c6 * z * weight[6] - c4 * x * weight[7];
  if (coefficients < 16) return;
  const floatL xx = x * x, yy = y * y, zz = z * z;
  const float c9 = 0.5900435899266435f, c10 = 2.890611442640554f, c11 = 0.4570457994644658f;
  const float c12 = 0.3731763325901154f, c14 = 1.445305721320277f;
  d[0] += -6.0f * c9 * x * y * weight[9] + c10 * y * z * weight[10] + 2.0f * c11 * x * y * weight[11] -
          6.0f * c12 * x * z * weight[12] - c11 * (4.0f * zz - 3.0f * xx - yy) * weight[13] +
          2.0f * c14 * x * z * weight[14] - 3.0f * c9 * (xx - yy) * weight[15];
  d[1] += -3.0f * c9 * (xx - yy) * weight[9] + c10 * x * z * weight[10] -
          c11 * (4.0f * zz - xx - 3.0f * yy) * weight[11] - 6.0f * c12 * y * z * weight[12] +
          2.0f * c11 * x * y * weight[13] - 2.0f * c14 * y * z * weight[14] + 6.0f * c9 * x * y * weight[15];
  d[2] += c10 * x * y * weight[10] - 8.0f * c11 * y * z * weight[11] + 3.0f * c12 * (2.0f * zz - xx - yy) * weight[12] -
          8.0f * c11 * x * z * weight[13] + c14 * (xx - yy) * weight[14];
}

// Converts the bits of finite 16-bit floats, including denormal ones, to floats exactly; faster than vload_half.
static inline float4 float_from_half(int4 bits) {
  const int4 magnitude = bits & 0x7fff;
  const float4 normal = as_float4((magnitude << 13) + (112 << 23));
  // Denormal halves have steps of 2^-24, like floats from 0.5 to 1.
  const float4 tiny = as_float4(magnitude + 0x3f000000) - 0.5f;
  const float4 positive = magnitude < 0x400 ? tiny : normal;
  return as_float4(as_int4(positive) | (bits & 0x8000) << 16);
}

// Loads the three channels of a coefficient. last: true for the row's last coefficient, where a load of four floats
// would read past the row's end. shT: storage type of the bands above 0 (RasterizerConfig.sh_storage).
#ifdef SH_HALF
typedef ushort shT;
static inline float4 sh_channels(__global const shT *f, int last) {
  return float_from_half((int4)(f[0], f[1], f[2], 0)); // converting a ushort4 takes longer in PoCL 3.0
}
#else
typedef float shT;
typedef float4 sh4U __attribute__((aligned(4)));
static inline float4 sh_channels(__global const shT *f, int last) {
  return last ? (float4)(f[0], f[1], f[2], 0.0f) : *(__global const sh4U *)f;
}
#endif

static inline float4 sh_fma(float a, float4 b, float4 c) {
#ifdef FMA_BY_CONTRACTION
#pragma OPENCL FP_CONTRACT ON
  return a * b + c;
#else
  return fma((float4)(a), b, c);
#endif
}

// The number of coefficients per channel that Gaussian i uses; with SH_DEGREES each Gaussian has its own degree.
#ifdef SH_DEGREES
#define SH_OF_GAUSSIAN(i, coefficients) min(SH_USED(coefficients), (sh_degrees[i] + 1) * (sh_degrees[i] + 1))
#else
#define SH_OF_GAUSSIAN(i, coefficients) SH_USED(coefficients)
#endif

// A Gaussian's colour before it is clamped at 0, equation (12) of docs/gradients.md, from one lane of the basis. dc
// (3), rest (coefficients - 1, 3): the Gaussian's SH coefficients, of which the first `used` are evaluated, dc
// included.
static inline float4 sh_colour(const Lanes *basis, uint lane, int used, int coefficients, __global const float *dc,
                               __global const shT *rest) {
  float4 colour = sh_fma(SH_CONSTANT, (float4)(dc[0], dc[1], dc[2], 0.0f), (float4)(0.5f));
  for (int k = 1; k < used; ++k, rest += 3)
    colour = sh_fma(basis[k].lane[lane], sh_channels(rest, k + 1 == coefficients), colour);
  return colour;
}

// True if all channels are below COLOUR_LIMIT, and none is NaN. A single pixel with a channel above the limit would
// dominate the loss. `store_colour` clamps negative channels to 0.
static inline int colour_is_drawn(float4 colour) {
  return colour.x < COLOUR_LIMIT && colour.y < COLOUR_LIMIT && colour.z < COLOUR_LIMIT;
}

// Stores red, green and blue, clamped at 0 as in equation (12) of docs/gradients.md.
static inline void store_colour(float4 colour, __global float *rgb) {
  rgb[0] = colour.x > 0.0f ? colour.x : 0.0f;
  rgb[1] = colour.y > 0.0f ? colour.y : 0.0f;
  rgb[2] = colour.z > 0.0f ? colour.z : 0.0f;
}

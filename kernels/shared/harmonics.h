// Arguments that harmonics.cl and harmonics_grad.cl share: the directions in which colours are evaluated, and the mask
// of the rows to evaluate. With DEGREE_4 this file adds the SH band of degree 4, which models do not have; sh.h has the
// lower bands.
#ifdef DEGREE_4
#define MOST_COEFFICIENTS 25
#else
#define MOST_COEFFICIENTS 16
#endif
#ifdef CAMERA
#define DIRECTIONS __constant float *centre, __global const float *means
#define DIRECTIONS_GIVEN centre, means
#define COLOUR_OFFSET 0.5f
#else
#define DIRECTIONS __global const float *directions
#define DIRECTIONS_GIVEN directions
#define COLOUR_OFFSET 0.0f
#endif
#ifdef MASKED
#define MASK const uint mask_width, __global const int *mask,
#define HIDDEN(i) (!(mask[mask_width * (i)] > 0))
#else
#define MASK
#define HIDDEN(i) 0
#endif

// A normalised direction. v: the unit direction; scale: 1 / the length of the given direction. Both are 0 for a
// direction of length 0.
typedef struct {
  floatL v[3], scale;
} Direction;

static inline void direction_of(const uint *row, DIRECTIONS, Direction *d) {
#ifdef CAMERA
  d->v[0] = (GATHER(means, 3, 0) - centre[0]) - centre[3];
  d->v[1] = (GATHER(means, 3, 1) - centre[1]) - centre[4];
  d->v[2] = (GATHER(means, 3, 2) - centre[2]) - centre[5];
#else
  d->v[0] = GATHER(directions, 3, 0);
  d->v[1] = GATHER(directions, 3, 1);
  d->v[2] = GATHER(directions, 3, 2);
#endif
  const floatL length = sqrt(fmaL(d->v[0], d->v[0], fmaL(d->v[1], d->v[1], d->v[2] * d->v[2])));
  d->scale = length > 0.0f ? 1.0f / length : (floatL)(0.0f);
  FOR_AXES(k) d->v[k] = length > 0.0f ? d->v[k] / length : (floatL)(0.0f);
}

#ifdef DEGREE_4
static inline void band_4(floatL x, floatL y, floatL z, floatL *basis) {
  const floatL xx = x * x, yy = y * y, zz = z * z, disc = xx + yy;
  basis[16] = 2.5033429417967046f * x * y * (xx - yy);
  basis[17] = -1.7701307697799304f * y * z * (3.0f * xx - yy);
  basis[18] = 0.9461746957575601f * x * y * (6.0f * zz - disc);
  basis[19] = -0.6690465435572892f * y * z * (4.0f * zz - 3.0f * disc);
  basis[20] = 0.10578554691520431f * (8.0f * zz * zz - 24.0f * zz * disc + 3.0f * disc * disc);
  basis[21] = -0.6690465435572892f * x * z * (4.0f * zz - 3.0f * disc);
  basis[22] = 0.47308734787878004f * (xx - yy) * (6.0f * zz - disc);
  basis[23] = -1.7701307697799304f * x * z * (xx - 3.0f * yy);
  basis[24] = 0.6258357354491761f * (xx * (xx - 3.0f * yy) - yy * (3.0f * xx - yy));
}

// Adds the part of the band of degree 4 to d (3): the sum of weight[k] times the gradient of basis[k] with respect to
// (x, y, z), for k from 16 to 24.
static inline void add_band_4_gradient(floatL x, floatL y, floatL z, const floatL *weight, floatL *d) {
  const float c0 = 2.5033429417967046f, c1 = 1.7701307697799304f, c2 = 0.9461746957575601f, c3 = 0.6690465435572892f;
  const float c4 = 0.10578554691520431f, c6 = 0.47308734787878004f, c8 = 0.6258357354491761f;
  const floatL xx = x * x, yy = y * y, zz = z * z, disc = xx + yy, xyz = x * y * z;
  d[0] += c0 * y * (3.0f * xx - yy) * weight[16] - 6.0f * c1 * xyz * weight[17] +
          c2 * y * (6.0f * zz - 3.0f * xx - yy) * weight[18] + 6.0f * c3 * xyz * weight[19] +
          c4 * x * (12.0f * disc - 48.0f * zz) * weight[20] -
          c3 * z * (4.0f * zz - 9.0f * xx - 3.0f * yy) * weight[21] + 4.0f * c6 * x * (3.0f * zz - xx) * weight[22] -
          3.0f * c1 * z * (xx - yy) * weight[23] + 4.0f * c8 * x * (xx - 3.0f * yy) * weight[24];
  d[1] += c0 * x * (xx - 3.0f * yy) * weight[16] - 3.0f * c1 * z * (xx - yy) * weight[17] +
          c2 * x * (6.0f * zz - xx - 3.0f * yy) * weight[18] -
          c3 * z * (4.0f * zz - 3.0f * xx - 9.0f * yy) * weight[19] +
          c4 * y * (12.0f * disc - 48.0f * zz) * weight[20] + 6.0f * c3 * xyz * weight[21] -
          4.0f * c6 * y * (3.0f * zz - yy) * weight[22] + 6.0f * c1 * xyz * weight[23] +
          4.0f * c8 * y * (yy - 3.0f * xx) * weight[24];
  d[2] += -c1 * y * (3.0f * xx - yy) * weight[17] + 12.0f * c2 * xyz * weight[18] -
          c3 * y * (12.0f * zz - 3.0f * disc) * weight[19] + c4 * z * (32.0f * zz - 48.0f * disc) * weight[20] -
          c3 * x * (12.0f * zz - 3.0f * disc) * weight[21] + 12.0f * c6 * z * (xx - yy) * weight[22] -
          c1 * x * (xx - 3.0f * yy) * weight[23];
}
#endif

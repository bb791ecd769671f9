// The direction in which a colour of spherical harmonics is looked at, and which ones are looked at at all: arguments
// that harmonics.cl and its gradient share.
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

// v: of length 1, or 0; scale: one over the length that was given, or 0.
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

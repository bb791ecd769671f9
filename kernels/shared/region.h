// The region in which a training changes Gaussians: `TrainedRegion` (clsplat/optimisation/trained_region.py). Kernels
// that are built without REGION change all Gaussians.

#ifdef REGION
// The numbers of the region as parameters and as arguments, each after a comma: for each of two axes its direction, and
// the lower and upper edge along it; then a centre, and the squares of the least and the largest distance from it. All
// are in the coordinates of the means.
#define REGION_PARAMETERS                                                                                              \
  , const float first_x, const float first_y, const float first_z, const float first_low, const float first_high,      \
      const float second_x, const float second_y, const float second_z, const float second_low,                        \
      const float second_high, const float centre_x, const float centre_y, const float centre_z, const float nearest2, \
      const float farthest2
#define REGION_NUMBERS                                                                                                 \
  , first_x, first_y, first_z, first_low, first_high, second_x, second_y, second_z, second_low, second_high, centre_x, \
      centre_y, centre_z, nearest2, farthest2

// The coordinate of a mean (3) along an axis. It has the bits of `TrainedRegion.coordinates`, so nothing is fused.
static inline float region_coordinate(PARAMETER *mean, const float x, const float y, const float z) {
  return (mean[0] * x + mean[1] * y) + mean[2] * z;
}

// The square of a mean's distance from the centre, at most FLT_MAX, with the bits of `TrainedRegion.squares`.
static inline float region_square(PARAMETER *mean, const float x, const float y, const float z) {
  const float across = mean[0] - x, along = mean[1] - y, above = mean[2] - z;
  const float square = (across * across + along * along) + above * above;
  return square < FLT_MAX ? square : FLT_MAX;
}

// 1 if the mean of a Gaussian is in the region, otherwise 0.
static inline int in_region(PARAMETER *mean REGION_PARAMETERS) {
  const float first = region_coordinate(mean, first_x, first_y, first_z);
  const float second = region_coordinate(mean, second_x, second_y, second_z);
  const float square = region_square(mean, centre_x, centre_y, centre_z);
  return first_low <= first && first < first_high && second_low <= second && second < second_high &&
         nearest2 <= square && square < farthest2;
}
#else
#define REGION_PARAMETERS
#define REGION_NUMBERS
#endif

// Limits the scales of Gaussians from below, to the smallest size that the training pictures resolve at a Gaussian's
// mean.
//
// Owner: A work-item owns a Gaussian.
// Launch: One work-item for each Gaussian, in groups of 64; work-items past the end do nothing.
// Buffers: cameras (views, CAMERA_SIZE): each as in project.cl, all of one camera model.
//   means (n, 3).
//   -> least (n): natural log of the smallest standard deviation that the pictures resolve, in world units. With
//     `more`, a smaller value that is already stored stays. With REGION there is no limit outside the region.
//   limit_scales: log_scales (n, 3) below `least` are raised to `least`.
// Equations: docs/gradients.md, (88).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/elementary.h"
#define CAMERA_SPACE __global const
#define NEEDS_PIXEL_WIDTH
#include "shared/camera.h"
#include "shared/region.h"

#define UNSEEN -1e30f          // log scale of a Gaussian that no camera sees: no limit
#define SAMPLING 0.4472135901f // smallest standard deviation in pixel widths, sqrt(0.2)

#define ALONG(row)                                                                                                     \
  fma1(camera[CAMERA_R##row##0], x,                                                                                    \
       fma1(camera[CAMERA_R##row##1], y, fma1(camera[CAMERA_R##row##2], z, camera[CAMERA_T##row])))

// The width of a pixel at the mean (x, y, z), in world units; 1e30 if the camera does not see the mean. A mean counts
// as seen up to 0.15 of the picture's size beyond its edges, where the Jacobian is clamped.
static inline float width_at(float x, float y, float z, __global const float *camera) {
  return pixel_width(ALONG(0), ALONG(1), ALONG(2), camera);
}

__kernel void sampling_limits(const uint n, const uint views, const uint more, __global const float *cameras,
                              __global const float *means, __global float *least REGION_PARAMETERS) {
  const uint i = get_global_id(0);
  if (i >= n) return;
#ifdef REGION
  if (!in_region(means + 3 * (size_t)i REGION_NUMBERS)) {
    least[i] = UNSEEN;
    return;
  }
#endif
  const float x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
  float nearest = 1e30f;
  for (uint view = 0; view < views; ++view) {
    const float width = width_at(x, y, z, cameras + (size_t)CAMERA_SIZE * view);
    nearest = width < nearest ? width : nearest;
  }
  const float own = nearest < 1e30f ? LN2 * log2L(SAMPLING * nearest) : UNSEEN;
  const float other = more ? least[i] : UNSEEN;
  least[i] = own == UNSEEN ? other : (other == UNSEEN || own < other ? own : other);
}

__kernel void limit_scales(const uint n, __global const float *least, __global float *log_scales) {
  const uint i = get_global_id(0);
  if (i >= n) return;
  for (int k = 0; k < 3; ++k) {
    const float scale = log_scales[3 * i + k];
    if (scale < least[i]) log_scales[3 * i + k] = least[i];
  }
}

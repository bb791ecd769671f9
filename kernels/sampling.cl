// The least size at which pictures show each Gaussian, and scales that are no less.
//
// Owner: A work-item owns a Gaussian.
// Launch: One work-item for each, in groups of 64; those beyond the last do nothing.
// Buffers: cameras (views, CAMERA_SIZE) as project.cl has one; means (n, 3) -> least (n): natural log of the least
//   standard deviation in world units. log_scales (n, 3): those less than that are made that.
// Equations: docs/gradients.md, (88).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/elementary.h"

#define UNSEEN -1e30f          // the log of no size: as small as one likes
#define SAMPLING 0.4472135901f // widths of a pixel, the root of 0.2

// The distance from camera to mean that a pixel's width goes with, where a camera sees it: x/z and y/z within the
// bounds of the Jacobian's, which lie 0.15 of the picture beyond its edges.
__kernel void sampling_limits(const uint n, const uint views, __global const float *cameras,
                              __global const float *means, __global float *least) {
  const uint i = get_global_id(0);
  if (i >= n) return;
  const float x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
  float nearest = 1e30f;
  for (uint view = 0; view < views; ++view) {
    __global const float *camera = cameras + (size_t)CAMERA_SIZE * view;
#define ALONG(row)                                                                                                     \
  fma1(camera[CAMERA_R##row##0], x,                                                                                    \
       fma1(camera[CAMERA_R##row##1], y, fma1(camera[CAMERA_R##row##2], z, camera[CAMERA_T##row])))
    const float in_x = ALONG(0), in_y = ALONG(1), in_z = ALONG(2);
    const float size = in_z / fmax(camera[CAMERA_FX], camera[CAMERA_FY]);
    const int seen = in_z > camera[CAMERA_NEAR] && in_x > camera[CAMERA_XMIN] * in_z &&
                     in_x < camera[CAMERA_XMAX] * in_z && in_y > camera[CAMERA_YMIN] * in_z &&
                     in_y < camera[CAMERA_YMAX] * in_z;
    nearest = seen && size < nearest ? size : nearest;
  }
  least[i] = nearest < 1e30f ? LN2 * log2L(SAMPLING * nearest) : UNSEEN;
}

__kernel void limit_scales(const uint n, __global const float *least, __global float *log_scales) {
  const uint i = get_global_id(0);
  if (i >= n) return;
  for (int k = 0; k < 3; ++k) {
    const float scale = log_scales[3 * i + k];
    if (scale < least[i]) log_scales[3 * i + k] = least[i];
  }
}

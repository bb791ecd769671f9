// The least size at which pictures show each Gaussian, and scales that are no less.
//
// Owner: A work-item owns a Gaussian.
// Launch: One work-item for each, in groups of 64; those beyond the last do nothing.
// Buffers: cameras (views, CAMERA_SIZE) as project.cl has one, of one projection; means (n, 3) -> least (n): the
//   natural log of the least standard deviation in world units, or with `more` what is less of that and what is there.
//   log_scales (n, 3): those less than that are made that.
// Equations: docs/gradients.md, (88).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/elementary.h"
#ifdef RAYS
#define CAMERA_SPACE __global const
#include "shared/angles.h"
#include "shared/rays.h"
#endif

#define UNSEEN -1e30f          // the log of no size: as small as one likes
#define SAMPLING 0.4472135901f // widths of a pixel, the root of 0.2

#define ALONG(row)                                                                                                     \
  fma1(camera[CAMERA_R##row##0], x,                                                                                    \
       fma1(camera[CAMERA_R##row##1], y, fma1(camera[CAMERA_R##row##2], z, camera[CAMERA_T##row])))

// The width of a pixel at the mean (x, y, z), in world units, where a camera sees it: within 0.15 of the picture beyond
// its edges, which the bounds of the Jacobian's are; 1e30 where not.
static inline float pixel_width(float x, float y, float z, __global const float *camera) {
  const float in_x = ALONG(0), in_y = ALONG(1), in_z = ALONG(2), focal = fmax(camera[CAMERA_FX], camera[CAMERA_FY]);
#if !defined(RAYS) || RAYS == 3
  const int seen = in_z > camera[CAMERA_NEAR] && in_x > camera[CAMERA_XMIN] * in_z &&
                   in_x < camera[CAMERA_XMAX] * in_z && in_y > camera[CAMERA_YMIN] * in_z &&
                   in_y < camera[CAMERA_YMAX] * in_z;
  const float width = in_z / focal;
#else
  const float distance = sqrt(fma1(in_x, in_x, fma1(in_y, in_y, in_z * in_z)));
  int seen = distance > camera[CAMERA_NEAR];
  float width = distance / focal;
#if RAYS == 2 // the narrower of a pixel's sides, away from the axis and around it
  const float across = sqrt(fma1(in_x, in_x, in_y * in_y)), theta = half_atan(across, in_z);
  const float radius = radius_of(theta, camera);
  const float place_x = across > 0.0f ? radius * (in_x / across) : 0.0f;
  const float place_y = across > 0.0f ? radius * (in_y / across) : 0.0f;
  seen = seen && theta < FARTHEST_ANGLE(camera) && place_x > camera[CAMERA_XMIN] && place_x < camera[CAMERA_XMAX] &&
         place_y > camera[CAMERA_YMIN] && place_y < camera[CAMERA_YMAX];
  const float around = theta > 1e-6f ? across / (distance * radius) : 1.0f;
#ifdef KANNALA_BRANDT
  width *= fmin(1.0f / slope_of(theta, camera), around);
#else
  width *= fmin(1.0f, around);
#endif
#endif
#endif
  return seen ? width : 1e30f;
}

__kernel void sampling_limits(const uint n, const uint views, const uint more, __global const float *cameras,
                              __global const float *means, __global float *least) {
  const uint i = get_global_id(0);
  if (i >= n) return;
  const float x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
  float nearest = 1e30f;
  for (uint view = 0; view < views; ++view) {
    const float width = pixel_width(x, y, z, cameras + (size_t)CAMERA_SIZE * view);
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

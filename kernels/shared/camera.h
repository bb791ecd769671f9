// Includes the camera model of this build, a header of shared/camera/. All camera models have the same functions and
// macros, which docs/cameras.md (Adding a camera model) lists. Include math.h and lanes.h before this file.
//
// Before the first include, a kernel defines the macros of the parts that it needs:
//   NEEDS_PROJECTION   a Gaussian's position on the image plane; gaussian.h and ewa.h define this macro
//   NEEDS_GRADIENT     the gradient with respect to the mean, through this position
//   NEEDS_TANGENTS     with RAYS, a pixel on the plane that touches the sphere of directions; one lane
//   NEEDS_BOXES        with RAYS, the box of pixels around a direction; one lane
//   NEEDS_MOTION       the motion of a mean, in pixels; one lane
//   NEEDS_PIXEL_WIDTH  the width of a pixel in the world; one lane
// With RAYS, ray_of, the direction of a pixel, is always defined.
#include "shared/elementary.h"
#include "shared/angles.h"

#ifndef CAMERA_SPACE // address space of the camera's array
#define CAMERA_SPACE __constant
#endif

#ifdef NEEDS_TANGENTS
typedef struct {
  float e1[3], e2[3]; // unit vectors to the right and down on the tangent plane
  float k[4];         // d(point on the tangent plane) / d(pixel), the footprint of a pixel, row by row
} Tangent;
#endif
#ifdef NEEDS_BOXES
typedef struct {
  float low_x, high_x, low_y, high_y; // in pixels, not clamped
  int whole_rows;                     // 1 if the box goes all the way round the panorama
} Box;
#endif
#ifdef RAYS
#include "shared/camera/directions.h"
#endif

#if defined(ORTHOGRAPHIC)
#include "shared/camera/orthographic.h"
#elif defined(EQUIRECTANGULAR)
#include "shared/camera/equirectangular.h"
#elif defined(FISHEYE_RAYS) // with BENT_FISHEYE the radius is a polynomial of the angle
#include "shared/camera/fisheye.h"
#elif defined(PERSPECTIVE_RAYS)
#include "shared/camera/perspective_rays.h"
#else
#include "shared/camera/perspective.h"
#endif

#ifdef ON_PLANE
#include "shared/camera/plane.h"
#endif

// SEEN_ALONG: a component of the view direction at a Gaussian, in world axes. BY_DIRECTION: a component of the gradient
// with respect to the mean, through this direction. offset: the component of the vector from the camera's centre to the
// mean; length: the length of this vector; axis: the component of the camera's viewing axis.
#ifdef PARALLEL_RAYS // all Gaussians are seen along the same direction
#define SEEN_ALONG(offset, length, axis) (axis)
#define BY_DIRECTION(gradient, length) (0.0f)
#else
#define SEEN_ALONG(offset, length, axis) ((offset) / (length))
#define BY_DIRECTION(gradient, length) ((gradient) / (length))
#endif

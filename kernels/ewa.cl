// EWA projection with gsplat's conventions: the mean, depth, conic and radii of each Gaussian on a camera's image.
//
// Owner: A work-item owns LANES Gaussians.
// Launch: One work-item for each LANES Gaussians, in groups of 64; work-items past the end do nothing.
// Buffers: means (n, 3): in world units.
//   quaternions (n, 4): w x y z, not normalised; scales (n, 3): in world units. With COVARIANCES, their place is taken
//     by upper triangles (n, 6): xx, xy, xz, yy, yz, zz.
//   camera (EWA_SIZE); with OPACITIES opacities (n): 0 to 1.
//   -> radii (n, 2): in whole pixels, 0 where culled; means2d (n, 2): in pixels; depths (n): in world units; conics (n,
//     3): a, b, c in 1 / px^2; with COMPENSATED compensations (n): 0 to 1. Rows of culled Gaussians are zero.
// Equations: docs/gradients.md, (150) to (158), with (56) and (57); Zwicker et al. 2001 and 2004 for the model, Ye et
//   al. 2025 (gsplat) for its conventions.
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/elementary.h"
#include "shared/ewa.h"

// Largest half side of a Gaussian's box of pixels, in standard deviations.
#define EXTEND 3.33f
#define LARGEST_RADIUS 1e9f

// focal * ratio + centre, rounded once. rest, focal_low, centre_low: the low parts of ratio, focal and centre.
static inline floatL place2(floatL ratio, floatL rest, float focal, float focal_low, float centre, float centre_low) {
  const Double c = {(floatL)(centre), fmaL((floatL)(focal), rest, (floatL)(centre_low))};
  return multiply_add2(focal, focal_low, ratio, c).high;
}

static inline floatL radius_of_box(floatL extend, floatL variance) {
  const floatL radius = -floorL(-(extend * sqrt(variance)));
  return radius < LARGEST_RADIUS ? radius : (floatL)(LARGEST_RADIUS);
}

__kernel void ewa(const uint n, __constant float *camera, __global const float *means, EWA_SHAPES,
#ifdef OPACITIES
                  __global const float *opacities,
#endif
                  __global int *radii, __global float *means2d, __global float *depths, __global float *conics
#ifdef COMPENSATED
                  ,
                  __global float *compensations
#endif
) {
  ROWS_OF_ITEM(n)
  Ellipse2 p;
  if (!project_ellipses(row, means, EWA_SHAPES_GIVEN, camera, &p)) {
    for (size_t i = first_row; i < first_row + lanes_used; ++i) {
      radii[2 * i] = radii[2 * i + 1] = 0;
      means2d[2 * i] = means2d[2 * i + 1] = 0.0f;
      depths[i] = 0.0f;
      conics[3 * i] = conics[3 * i + 1] = conics[3 * i + 2] = 0.0f;
#ifdef COMPENSATED
      compensations[i] = 0.0f;
#endif
    }
    return;
  }
#ifdef FISHEYE
  const floatL ratio_x = p.x * p.away, ratio_y = p.y * p.away, rest_x = (floatL)(0.0f), rest_y = rest_x;
#else
  const floatL ratio_x = RATIO(p.x, p.z), rest_x = ratio_rest(ratio_x, p.x, p.lx, p.z, p.lz);
  const floatL ratio_y = RATIO(p.y, p.z), rest_y = ratio_rest(ratio_y, p.y, p.ly, p.z, p.lz);
#endif
  Lanes field[7];
  IntLanes valid, size[2];
  field[0].all = place2(ratio_x, rest_x, camera[EWA_FX], camera[EWA_FX_LOW], camera[EWA_CX], camera[EWA_CX_LOW]);
  field[1].all = place2(ratio_y, rest_y, camera[EWA_FY], camera[EWA_FY_LOW], camera[EWA_CY], camera[EWA_CY_LOW]);
  field[2].all = p.z;
  field[3].all = p.syy / p.det;
  field[4].all = -p.sxy / p.det;
  field[5].all = p.sxx / p.det;
  field[6].all = compensation2(&p);
  valid.all = p.valid;

  floatL extend = (floatL)(EXTEND);
#ifdef OPACITIES
#ifdef COMPENSATED
  const floatL opacity = GATHER(opacities, 1, 0) * field[6].all;
#else
  const floatL opacity = GATHER(opacities, 1, 0);
#endif
  valid.all &= opacity >= ALPHA_MIN;
  const floatL budget = 2.0f * LN2 * (log2L(opacity) - LOG2_ALPHA_MIN);
  const floatL reach = sqrt(budget > 0.0f ? budget : (floatL)(0.0f));
  extend = reach < EXTEND ? reach : (floatL)(EXTEND);
#endif
  const floatL wide = radius_of_box(extend, p.sxx), high = radius_of_box(extend, p.syy);
  valid.all &= (field[0].all + wide > 0.0f) & (field[0].all - wide < camera[EWA_WIDTH]) & (field[1].all + high > 0.0f) &
               (field[1].all - high < camera[EWA_HEIGHT]) &
               ((wide > camera[EWA_RADIUS_CLIP]) | (high > camera[EWA_RADIUS_CLIP])) & (wide > 0.0f) & (high > 0.0f);
  size[0].all = TO_INTL(wide);
  size[1].all = TO_INTL(high);

  for (uint lane = 0; lane < lanes_used; ++lane) {
    const size_t i = first_row + lane;
    const int seen = valid.lane[lane] != 0;
    for (int k = 0; k < 2; ++k) radii[2 * i + k] = seen ? size[k].lane[lane] : 0;
    for (int k = 0; k < 2; ++k) means2d[2 * i + k] = seen ? field[k].lane[lane] : 0.0f;
    depths[i] = seen ? field[2].lane[lane] : 0.0f;
    for (int k = 0; k < 3; ++k) conics[3 * i + k] = seen ? field[3 + k].lane[lane] : 0.0f;
#ifdef COMPENSATED
    compensations[i] = seen ? field[6].lane[lane] : 0.0f;
#endif
  }
}

// The alpha of a Gaussian along a pixel's ray, and the ray's whitened coordinates on the plane tangent to the unit
// sphere at the mean's direction. Equation numbers refer to docs/cameras.md. Include lanes.h before this file.

// Returns log2 of the uncapped alpha along the ray (x, y, z), equation (14) of docs/cameras.md, and sets (u, v) to the
// whitened point at which the ray meets the tangent plane at the mean's direction.
static inline floatL offset_of_ray(floatL x, floatL y, floatL z, __global const float *splat, floatL *u, floatL *v) {
  const floatL along = fmaL(x, (floatL)(splat[RAY_FX]), fmaL(y, (floatL)(splat[RAY_FY]), z * splat[RAY_FZ]));
  // U and V are perpendicular to the mean's direction, so only the difference of the ray from this direction counts.
  // For a ray close to this direction, the difference is accurate.
  const floatL dx = x - splat[RAY_FX], dy = y - splat[RAY_FY], dz = z - splat[RAY_FZ];
  *u = fmaL(dx, (floatL)(splat[RAY_UX]), fmaL(dy, (floatL)(splat[RAY_UY]), dz * splat[RAY_UZ])) / along;
  *v = fmaL(dx, (floatL)(splat[RAY_VX]), fmaL(dy, (floatL)(splat[RAY_VY]), dz * splat[RAY_VZ])) / along;
  const floatL power = fmaL(-*u, *u, fmaL(-*v, *v, (floatL)(splat[RAY_LOG2O])));
  return along > 0.0f ? power : (floatL)(-1e30f);
}

static inline floatL log2_alpha_of_ray(floatL x, floatL y, floatL z, __global const float *splat) {
  floatL u, v;
  return offset_of_ray(x, y, z, splat, &u, &v);
}

// Computes the whitening on the tangent plane (l11, l12, l22) from a ray splat's U and V.
static inline void whitening_of_ray(__global const float *splat, float *l11, float *l12, float *l22) {
  const float ux = splat[RAY_UX], uy = splat[RAY_UY], uz = splat[RAY_UZ];
  const float vx = splat[RAY_VX], vy = splat[RAY_VY], vz = splat[RAY_VZ];
  *l22 = sqrt(fma1(vx, vx, fma1(vy, vy, vz * vz)));
  *l12 = fma1(ux, vx, fma1(uy, vy, uz * vz)) / *l22;
  // (wx, wy, wz) is along e1, which is perpendicular to V and to the mean's direction.
  const float fx = splat[RAY_FX], fy = splat[RAY_FY], fz = splat[RAY_FZ];
  const float wx = fma1(vy, fz, -(vz * fy)), wy = fma1(vz, fx, -(vx * fz)), wz = fma1(vx, fy, -(vy * fx));
  *l11 = fma1(ux, wx, fma1(uy, wy, uz * wz)) / *l22;
}

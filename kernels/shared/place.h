// Positions and rotated axes of LANES Gaussians in a camera's axes, in two-float arithmetic. project.cl, ewa.cl and
// their gradients share this code. Equation numbers refer to docs/gradients.md.

// Limit of distances in world units, and of axes in pixels: up to it no sum of products overflows.
#define FARTHEST 1e18f
// Ratios above which `refine` is called: of the longest axis to the ellipse's short axis (REFINE_FROM), and of an axis
// to its projected length (FORESHORTENED). At smaller ratios float32 is accurate to 3e-5.
#define REFINE_FROM 64.0f
#define FORESHORTENED 256.0f

// The rotation matrix of a unit quaternion, row by row.
static inline void rotation_of(const floatL *q, floatL *r) {
  const floatL w = q[0], x = q[1], y = q[2], z = q[3];
  r[0] = 1.0f - 2.0f * (y * y + z * z);
  r[1] = 2.0f * (x * y - w * z);
  r[2] = 2.0f * (x * z + w * y);
  r[3] = 2.0f * (x * y + w * z);
  r[4] = 1.0f - 2.0f * (x * x + z * z);
  r[5] = 2.0f * (y * z - w * x);
  r[6] = 2.0f * (x * z - w * y);
  r[7] = 2.0f * (y * z + w * x);
  r[8] = 1.0f - 2.0f * (x * x + y * y);
}

// Sets r (9) to the rotation matrix in two floats, times the square of the returned length: equation (57) of
// docs/gradients.md. length: the length of the raw quaternion.
static inline floatL rotation2_of(const uint *row, PARAMETER *quaternions, floatL length, Double *r) {
  // The quaternion is scaled by a power of two, which is exact, so that the low parts of products are not denormal.
  const floatL size = AS_FLOATL(AS_INTL(length) & 0x7f800000);
  const floatL w = GATHER(quaternions, 4, 0) / size, x = GATHER(quaternions, 4, 1) / size;
  const floatL y = GATHER(quaternions, 4, 2) / size, z = GATHER(quaternions, 4, 3) / size;
  const Double xx = product2(x, x), yy = product2(y, y), zz = product2(z, z), ww = product2(w, w);
  const Double xy = product2(x, y), xz = product2(x, z), yz = product2(y, z);
  const Double wx = product2(w, x), wy = product2(w, y), wz = product2(w, z);
  const Double s = subtract2(ww, zz), d = subtract2(xx, yy);
  r[0] = add2(s, d);
  r[4] = subtract2(s, d);
  r[8] = subtract2(add2(ww, zz), add2(xx, yy));
  r[1] = twice2(subtract2(xy, wz));
  r[3] = twice2(add2(xy, wz));
  r[2] = twice2(add2(xz, wy));
  r[6] = twice2(subtract2(xz, wy));
  r[5] = twice2(subtract2(yz, wx));
  r[7] = twice2(add2(yz, wx));
  return length / size;
}

// A row of the camera's matrix times the mean (x, y, z), plus the row's translation t, in two floats. Arguments named
// _low are the low parts.
static inline Double camera_row(__constant float *r, __constant float *r_low, float t, float t_low, floatL x, floatL y,
                                floatL z) {
  Double sum = {(floatL)(t), (floatL)(t_low)};
  sum = multiply_add2(r[0], r_low[0], x, sum);
  sum = multiply_add2(r[1], r_low[1], y, sum);
  return multiply_add2(r[2], r_low[2], z, sum);
}

// A row of cam_from_world times the mean (x, y, z), in two floats. With one float the error would be 1e-4 pixels, which
// can change a pixel at the edge of an ellipse.
#define CAMERA_ROW(index)                                                                                              \
  camera_row(camera + CAMERA_R##index##0, camera + CAMERA_R##index##0_LOW, camera[CAMERA_T##index],                    \
             camera[CAMERA_T##index##_LOW], x, y, z)

// Returns the low part of x / z in two floats. ratio: x / z in one float, the high part.
static inline floatL slope_rest(floatL ratio, floatL x, floatL x_low, floatL z, floatL z_low) {
  return (fmaL(-ratio, z, x) + fmaL(-ratio, z_low, x_low)) / z;
}

// x clamped to [low, high]; NaN stays NaN.
static inline floatL clampL(floatL x, float low, float high) {
  const floatL above = x < low ? (floatL)(low) : x;
  return above > high ? (floatL)(high) : above;
}

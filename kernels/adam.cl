// Adam (Kingma and Ba 2015, algorithm 1; docs/gradients.md, equation 42) on one parameter group as a flat array, LANES
// elements a work-item. It leaves the gradient zero, so that the next step need only write the rows of visible
// Gaussians.
#include "shared/math.h"
#include "shared/lanes.h"

// parameters, gradients, first, second (n). rate: learning rate / (1 - beta1^t); root: 1 / sqrt(1 - beta2^t).
__kernel void adam(const ulong n, const float rate, const float root, const float beta1, const float beta2,
                   const float epsilon, __global float *parameters, __global float *gradients,
                   __global float *first, __global float *second) {
  const ulong i = get_global_id(0) * (ulong)LANES;
  if (i + LANES <= n) {
    const floatL g = LOADL(gradients + i);
    const floatL m = fmaL((floatL)(beta1), LOADL(first + i), (1.0f - beta1) * g);
    const floatL v = fmaL((floatL)(beta2), LOADL(second + i), (1.0f - beta2) * (g * g));
    STOREL(m, first + i);
    STOREL(v, second + i);
    STOREL(LOADL(parameters + i) - rate * m / fmaL(sqrt(v), (floatL)(root), (floatL)(epsilon)), parameters + i);
    STOREL((floatL)(0.0f), gradients + i);
    return;
  }
  for (ulong k = i; k < n; ++k) {
    const float g = gradients[k];
    const float m = fma1(beta1, first[k], (1.0f - beta1) * g);
    const float v = fma1(beta2, second[k], (1.0f - beta2) * (g * g));
    first[k] = m;
    second[k] = v;
    parameters[k] -= rate * m / fma1(sqrt(v), root, epsilon);
    gradients[k] = 0.0f;
  }
}

// A photograph into the blend's layout: (height, width, channels) interleaved to (3, height, width) planes padded with
// zeros to whole tiles, alpha composited over the background that the render gets.
#include "shared/math.h"

#ifdef BYTES
typedef uchar source_t;
#define SAMPLE(x) ((float)(x) / 255.0f)
#else
typedef float source_t;
#define SAMPLE(x) (x)
#endif

__kernel void target(const int width, const int height, const int channels, const int stride, const int plane,
                     __global const source_t *source, __global const float *background, __global float *planes) {
  const int x = get_global_id(0), y = get_global_id(1);
  const int inside = x < width && y < height;
  __global const source_t *pixel = source + (size_t)channels * ((size_t)width * y + x);
  const float alpha = inside && channels == 4 ? SAMPLE(pixel[3]) : 1.0f;
  for (int c = 0; c < 3; ++c) {
    float value = 0.0f;
    if (inside) value = fma1(alpha, SAMPLE(pixel[c]), (1.0f - alpha) * background[c]);
    planes[(size_t)plane * c + (size_t)stride * y + x] = value;
  }
}

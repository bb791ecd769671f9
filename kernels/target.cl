// A photograph into the blend's layout, alpha composited over the background that the render gets.
//
// Owner: A work-item owns a pixel of the padded planes.
// Launch: A grid of stride x rows, whole tiles.
// Buffers: source (height, width, channels), bytes or floats, interleaved; background (3) -> planes (3, rows, stride)
//   of colour in [0, 1] where the source is bytes, 0 in padding.
// Equations: alpha c + (1 - alpha) background.
#include "shared/math.h"

#ifdef BYTES
typedef uchar source_t;
#define SAMPLE(x) ((float)(x) * (1.0f / 255.0f)) // as OpenImageIO does, to the bit
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

// A photograph into the blend's layout, alpha composited over the background that the render gets.
//
// Owner: A work-item owns a pixel of the padded planes.
// Launch: A grid of stride x rows, whole tiles.
// Buffers: source (height, width, channels), bytes or floats, interleaved; background (3) -> planes (3, rows, stride)
//   of colour in [0, 1] where the source is bytes, 0 in padding; with ALPHA a fourth plane, of alpha. With MASKED the
//   source's fifth channel is 0 where a pixel does not count: its planes are 0, and so is the render's image
//   (3, rows, stride), and its stop (rows, stride) is -1, as in padding, so that the gradient of blending passes it.
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
                     __global const source_t *source, __global const float *background, __global float *planes
#ifdef MASKED
                     ,
                     __global float *image, __global int *stops
#endif
) {
  const int x = get_global_id(0), y = get_global_id(1);
  const int inside = x < width && y < height;
  __global const source_t *pixel = source + (size_t)channels * ((size_t)width * y + x);
#ifdef MASKED
  const int counts = inside && pixel[4] > 0;
  const size_t at = (size_t)stride * y + x;
  if (inside && !counts) {
    stops[at] = -1;
    for (int c = 0; c < 3; ++c) image[(size_t)plane * c + at] = 0.0f;
  }
#else
  const int counts = inside;
#endif
  const float alpha = inside && channels >= 4 ? SAMPLE(pixel[3]) : 1.0f;
  for (int c = 0; c < 3; ++c) {
    float value = 0.0f;
    if (counts) value = fma1(alpha, SAMPLE(pixel[c]), (1.0f - alpha) * background[c]);
    planes[(size_t)plane * c + (size_t)stride * y + x] = value;
  }
#ifdef ALPHA
  planes[(size_t)plane * 3 + (size_t)stride * y + x] = counts ? alpha : 0.0f;
#endif
}

// Copies a photograph to planes in the layout of blend.cl. A photograph with alpha is composited over the render's
// background.
//
// Owner: A work-item owns OWNED pixels of a row of the padded planes: if LANES > 1 a row of a tile, otherwise a pixel.
// Launch: A grid of stride / OWNED x rows work-items, which covers whole tiles.
// Buffers: source (height, width, channels): bytes or floats, interleaved. background (3).
//   -> planes (3, rows, stride): colour, in [0, 1] for bytes, 0 in padding. With ALPHA a fourth plane, alpha.
//   With MASKED the source's fifth channel is 0 in pixels that the loss leaves out. In these pixels the planes and the
//     render's image (3, rows, stride) become 0, and the render's stops (rows, stride) become -1, as in padding, so
//     that blend_grad skips them.
// Equations: alpha c + (1 - alpha) background.
#include "shared/math.h"
#include "shared/photograph.h"

#if LANES > 1
#define OWNED TILE
#else
#define OWNED 1
#endif

#if OWNED == 16 && defined(BYTES) && !defined(MASKED) && !defined(ALPHA)
#define OPAQUE_ROWS
typedef uchar16 uchar16U __attribute__((aligned(1)));
typedef float16 float16U __attribute__((aligned(4)));
// Copies the colours of a tile's row from a photograph without alpha, three bytes per pixel.
static inline void opaque_row(__global const uchar *source, const int plane, __global float *planes) {
  __global const uchar16U *from = (__global const uchar16U *)source;
  const uchar16 a = from[0], b = from[1], c = from[2];
  const uchar16 red = (uchar16)(a.s0369, a.scf, b.s258b, b.se, c.s147a, c.sd);
  const uchar16 green = (uchar16)(a.s147a, a.sd, b.s0369, b.scf, c.s258b, c.se);
  const uchar16 blue = (uchar16)(a.s258b, a.se, b.s147a, b.sd, c.s0369, c.scf);
  *(__global float16U *)planes = convert_float16(red) * (1.0f / 255.0f);
  *(__global float16U *)(planes + plane) = convert_float16(green) * (1.0f / 255.0f);
  *(__global float16U *)(planes + (size_t)2 * plane) = convert_float16(blue) * (1.0f / 255.0f);
}
#endif

__kernel void target(const int width, const int height, const int channels, const int stride, const int plane,
                     __global const source_t *source, __global const float *background, __global float *planes
#ifdef MASKED
                     ,
                     __global float *image, __global int *stops
#endif
) {
  const int x0 = get_global_id(0) * OWNED, y = get_global_id(1);
#ifdef OPAQUE_ROWS
  if (channels == 3 && x0 + OWNED <= width && y < height) {
    opaque_row(source + (size_t)3 * ((size_t)width * y + x0), plane, planes + (size_t)stride * y + x0);
    return;
  }
#endif
  for (int x = x0; x < x0 + OWNED; ++x) {
    const int inside = x < width && y < height;
    __global const source_t *pixel = source + (size_t)channels * ((size_t)width * y + x);
    const size_t at = (size_t)stride * y + x;
#ifdef MASKED
    const int counts = inside && pixel[4] > 0;
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
      planes[(size_t)plane * c + at] = value;
    }
#ifdef ALPHA
    planes[(size_t)plane * 3 + at] = counts ? alpha : 0.0f;
#endif
  }
}

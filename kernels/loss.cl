// The loss (1 - weight) L1 + weight (1 - SSIM) and its gradient. SSIM has the usual 11 x 11 Gaussian window, sigma 1.5,
// with zero padding outside the image. The window is separable: it is applied vertically, into local memory, then
// horizontally. A second pair of passes, the adjoint of the first pair, convolves SSIM's three partial derivatives.
//
// Owner: A group owns blocks of one channel. With ITEMS == 1 a group processes a block from the top, ROWS rows at a
//   time, and keeps the derivatives of LOSS_RING rows. Rows shared with other blocks are computed again. Otherwise a
//   block is ROWS x COLUMNS pixels in PARTS parts, and an item has one or several parts. A first launch (loss_ssim)
//   writes the derivatives of the whole image, and a second one (loss_grad) reads them.
// Launch: With ITEMS == 1 any number of groups, which share the blocks. Otherwise a grid of groups of at most PARTS
//   items: blocks across x blocks down x channels. Blocks are numbered in this order.
// Buffers: image, target (3, rows, stride): colour, padded to whole tiles with zeros. With PHOTOGRAPH the target is
//     (height, width, 3), bytes or floats.
//   partials: with ITEMS == 1 (groups, LOSS_RING rows, 3 derivatives, `field` floats); otherwise (3 channels, strips of
//     COLUMNS columns, height, 3 derivatives, COLUMNS), so that addresses within a column differ by constants.
//   -> gradient (3, rows, stride): 0 right of the image.
//   sums (3, ...), of SSIM, of |image - target| and of its square: one sum per row of a block with ITEMS == 1,
//     otherwise per block.
// Equations: docs/gradients.md, (17) to (21) in the forms (78) and (79); with several items (188) and (189).
#if ITEMS == 1 && LANES == 8 && defined(FMA_BY_CONTRACTION)
#undef LANES // two vectors at a time, because a window's sum is a chain of dependent additions
#define LANES 16
#endif
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/photograph.h"

// In bright, flat pictures the variance E[x^2] - E[x]^2 would lose its digits by cancellation. So a window sums
// differences from one of its own pixels (docs/gradients.md, section 12). Variances are then sums of small squares, and
// the gradient is a sum of differences.
#define TAPS 11
#define REACH 5
#define C1 1e-4f
#define C2 9e-4f
__constant float window[TAPS] = {1.02838008e-3f, 7.59875814e-3f, 3.60007721e-2f, 1.09360690e-1f,
                                 2.13005538e-1f, 2.66011725e-1f, 2.13005538e-1f, 1.09360690e-1f,
                                 3.60007721e-2f, 7.59875814e-3f, 1.02838008e-3f};

#define PIXEL_AT(block, x, y) ((uint)(block).stride * (uint)(y) + (uint)(x))

#if ITEMS == 1
// Number of columns by which windows reach beyond each side of a block, rounded up to whole vectors.
#define MARGIN ((REACH + LANES - 1) / LANES * LANES)
#define ROWS LOSS_ROWS
#define RING_ROW(y) ((y) & (LOSS_RING - 1))

// Size of `near` in local memory: five fields, each with ROWS rows of a block and its margins. A block has at most
// LOSS_COLUMNS columns.
#define NEAR_MARGIN (2 * MARGIN)
#define NEAR_WIDTH (LOSS_COLUMNS + 2 * NEAR_MARGIN)
#define NEAR_FIELD (ROWS * NEAR_WIDTH)
#if LANES == 1
#define LOAD_NEAR(p) (*(p))
#define STORE_NEAR(x, p) (*(p) = (x))
#else
#define LOAD_NEAR(p) (*(__local const floatU *)(p))
#define STORE_NEAR(x, p) (*(__local floatU *)(p) = (x))
#endif

// A block: columns x0 to x1 of a channel. partials: the block's derivatives from column x_partials on, with `pitch`
// floats between rows and `field` floats between fields.
typedef struct {
  __global const float *image, *target;
  __global float *partials;
  size_t field;
  uint pitch;
  int x_partials, x0, x1, width, height, stride;
} Block;
#define PARTIALS_AT(block, x, y) ((block).pitch * (uint)RING_ROW(y) + (uint)((x) - (block).x_partials))

// FOR_VECTORS loops over the vectors of `rows` rows of a block, with `margin` columns on each side, and defines x and
// row. VECTOR defines near_at, the vector's address in `near`. The inner loop is over rows, because vertical windows of
// neighbouring rows share pixels.
#define FOR_VECTORS(block, margin, rows)                                                                               \
  for (int x = (block).x0 - (margin); x < (block).x1 + (margin); x += LANES)                                           \
    for (int row = 0; row < (rows); ++row)
#define VECTOR(block) __local float *near_at = near + (row * NEAR_WIDTH + x - (block).x0 + NEAR_MARGIN);
#define OUTSIDE(block, x, y) ((x) < 0 || (x) >= (block).stride || (y) < 0 || (y) >= (block).height)

// The range [result.x, result.y) of a window's taps that are inside the image, for a window around row y.
static inline int2 taps_inside(const Block block, const int y) {
  return (int2)(max(0, REACH - y), min(TAPS, block.height + REACH - y));
}

// Computes the vertical sums of SSIM: `near` gets the means of image and target, their variances, and the covariance,
// over the vertical windows around row y and the ROWS - 1 rows below it; 0 outside the image.
static inline void moments(const Block block, const int margin, const int y, __local float *near) {
  FOR_VECTORS(block, margin, ROWS) {
    VECTOR(block)
    if (OUTSIDE(block, x, y + row)) {
      for (int field = 0; field < 5; ++field) STORE_NEAR((floatL)(0.0f), near_at + field * NEAR_FIELD);
      continue;
    }
    const int2 taps = taps_inside(block, y + row);
    float beyond = 0.0f; // sum of the weights of taps outside the image, where pixels are 0
    for (int tap = 0; tap < taps.x; ++tap) beyond += window[tap];
    for (int tap = taps.y; tap < TAPS; ++tap) beyond += window[tap];
    const uint here = PIXEL_AT(block, x, y + row);
    const floatL p0 = LOADL(block.image + here), q0 = LOADL(block.target + here);
    floatL a = -beyond * p0, b = -beyond * q0;
    floatL aa = -(a * p0), bb = -(b * q0), ab = -(a * q0);
    uint at = PIXEL_AT(block, x, y + row + taps.x - REACH);
    for (int tap = taps.x; tap < taps.y; ++tap, at += block.stride) {
      const floatL p = LOADL(block.image + at) - p0, q = LOADL(block.target + at) - q0;
      const floatL wp = window[tap] * p, wq = window[tap] * q;
      a += wp;
      b += wq;
      aa = fmaL(wp, p, aa);
      bb = fmaL(wq, q, bb);
      ab = fmaL(wp, q, ab);
    }
    STORE_NEAR(p0 + a, near_at);
    STORE_NEAR(q0 + b, near_at + NEAR_FIELD);
    STORE_NEAR(fmaL(-a, a, aa), near_at + 2 * NEAR_FIELD);
    STORE_NEAR(fmaL(-b, b, bb), near_at + 3 * NEAR_FIELD);
    STORE_NEAR(fmaL(-a, b, ab), near_at + 4 * NEAR_FIELD);
  }
}

// Computes SSIM and its derivatives by horizontal sums of `near`. `partials` gets the derivatives of SSIM with respect
// to the image's mean (relative to the centre pixel), to its variance (doubled), and to the covariance, all 0 right of
// the image. Returns the item's sum of SSIM over the block's own columns.
static inline float derivatives(const Block block, const int margin, const int y, __local float *near) {
  floatL total = (floatL)(0.0f);
  FOR_VECTORS(block, margin, 1) {
    VECTOR(block)
    if (OUTSIDE(block, x, y + row)) continue;
    const uint here = PIXEL_AT(block, x, y + row);
    const floatL p = LOADL(block.image + here), q = LOADL(block.target + here);
    // off1, off2: the windows' means of image and target, minus the centre pixels p and q.
    floatL off1 = (floatL)(0.0f), off2 = off1, var1 = off1, var2 = off1, covariance = off1;
    for (int tap = 0; tap < TAPS; ++tap) {
      __local const float *in = near_at + (tap - REACH);
      const floatL e1 = LOAD_NEAR(in) - p, e2 = LOAD_NEAR(in + NEAR_FIELD) - q;
      const floatL w1 = window[tap] * e1, w2 = window[tap] * e2, w = (floatL)(window[tap]);
      off1 += w1;
      off2 += w2;
      var1 = fmaL(w, LOAD_NEAR(in + 2 * NEAR_FIELD), fmaL(w1, e1, var1));
      var2 = fmaL(w, LOAD_NEAR(in + 3 * NEAR_FIELD), fmaL(w2, e2, var2));
      covariance = fmaL(w, LOAD_NEAR(in + 4 * NEAR_FIELD), fmaL(w1, e2, covariance));
    }
    var1 = fmaL(-off1, off1, var1);
    var2 = fmaL(-off2, off2, var2);
    covariance = fmaL(-off1, off2, covariance);
    const floatL mu1 = p + off1, mu2 = q + off2, apart = mu2 - mu1;
    const floatL a = 2.0f * (mu1 * mu2) + C1, b = 2.0f * covariance + C2;
    const floatL c = mu1 * mu1 + mu2 * mu2 + C1, d = var1 + var2 + C2;
    const floatL inverse = 1.0f / (c * d);
    const floatL ssim = a * b * inverse;
    const floatL by_covariance = 2.0f * a * inverse;
    const floatL by_variance = -ssim / d;
    const floatL by_mu = 2.0f * b * inverse * fmaL(mu1 / c, apart * apart, apart);
    const floatL by_mean = by_mu - 2.0f * (off1 * by_variance) - off2 * by_covariance;
    const floatL column = (floatL)(x) + LANE_INDEX;
    const intL inside = column < (floatL)(block.width);
    const floatL zero = (floatL)(0.0f);
    if (x >= block.x0 && x < block.x1) total += inside ? ssim : zero;
    __global float *out = block.partials + PARTIALS_AT(block, x, y + row);
    STOREL(inside ? by_mean : zero, out);
    STOREL(inside ? 2.0f * by_variance : zero, out + block.field);
    STOREL(inside ? by_covariance : zero, out + 2 * block.field);
  }
  return sumL(total);
}

// Computes the vertical sums of SSIM's gradient: `near` gets the sums of the three partials over vertical windows, then
// image and target; 0 outside the image. The first sum includes the other two partials, times differences of pixels
// from the centre pixel.
static inline void adjoint_moments(const Block block, const int margin, const int y, __local float *near) {
  FOR_VECTORS(block, margin, ROWS) {
    VECTOR(block)
    if (OUTSIDE(block, x, y + row)) {
      for (int field = 0; field < 5; ++field) STORE_NEAR((floatL)(0.0f), near_at + field * NEAR_FIELD);
      continue;
    }
    const int2 taps = taps_inside(block, y + row);
    const uint here = PIXEL_AT(block, x, y + row);
    const floatL p0 = LOADL(block.image + here), q0 = LOADL(block.target + here);
    floatL by_mean = (floatL)(0.0f), by_variance = by_mean, by_covariance = by_mean;
    __global const float *means = block.partials, *variances = means + block.field,
                         *covariances = variances + block.field;
    uint at = PIXEL_AT(block, x, y + row + taps.x - REACH);
    for (int tap = taps.x; tap < taps.y; ++tap, at += block.stride) {
      const uint in = PARTIALS_AT(block, x, y + row + tap - REACH);
      const floatL p = LOADL(block.image + at) - p0, q = LOADL(block.target + at) - q0;
      const floatL w = (floatL)(window[tap]);
      const floatL v = w * LOADL(variances + in), c = w * LOADL(covariances + in);
      by_mean = fmaL(w, LOADL(means + in), by_mean) - fmaL(p, v, q * c);
      by_variance += v;
      by_covariance += c;
    }
    STORE_NEAR(by_mean, near_at);
    STORE_NEAR(by_variance, near_at + NEAR_FIELD);
    STORE_NEAR(by_covariance, near_at + 2 * NEAR_FIELD);
    STORE_NEAR(p0, near_at + 3 * NEAR_FIELD);
    STORE_NEAR(q0, near_at + 4 * NEAR_FIELD);
  }
}

// Computes the loss's gradient by horizontal sums: near -> gradient, one plane. Returns the item's sums of |image -
// target| and of its square. l1_scale, ssim_scale: the loss weights divided by the number of pixels times channels.
static inline float2 differences(const Block block, const int y, const float l1_scale, const float ssim_scale,
                                 __local float *near, __global float *gradient) {
  floatL absolute = (floatL)(0.0f), squares = absolute;
  FOR_VECTORS(block, 0, 1) {
    VECTOR(block)
    if (OUTSIDE(block, x, y + row)) continue;
    const uint here = PIXEL_AT(block, x, y + row);
    const floatL p = LOADL(block.image + here), q = LOADL(block.target + here);
    floatL ssim = (floatL)(0.0f);
    for (int tap = 0; tap < TAPS; ++tap) {
      __local const float *in = near_at + (tap - REACH);
      const floatL by_p = p - LOAD_NEAR(in + 3 * NEAR_FIELD);
      const floatL by_q = q - LOAD_NEAR(in + 4 * NEAR_FIELD);
      const floatL both = fmaL(by_q, LOAD_NEAR(in + 2 * NEAR_FIELD), LOAD_NEAR(in));
      ssim = fmaL((floatL)(window[tap]), fmaL(by_p, LOAD_NEAR(in + NEAR_FIELD), both), ssim);
    }
    const floatL difference = p - q;
    const floatL sign =
        difference > 0.0f ? (floatL)(l1_scale) : (difference < 0.0f ? (floatL)(-l1_scale) : (floatL)(0.0f));
    const floatL column = (floatL)(x) + LANE_INDEX;
    const floatL g = fmaL((floatL)(-ssim_scale), ssim, sign);
    STOREL(column < (floatL)(block.width) ? g : (floatL)(0.0f), gradient + here);
    absolute += AS_FLOATL(AS_INTL(difference) & 0x7fffffff); // fabs is a call in PoCL 3.0
    squares = fmaL(difference, difference, squares);
  }
  return (float2)(sumL(absolute), sumL(squares));
}

// Computes the loss and its gradient in one launch: image, target -> gradient, sums. A block has block_rows x columns
// pixels, and at most LOSS_COLUMNS columns. field: the floats between the derivatives of a row in `partials`, at least
// columns + 2 * MARGIN.
GROUP __kernel void loss(const int width, const int height, const int stride, const int plane, const int columns,
                         const int block_rows, const int field, const float l1_scale, const float ssim_scale,
                         __global const float *image, __global const float *target, __global float *partials,
                         __global float *gradient, __global float *sums) {
  __local float near[5 * NEAR_FIELD];
  const int across = (stride + columns - 1) / columns, down = (height + block_rows - 1) / block_rows;
  const size_t kind = (size_t)3 * height * across;
  Block block;
  block.width = width, block.height = height, block.stride = stride;
  block.field = field, block.pitch = 3 * field;
  block.partials = partials + (size_t)LOSS_RING * block.pitch * get_group_id(0);
  for (int index = get_group_id(0); index < 3 * down * across; index += get_num_groups(0)) {
    const int channel = index / (down * across), y0 = index / across % down * block_rows;
    const int y1 = min(y0 + block_rows, height);
    block.image = image + (size_t)plane * channel, block.target = target + (size_t)plane * channel;
    block.x0 = index % across * columns, block.x1 = min(block.x0 + columns, stride);
    block.x_partials = block.x0 - MARGIN;
    __global float *ssims = sums + (size_t)height * across * channel + index % across;
    int next = y0 - REACH; // the next row whose derivatives are computed; rows above the image have none
    for (int y = y0; y < y1; y += ROWS) {
      for (; next < min(height, y + ROWS + REACH); next += ROWS) {
        moments(block, 2 * MARGIN, next, near);
        for (int row = next; row < next + ROWS; ++row) {
          const float ssim = derivatives(block, MARGIN, row, near + (row - next) * NEAR_WIDTH);
          if (row >= y0 && row < y1) ssims[(size_t)across * row] = ssim;
        }
      }
      adjoint_moments(block, MARGIN, y, near);
      for (int row = y; row < min(y + ROWS, y1); ++row) {
        const float2 errors = differences(block, row, l1_scale, ssim_scale, near + (row - y) * NEAR_WIDTH,
                                          gradient + (size_t)plane * channel);
        ssims[kind + (size_t)across * row] = errors.x;
        ssims[2 * kind + (size_t)across * row] = errors.y;
      }
    }
  }
}
#else
#include "shared/loss_groups.h"

// Computes SSIM and its derivatives: image, target -> partials, sums[0].
GROUP __kernel void loss_ssim(const int width, const int height, const int stride, const int plane,
                              __global const float *image, __global const source_t *target, __global float *partials,
                              __global float *sums) {
  __local float near[4 * FIELD] __attribute__((aligned(16))), parts[SUMS] __attribute__((aligned(16)));
  const Block block = block_of_group(width, height, stride, plane, image, target, partials);
  moments(block, near);
  barrier(CLK_LOCAL_MEM_FENCE);
  derivatives(block, near, parts);
  add_parts(parts, 1);
  if (get_local_id(0) == 0) sums[BLOCK_NUMBER] = parts[TOP];
}

// Computes the loss's gradient from the derivatives of SSIM: image, target, partials -> gradient, sums[1], sums[2].
GROUP __kernel void loss_grad(const int width, const int height, const int stride, const int plane,
                              const float l1_scale, const float ssim_scale, __global const float *image,
                              __global const source_t *target, __global float *partials, __global float *gradient,
                              __global float *sums) {
  __local float near[3 * FIELD + 2 * PARTS] __attribute__((aligned(16))), parts[2 * SUMS] __attribute__((aligned(16)));
  const Block block = block_of_group(width, height, stride, plane, image, target, partials);
  adjoint_moments(block, near);
  barrier(CLK_LOCAL_MEM_FENCE);
  differences(block, l1_scale, ssim_scale, near, gradient + plane * get_group_id(2), parts);
  add_parts(parts, 2);
  if (get_local_id(0) == 0) {
    sums[BLOCKS + BLOCK_NUMBER] = parts[TOP];
    sums[2 * BLOCKS + BLOCK_NUMBER] = parts[SUMS + TOP];
  }
}
#endif

// The loss (1 - weight) L1 + weight (1 - SSIM) and its gradient. SSIM has the usual 11 x 11 Gaussian window, sigma 1.5,
// with zeros outside the image. The window is separable: vertical first, into local memory, then horizontal. A second
// pair of passes, the adjoint of the first, convolves the three partial derivatives.
//
// Owner: A group owns blocks of one channel. With ITEMS == 1 it processes a block from the top, ROWS rows at a time,
//   and keeps the derivatives of LOSS_RING rows; rows shared with other blocks are recomputed. Otherwise a block is
//   ROWS x COLUMNS pixels in PARTS parts, of which an item has one or several. A first launch writes the derivatives of
//   the whole image, and a second reads them.
// Launch: With ITEMS == 1 any number of groups, which share the blocks; otherwise a grid of groups of at most PARTS
//   items, for the blocks across and down and the channels. Blocks are numbered in this order.
// Buffers: image, target (3, rows, stride): colour, padded to whole tiles with zeros; with PHOTOGRAPH the target is
//   (height, width, 3), bytes or floats; partials: with ITEMS == 1 (groups, LOSS_RING, 3, field), otherwise (3
//   channels, strips of COLUMNS columns, height, 3 derivatives, COLUMNS), so that address differences in a column are
//   constants; gradient (3, rows, stride), 0 right of the image; sums (3, ...) of SSIM, of |image - target| and of its
//   square: one per block, or per row of a block with ITEMS == 1.
// Equations: docs/gradients.md, (17) to (21) in the forms (78) and (79); with several items (188) and (189).
//
// In bright, flat pictures E[x^2] - E[x]^2 cancels. So a window sums differences from one of its own pixels
// (docs/gradients.md, section 12). Variances are then sums of small squares, and the gradient is a sum of differences.
#if ITEMS == 1 && LANES == 8 && defined(FMA_BY_CONTRACTION)
#undef LANES // Two vectors at a time, because a window's sum is a chain of dependent additions.
#define LANES 16
#endif
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/group.h"
#include "shared/photograph.h"

#define TAPS 11
#define REACH 5
#define C1 1e-4f
#define C2 9e-4f
__constant float window[TAPS] = {1.02838008e-3f, 7.59875814e-3f, 3.60007721e-2f, 1.09360690e-1f,
                                 2.13005538e-1f, 2.66011725e-1f, 2.13005538e-1f, 1.09360690e-1f,
                                 3.60007721e-2f, 7.59875814e-3f, 1.02838008e-3f};

#define PIXEL_AT(block, x, y) ((uint)(block).stride * (uint)(y) + (uint)(x))

#if ITEMS == 1
// Number of columns that a window reaches beyond each side of a block, rounded up to whole vectors.
#define MARGIN ((REACH + LANES - 1) / LANES * LANES)
#define ROWS LOSS_ROWS
#define RING_ROW(y) ((y) & (LOSS_RING - 1))

// Local memory `near`: five fields of ROWS rows of a block with margins. A block has at most LOSS_COLUMNS columns.
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

// Columns x0 to x1 of a channel. partials: its derivatives from column x_partials on, with `pitch` floats between rows
// and `field` floats between fields.
typedef struct {
  __global const float *image, *target;
  __global float *partials;
  size_t field;
  uint pitch;
  int x_partials, x0, x1, width, height, stride;
} Block;
#define PARTIALS_AT(block, x, y) ((block).pitch * (uint)RING_ROW(y) + (uint)((x) - (block).x_partials))

// FOR_VECTORS and VECTOR loop over the vectors in `rows` rows, with `margin` columns on each side; they define x, row
// and `near_at`. The inner loop is over rows, because vertical windows of neighbouring rows share pixels.
#define FOR_VECTORS(block, margin, rows)                                                                               \
  for (int x = (block).x0 - (margin); x < (block).x1 + (margin); x += LANES)                                           \
    for (int row = 0; row < (rows); ++row)
#define VECTOR(block) __local float *near_at = near + (row * NEAR_WIDTH + x - (block).x0 + NEAR_MARGIN);
#define OUTSIDE(block, x, y) ((x) < 0 || (x) >= (block).stride || (y) < 0 || (y) >= (block).height)

// The range [result.x, result.y) of a window's taps that are inside the image, for a window around row y.
static inline int2 taps_inside(const Block block, const int y) {
  return (int2)(max(0, REACH - y), min(TAPS, block.height + REACH - y));
}

// near = sums over vertical windows around row y and the rows below: means of image and target, their variances, and
// the covariance; 0 outside the image.
static inline void moments(const Block block, const int margin, const int y, __local float *near) {
  FOR_VECTORS(block, margin, ROWS) {
    VECTOR(block)
    if (OUTSIDE(block, x, y + row)) {
      for (int field = 0; field < 5; ++field) STORE_NEAR((floatL)(0.0f), near_at + field * NEAR_FIELD);
      continue;
    }
    const int2 taps = taps_inside(block, y + row);
    float beyond = 0.0f; // weight of the taps outside the image, where pixels are 0
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

// near -> partials: the derivatives of SSIM with respect to the image's mean (relative to the centre pixel), to its
// variance (doubled), and to the covariance. All are 0 right of the image. Returns the item's sum of SSIM over the
// block's own columns.
static inline float derivatives(const Block block, const int margin, const int y, __local float *near) {
  floatL total = (floatL)(0.0f);
  FOR_VECTORS(block, margin, 1) {
    VECTOR(block)
    if (OUTSIDE(block, x, y + row)) continue;
    const uint here = PIXEL_AT(block, x, y + row);
    const floatL p = LOADL(block.image + here), q = LOADL(block.target + here);
    floatL off1 = (floatL)(0.0f), off2 = off1, var1 = off1, var2 = off1, covariance = off1; // off: means minus p and q
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

// near = sums over vertical windows of the partials, then image and target; 0 outside the image. The first sum includes
// the other two partials, times differences of pixels from the centre pixel.
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

// near -> gradient, a plane. Returns the item's sums of |image - target| and of its square. l1_scale and ssim_scale
// are the loss weights divided by the number of pixels and channels.
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

// image, target -> gradient, sums. Blocks are block_rows x columns, at most COLUMNS wide; field: at least columns + 2
// MARGIN.
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
    int next = y0 - REACH; // next row of derivatives; rows above the image get none
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
// For vertical windows, a part is a column of the block or of its margins; for horizontal windows, a run of RUN pixels.
// Windows slide over values in registers. They sum differences from a pixel that all windows of the part contain: the
// middle of the column, or of a cell of ROWS x RUN pixels. The bits do not depend on ITEMS.
#if ITEMS > LOSS_PARTS
#undef ITEMS
#define ITEMS LOSS_PARTS
#endif
#define ROWS LOSS_GROUP_ROWS
#define COLUMNS LOSS_GROUP_COLUMNS
#define PARTS LOSS_PARTS // COLUMNS + 2 * REACH, a power of four
#define RUN 6
#define RUNS (COLUMNS / RUN) // runs in a row; ROWS * RUNS <= PARTS
#define TALL (ROWS + 2 * REACH)
#define WIDE (RUN + 2 * REACH)
#define INLINE inline __attribute__((always_inline)) // PoCL computes wrong results if it does not inline
#define FOR_PARTS(part, count) for (int part = get_local_id(0) % ITEMS; part < (count); part += ITEMS)

// The middle pixel of the cell that contains pixel (x, y). It is inside the image.
#define MIDDLE_X(block, x) min((x) / RUN * RUN + RUN / 2, (block).width - 1)
#define MIDDLE_Y(block, y) min((y) / ROWS * ROWS + ROWS / 2, (block).height - 1)

// Local memory `near`: fields of ROWS x PARTS values.
#define FIELD (ROWS * PARTS)
#define SUMS (PARTS + PARTS / 2) // sums of the parts, and space to add them up

// A block, whose first pixel is (x0, y0). partials: those of the channel, (strips, height, 3, COLUMNS), with a strip of
// COLUMNS columns for each block across.
typedef struct {
  __global const float *image;
  __global const source_t *target;
  __global float *partials;
  int width, height, stride, x0, y0;
} Block;

#ifdef PHOTOGRAPH
#define TARGET_STEP 3
#define TARGET_ROW(block) (3 * (block).width)
#define TARGET_CHANNEL(plane) 1
#else
#define TARGET_STEP 1
#define TARGET_ROW(block) ((block).stride)
#define TARGET_CHANNEL(plane) (size_t)(plane)
#endif
#define IMAGE_AT(block, x, y) ((block).image + ((long)(block).stride * (y) + (x)))
#define TARGET_AT(block, x, y) ((block).target + ((long)TARGET_ROW(block) * (y) + TARGET_STEP * (x)))
#define PARTIALS_AT(block, x, y)                                                                                       \
  ((block).partials + ((long)((x) / COLUMNS * (block).height + (y)) * (3 * COLUMNS) + (x) % COLUMNS))

static inline Block block_of_group(const int width, const int height, const int stride, const int plane,
                                   __global const float *image, __global const source_t *target,
                                   __global float *partials) {
  const size_t channel = get_group_id(2);
  Block block;
  block.width = width, block.height = height, block.stride = stride;
  block.x0 = get_group_id(0) * COLUMNS, block.y0 = get_group_id(1) * ROWS;
  block.image = image + plane * channel;
  block.target = target + TARGET_CHANNEL(plane) * channel;
  block.partials = partials + 3 * COLUMNS * height * get_num_groups(0) * channel;
  return block;
}
#define BLOCKS (get_num_groups(0) * get_num_groups(1) * get_num_groups(2))
#define BLOCK_NUMBER ((get_group_id(2) * get_num_groups(1) + get_group_id(1)) * get_num_groups(0) + get_group_id(0))

// Defines x and y of the first of the TALL pixels in a part's column, and which of them are inside the image. As the
// block's first row is inside, rows before it can only be above the image, and rows after it only below.
#define COLUMN_OF_PART(block, part)                                                                                    \
  const int x = (block).x0 - REACH + (part), y = (block).y0 - REACH, column_inside = x >= 0 && x < (block).width;      \
  const int above = column_inside ? -y : TALL, below = column_inside ? (block).height - y : 0;
#define ROW_INSIDE(i) ((i) < REACH ? (i) >= above : (i) < below)

// Defines row, x and y of a part's run. Skips a run outside the block, or outside an image of this `width`.
#define RUN_OF_PART(block, part, width)                                                                                \
  const int run = (part) % RUNS * RUN, row = (part) / RUNS, x = (block).x0 + run, y = (block).y0 + row;                \
  if (row >= ROWS || x >= (width) || y >= (block).height) continue;

// Adds weight * value to sums[k] for each of `count` windows. place: position of the value in window 0.
#define ADD_TO_WINDOWS(sums, count, place, value)                                                                      \
  UNROLL for (int k = 0; k < (count); ++k) {                                                                           \
    if ((place) - k >= 0 && (place) - k < TAPS) sums[k] = fma1(window[(place) - k], value, sums[k]);                   \
  }
#define ZEROS(sums, count) UNROLL for (int k = 0; k < (count); ++k) sums[k] = 0.0f;

// near = sums over vertical windows: means of image and target, the sum of their variances, and the covariance.
static INLINE void moments(const Block block, __local float *near) {
  FOR_PARTS(part, PARTS) {
    COLUMN_OF_PART(block, part)
    __global const float *image = IMAGE_AT(block, x, y);
    __global const source_t *target = TARGET_AT(block, x, y);
    float p[TALL], q[TALL], mean1[ROWS], mean2[ROWS], squares[ROWS], products[ROWS];
    UNROLL for (int i = 0; i < TALL; ++i, image += block.stride, target += TARGET_ROW(block)) {
      p[i] = q[i] = 0.0f;
      if (ROW_INSIDE(i)) p[i] = *image, q[i] = SAMPLE(*target);
    }
    ZEROS(mean1, ROWS)
    ZEROS(mean2, ROWS)
    ZEROS(squares, ROWS)
    ZEROS(products, ROWS)
    const float p0 = p[TALL / 2], q0 = q[TALL / 2];
    UNROLL for (int i = 0; i < TALL; ++i) {
      const float e1 = p[i] - p0, e2 = q[i] - q0, square = fma1(e1, e1, e2 * e2), product = e1 * e2;
      ADD_TO_WINDOWS(mean1, ROWS, i, e1)
      ADD_TO_WINDOWS(mean2, ROWS, i, e2)
      ADD_TO_WINDOWS(squares, ROWS, i, square)
      ADD_TO_WINDOWS(products, ROWS, i, product)
    }
    UNROLL for (int row = 0; row < ROWS; ++row) {
      __local float *out = near + (row * PARTS + part);
      const float off1 = mean1[row], off2 = mean2[row];
      out[0] = p0 + off1;
      out[FIELD] = q0 + off2;
      out[2 * FIELD] = fma1(-off1, off1, fma1(-off2, off2, squares[row]));
      out[3 * FIELD] = fma1(-off1, off2, products[row]);
    }
  }
}

// 1 / x for positive x, if it is a normal float: three steps of Newton's method from a start that is off by up to 12 %.
// The error is under 2 ulp, and the bits are the same on every device.
static inline float reciprocal(const float x) {
  const float a = as_float(0x7ef311c7u - as_uint(x)), b = fma1(a, fma1(-x, a, 1.0f), a),
              c = fma1(b, fma1(-x, b, 1.0f), b);
  return fma1(c, fma1(-x, c, 1.0f), c);
}

// near -> partials: the derivatives of SSIM with respect to the image's mean (relative to the cell's middle pixel), to
// its variance (doubled), and to the covariance. parts = the parts' sums of SSIM.
static INLINE void derivatives(const Block block, __local const float *near, __local float *parts) {
  FOR_PARTS(part, PARTS) {
    parts[part] = 0.0f;
    RUN_OF_PART(block, part, block.width)
    __local const float *in = near + (row * PARTS + run);
    float mean1[RUN], mean2[RUN], variances[RUN], covariance[RUN], total = 0.0f;
    ZEROS(mean1, RUN)
    ZEROS(mean2, RUN)
    ZEROS(variances, RUN)
    ZEROS(covariance, RUN)
    const int middle_x = MIDDLE_X(block, x), middle_y = MIDDLE_Y(block, block.y0);
    const float p0 = *IMAGE_AT(block, middle_x, middle_y), q0 = SAMPLE(*TARGET_AT(block, middle_x, middle_y));
    UNROLL for (int i = 0; i < WIDE; ++i) {
      const float e1 = in[i] - p0, e2 = in[i + FIELD] - q0;
      const float square = fma1(e1, e1, fma1(e2, e2, in[i + 2 * FIELD]));
      const float product = fma1(e1, e2, in[i + 3 * FIELD]);
      ADD_TO_WINDOWS(mean1, RUN, i, e1)
      ADD_TO_WINDOWS(mean2, RUN, i, e2)
      ADD_TO_WINDOWS(variances, RUN, i, square)
      ADD_TO_WINDOWS(covariance, RUN, i, product)
    }
    __global float *out = PARTIALS_AT(block, x, y);
    UNROLL for (int k = 0; k < RUN; ++k) {
      const float off1 = mean1[k], off2 = mean2[k], mu1 = p0 + off1, mu2 = q0 + off2, apart = mu2 - mu1;
      const float a = fma1(mu1 + mu1, mu2, C1), b = fma1(2.0f, fma1(-off1, off2, covariance[k]), C2);
      const float c = fma1(mu1, mu1, fma1(mu2, mu2, C1));
      const float d = fma1(-off1, off1, fma1(-off2, off2, variances[k])) + C2;
      const float inverse = reciprocal(c * d), by_a = b * inverse, ssim = a * by_a;
      const float by_covariance = 2.0f * a * inverse, by_variance = -2.0f * ssim * (c * inverse);
      const float by_mu = 2.0f * by_a * fma1(mu1 * (d * inverse), apart * apart, apart);
      if (x + k < block.width) {
        total += ssim;
        out[k] = fma1(-off1, by_variance, fma1(-off2, by_covariance, by_mu));
        out[k + COLUMNS] = by_variance;
        out[k + 2 * COLUMNS] = by_covariance;
      }
    }
    parts[part] = total;
  }
}

// near = sums over vertical windows of the three partials, by mean, variance and covariance; behind these sums in
// memory, the middle pixels of image and target. Partials of the cells above and below are relative to those cells'
// middle pixels. To move them to this cell's, the sum by mean gains the partial by variance times the difference of the
// image's middle pixels, and the partial by covariance times that of the target's.
static INLINE void adjoint_moments(const Block block, __local float *near) {
  FOR_PARTS(part, PARTS) {
    COLUMN_OF_PART(block, part)
    __global const float *partials = PARTIALS_AT(block, x, y);
    float means[TALL], variances[TALL], covariances[TALL];
    UNROLL for (int i = 0; i < TALL; ++i, partials += 3 * COLUMNS) {
      means[i] = variances[i] = covariances[i] = 0.0f;
      if (ROW_INSIDE(i)) means[i] = *partials, variances[i] = partials[COLUMNS], covariances[i] = partials[2 * COLUMNS];
    }
    float p[3], q[3];
    ZEROS(p, 3)
    ZEROS(q, 3)
    UNROLL for (int cell = 0; cell < 3; ++cell) {
      const int cell_y = block.y0 + (cell - 1) * ROWS;
      if (!column_inside || cell_y < 0 || cell_y >= block.height) continue;
      p[cell] = *IMAGE_AT(block, MIDDLE_X(block, x), MIDDLE_Y(block, cell_y));
      q[cell] = SAMPLE(*TARGET_AT(block, MIDDLE_X(block, x), MIDDLE_Y(block, cell_y)));
    }
    float by_mean[ROWS], by_variance[ROWS], by_covariance[ROWS];
    ZEROS(by_mean, ROWS)
    ZEROS(by_variance, ROWS)
    ZEROS(by_covariance, ROWS)
    UNROLL for (int i = 0; i < TALL; ++i) {
      const float v = variances[i], c = covariances[i];
      float m = means[i];
      if (i < REACH) m = fma1(p[1] - p[0], v, fma1(q[1] - q[0], c, m));
      if (i >= REACH + ROWS) m = fma1(p[1] - p[2], v, fma1(q[1] - q[2], c, m));
      ADD_TO_WINDOWS(by_mean, ROWS, i, m)
      ADD_TO_WINDOWS(by_variance, ROWS, i, v)
      ADD_TO_WINDOWS(by_covariance, ROWS, i, c)
    }
    UNROLL for (int row = 0; row < ROWS; ++row) {
      __local float *out = near + (row * PARTS + part);
      out[0] = by_mean[row];
      out[FIELD] = by_variance[row];
      out[2 * FIELD] = by_covariance[row];
    }
    near[3 * FIELD + part] = p[1];
    near[3 * FIELD + PARTS + part] = q[1];
  }
}

// near -> gradient, a plane. parts = the parts' sums of |image - target|, then of its square. l1_scale and ssim_scale
// are the loss weights divided by the number of pixels and channels.
static INLINE void differences(const Block block, const float l1_scale, const float ssim_scale,
                               __local const float *near, __global float *gradient, __local float *parts) {
  FOR_PARTS(part, PARTS) {
    parts[part] = parts[SUMS + part] = 0.0f;
    RUN_OF_PART(block, part, block.stride)
    __local const float *in = near + (row * PARTS + run), *middle = near + (3 * FIELD + run);
    const float p0 = middle[REACH], q0 = middle[REACH + PARTS]; // of this cell; next, minus the cells beside it
    const float p_left = p0 - middle[REACH - 1], q_left = q0 - middle[REACH - 1 + PARTS];
    const float p_right = p0 - middle[REACH + RUN], q_right = q0 - middle[REACH + RUN + PARTS];
    float by_mean[RUN], by_variance[RUN], by_covariance[RUN], absolute = 0.0f, squares = 0.0f;
    ZEROS(by_mean, RUN)
    ZEROS(by_variance, RUN)
    ZEROS(by_covariance, RUN)
    UNROLL for (int i = 0; i < WIDE; ++i) {
      const float v = in[i + FIELD], c = in[i + 2 * FIELD];
      float m = in[i];
      if (i < REACH) m = fma1(p_left, v, fma1(q_left, c, m));
      if (i >= REACH + RUN) m = fma1(p_right, v, fma1(q_right, c, m));
      ADD_TO_WINDOWS(by_mean, RUN, i, m)
      ADD_TO_WINDOWS(by_variance, RUN, i, v)
      ADD_TO_WINDOWS(by_covariance, RUN, i, c)
    }
    __global const float *image = IMAGE_AT(block, x, y);
    __global const source_t *target = TARGET_AT(block, x, y);
    __global float *out = gradient + PIXEL_AT(block, x, y);
    UNROLL for (int k = 0; k < RUN; ++k) {
      float p = 0.0f, q = 0.0f;
      if (x + k < block.width) p = image[k], q = SAMPLE(target[TARGET_STEP * k]);
      const float ssim = fma1(p - p0, by_variance[k], fma1(q - q0, by_covariance[k], by_mean[k]));
      const float difference = p - q;
      const float sign = difference > 0.0f ? l1_scale : (difference < 0.0f ? -l1_scale : 0.0f);
      const float g = fma1(-ssim_scale, ssim, sign);
      absolute += as_float(as_int(difference) & 0x7fffffff); // fabs is a call in PoCL 3.0
      squares = fma1(difference, difference, squares);
      if (x + k < block.stride) out[k] = x + k < block.width ? g : 0.0f;
    }
    parts[part] = absolute;
    parts[SUMS + part] = squares;
  }
}

// Adds up the parts' sums of `fields` fields, which are SUMS floats apart, in a fixed order. The total of a field is at
// TOP. Before the next barrier, only the group's first item may read it.
#define TOP (PARTS + PARTS / 4 + PARTS / 16)
static INLINE void add_parts(__local float *parts, const int fields) {
  UNROLL for (int count = PARTS / 4; count > 0; count /= 4) {
    barrier(CLK_LOCAL_MEM_FENCE);
    FOR_PARTS(part, count) {
      UNROLL for (int field = 0; field < fields; ++field) {
        const float4 four = *(__local const float4 *)(parts + SUMS * field + 4 * part);
        parts[SUMS * field + 4 * count + part] = (four.x + four.y) + (four.z + four.w);
      }
    }
    parts += 4 * count;
  }
}

// image, target -> partials, sums[0].
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

// image, target, partials -> gradient, sums[1], sums[2].
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

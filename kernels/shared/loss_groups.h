// The loss (L1 and SSIM) for groups of several items: sums over the windows of a block, their derivatives, and the
// gradient. loss.cl includes this file after it defines TAPS, REACH, C1, C2, `window` and PIXEL_AT.
//
// A block is divided into parts, which the items share. For vertical windows, a part is a column of the block or of its
// margins; for horizontal windows, a run of RUN pixels. An item holds a part's values in registers and slides the
// windows over them. Windows sum differences from a pixel that all windows of the part contain: the middle pixel of the
// column, or of a cell of ROWS x RUN pixels. The bits do not depend on ITEMS.
#if ITEMS > LOSS_PARTS
#undef ITEMS
#define ITEMS LOSS_PARTS
#endif
#define ROWS LOSS_GROUP_ROWS
#define COLUMNS LOSS_GROUP_COLUMNS
#define PARTS LOSS_PARTS // COLUMNS + 2 * REACH, a power of four
#define RUN 6
#define RUNS (COLUMNS / RUN) // number of runs in a row of a block; ROWS * RUNS <= PARTS
#define TALL (ROWS + 2 * REACH)
#define WIDE (RUN + 2 * REACH)
// A window must not reach beyond the cells next to its own cell: adjoint_moments and differences know only the middle
// pixels of these cells. Smaller cells would give wrong gradients.
#if ROWS < REACH || RUN < REACH
#error "LOSS_GROUP_ROWS and RUN must be at least REACH, 5"
#endif
#if COLUMNS + 2 * REACH != PARTS || COLUMNS % RUN != 0 || ROWS * RUNS > PARTS
#error "LOSS_PARTS must be the columns of a block and its margins, and at least its runs"
#endif
#define INLINE inline __attribute__((always_inline)) // PoCL computes wrong results if these are not inlined
#define FOR_PARTS(part, count) for (int part = get_local_id(0) % ITEMS; part < (count); part += ITEMS)

// The middle pixel of the cell that contains pixel (x, y), clamped to the image.
#define MIDDLE_X(block, x) min((x) / RUN * RUN + RUN / 2, (block).width - 1)
#define MIDDLE_Y(block, y) min((y) / ROWS * ROWS + ROWS / 2, (block).height - 1)

// Size of a field of `near` in local memory: ROWS x PARTS values.
#define FIELD (ROWS * PARTS)
#define SUMS (PARTS + PARTS / 2) // size of `parts`: a sum for each part, and space to add them up

// A block of one channel, with (x0, y0) as its first pixel. partials: the channel's partial derivatives of SSIM
// (strips, height, 3, COLUMNS), with a strip of COLUMNS columns for each block across the image.
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

// Defines x and y of the first of the TALL pixels in a part's column, and which of these pixels are inside the image
// (ROW_INSIDE). The block's first row is inside the image. So earlier rows can only be above the image, and later rows
// only below it.
#define COLUMN_OF_PART(block, part)                                                                                    \
  const int x = (block).x0 - REACH + (part), y = (block).y0 - REACH, column_inside = x >= 0 && x < (block).width;      \
  const int above = column_inside ? -y : TALL, below = column_inside ? (block).height - y : 0;
#define ROW_INSIDE(i) ((i) < REACH ? (i) >= above : (i) < below)

// Defines row, x and y of a part's run. Skips a run that is outside the block, or outside an image of the given
// `width`.
#define RUN_OF_PART(block, part, width)                                                                                \
  const int run = (part) % RUNS * RUN, row = (part) / RUNS, x = (block).x0 + run, y = (block).y0 + row;                \
  if (row >= ROWS || x >= (width) || y >= (block).height) continue;

// Adds `value`, times the weight of its tap, to sums[k] for each of `count` windows k. place: the tap of the value in
// window 0.
#define ADD_TO_WINDOWS(sums, count, place, value)                                                                      \
  UNROLL for (int k = 0; k < (count); ++k) {                                                                           \
    if ((place) - k >= 0 && (place) - k < TAPS) sums[k] = fma1(window[(place) - k], value, sums[k]);                   \
  }
#define ZEROS(sums, count) UNROLL for (int k = 0; k < (count); ++k) sums[k] = 0.0f;

// Computes the vertical sums of SSIM: `near` gets the means of image and target, the sum of their variances, and the
// covariance, over vertical windows.
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

// 1 / x for positive x whose reciprocal is a normal float, with an error under 2 ulp and the same bits on every device.
// Three steps of Newton's method improve a first estimate that is off by up to 12 %.
static inline float reciprocal(const float x) {
  const float a = as_float(0x7ef311c7u - as_uint(x)), b = fma1(a, fma1(-x, a, 1.0f), a),
              c = fma1(b, fma1(-x, b, 1.0f), b);
  return fma1(c, fma1(-x, c, 1.0f), c);
}

// Computes SSIM and its derivatives by horizontal sums of `near`. `partials` gets the derivatives of SSIM with respect
// to the image's mean (relative to the cell's middle pixel), to its variance (doubled), and to the covariance. `parts`
// gets each part's sum of SSIM.
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

// Computes the vertical sums of SSIM's gradient: `near` gets the sums over vertical windows of the three partials (by
// mean, variance and covariance), followed by the middle pixels of image and target. Partials of the cells above and
// below are relative to the middle pixels of those cells. To make them relative to this cell's middle pixel, the sum by
// mean gains two terms: the partial by variance times the difference of the image's middle pixels, and the partial by
// covariance times the difference of the target's.
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

// Computes the loss's gradient by horizontal sums: near -> gradient, one plane; parts: each part's sum of |image -
// target|, then of its square. l1_scale, ssim_scale: the loss weights divided by the number of pixels times channels.
static INLINE void differences(const Block block, const float l1_scale, const float ssim_scale,
                               __local const float *near, __global float *gradient, __local float *parts) {
  FOR_PARTS(part, PARTS) {
    parts[part] = parts[SUMS + part] = 0.0f;
    RUN_OF_PART(block, part, block.stride)
    __local const float *in = near + (row * PARTS + run), *middle = near + (3 * FIELD + run);
    // p0, q0: image and target in the middle pixel of this cell; the others: p0 and q0 minus the values in the middle
    // pixels of the cells to the left and to the right.
    const float p0 = middle[REACH], q0 = middle[REACH + PARTS];
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

// Adds up the sums of all parts of a block in a fixed order. `parts` has `fields` such sums for each part, in fields
// that are SUMS floats apart. Stores the total of a field at the field's index TOP. Before the next barrier, only the
// group's first item may read the total.
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

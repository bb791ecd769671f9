// The loss (1 - weight) L1 + weight (1 - SSIM) and its gradient. SSIM has the usual 11 x 11 Gaussian window, sigma 1.5,
// zeros outside the image. The window is separable: vertical first, which needs no margin, into planes with PAD zero
// columns on either side, then horizontal without bounds checks. A second pair of passes convolves the three partial
// derivatives, the adjoint of the first.
//
// Owner: A work-item owns every get_global_size(0)-th vector of one row of one channel: a whole row on a CPU.
// Launch: A grid of strips x height x channels: all three channels at once, or one after the other where memory is
//   short. `first` is the channel of the image that is the first of the launch's.
// Buffers: image, target (3, rows, stride) in colour, padded to whole tiles; moments, partials and gradient, whose
//   shapes are above each kernel; sums (3, 3, height, strips): SSIM, |image - target| and its square.
// Equations: docs/gradients.md, (17) to (21) in the forms (78) and (79).
//
// E[x^2] - E[x]^2 has no digits left in bright, flat pictures. So whatever a window is added up of counts from the
// pixel in its middle (docs/gradients.md, section 12): variances are sums of small squares, and the gradient is one of
// differences between a pixel and its neighbours.
#include "shared/math.h"
#include "shared/lanes.h"

#define TAPS 11
#define REACH 5
#define C1 1e-4f
#define C2 9e-4f
__constant float window[TAPS] = {1.02838008e-3f, 7.59875814e-3f, 3.60007721e-2f, 1.09360690e-1f,
                                 2.13005538e-1f, 2.66011725e-1f, 2.13005538e-1f, 1.09360690e-1f,
                                 3.60007721e-2f, 7.59875814e-3f, 1.02838008e-3f};

// Zero the margins of one row of a padded plane; row points at its first pixel.
static inline void clear_margins(__global float *row, int stride) {
  for (int i = 0; i < PAD; ++i) row[i - PAD] = row[stride + i] = 0.0f;
}

#define OWN_ROWS                                                                                                       \
  const int y = get_global_id(1), channel = get_global_id(2), channels = get_global_size(2);                           \
  const int step = get_global_size(0) * LANES, x_first = get_global_id(0) * LANES;                                     \
  const int padded = stride + 2 * PAD;                                                                                 \
  const size_t row = (size_t)plane * (first + channel) + (size_t)stride * y;                                           \
  const size_t padded_plane = (size_t)padded * height;                                                                 \
  const size_t padded_row = padded_plane * channel + (size_t)padded * y + PAD;

// image, target (3, rows, stride) -> moments (5, channels, height, stride + 2 PAD), of vertical windows: means of x and
// y, variances of x and y, covariance.
__kernel void loss_vertical(const int first, const int height, const int stride, const int plane,
                            __global const float *image, __global const float *target, __global float *moments) {
  OWN_ROWS
  if (get_global_id(0) == 0)
    for (int m = 0; m < 5; ++m) clear_margins(moments + channels * padded_plane * m + padded_row, stride);
  const int tap0 = max(0, REACH - y), tap1 = min(TAPS, height + REACH - y);
  float beyond = 0.0f; // what of the window is outside the image, where all is 0
  for (int tap = 0; tap < TAPS; ++tap) beyond += tap < tap0 || tap >= tap1 ? window[tap] : 0.0f;
  for (int x = x_first; x < stride; x += step) {
    const floatL p0 = LOADL(image + row + x), q0 = LOADL(target + row + x);
    floatL a = -beyond * p0, b = -beyond * q0;
    floatL aa = -(a * p0), bb = -(b * q0), ab = -(a * q0);
    for (int tap = tap0; tap < tap1; ++tap) {
      const size_t at = row + x + (long)(tap - REACH) * stride;
      const floatL p = LOADL(image + at) - p0, q = LOADL(target + at) - q0;
      const floatL wp = window[tap] * p, wq = window[tap] * q;
      a += wp;
      b += wq;
      aa = fmaL(wp, p, aa);
      bb = fmaL(wq, q, bb);
      ab = fmaL(wp, q, ab);
    }
    __global float *out = moments + padded_row + x;
    STOREL(p0 + a, out);
    STOREL(q0 + b, out + channels * padded_plane);
    STOREL(fmaL(-a, a, aa), out + 2 * channels * padded_plane);
    STOREL(fmaL(-b, b, bb), out + 3 * channels * padded_plane);
    STOREL(fmaL(-a, b, ab), out + 4 * channels * padded_plane);
  }
}

// image, target, moments -> partials (3, channels, height, stride): dSSIM by the mean of x as far as it counts from the
// pixel in the middle, by the variance and by the covariance, 0 right of the image; sums (3, 3, height, strips)[0]:
// SSIM.
__kernel void loss_ssim(const int first, const int width, const int height, const int stride, const int plane,
                        __global const float *image, __global const float *target, __global const float *moments,
                        __global float *partials, __global float *sums) {
  OWN_ROWS
  const size_t out_plane = (size_t)stride * height;
  floatL total = (floatL)(0.0f);
  for (int x = x_first; x < stride; x += step) {
    __global const float *in = moments + padded_row;
    const floatL p = LOADL(image + row + x), q = LOADL(target + row + x);
    floatL off1 = (floatL)(0.0f), off2 = off1, var1 = off1, var2 = off1, covariance = off1; // off: means from p and q
    for (int tap = 0; tap < TAPS; ++tap) {
      __global const float *at = in + x + tap - REACH;
      const floatL e1 = LOADL(at) - p, e2 = LOADL(at + channels * padded_plane) - q;
      const floatL w1 = window[tap] * e1, w2 = window[tap] * e2, w = (floatL)(window[tap]);
      off1 += w1;
      off2 += w2;
      var1 = fmaL(w, LOADL(at + 2 * channels * padded_plane), fmaL(w1, e1, var1));
      var2 = fmaL(w, LOADL(at + 3 * channels * padded_plane), fmaL(w2, e2, var2));
      covariance = fmaL(w, LOADL(at + 4 * channels * padded_plane), fmaL(w1, e2, covariance));
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
    const intL inside = column < (floatL)(width);
    const floatL zero = (floatL)(0.0f);
    total += inside ? ssim : zero;
    __global float *out = partials + out_plane * channel + (size_t)stride * y + x;
    STOREL(inside ? by_mean : zero, out);
    STOREL(inside ? by_variance : zero, out + channels * out_plane);
    STOREL(inside ? by_covariance : zero, out + 2 * channels * out_plane);
  }
  sums[((size_t)(first + channel) * height + y) * get_global_size(0) + get_global_id(0)] = sumL(total);
}

// image, target, partials -> moments (5, channels, height, stride + 2 PAD): the partials' vertical windows, the first
// with what the pixels differ by from the one in the middle; image and target, with margins.
__kernel void loss_vertical_grad(const int first, const int height, const int stride, const int plane,
                                 __global const float *image, __global const float *target,
                                 __global const float *partials, __global float *moments) {
  OWN_ROWS
  const size_t in_plane = (size_t)stride * height;
  const int tap0 = max(0, REACH - y), tap1 = min(TAPS, height + REACH - y);
  if (get_global_id(0) == 0)
    for (int m = 0; m < 5; ++m) clear_margins(moments + channels * padded_plane * m + padded_row, stride);
  for (int x = x_first; x < stride; x += step) {
    const floatL p0 = LOADL(image + row + x), q0 = LOADL(target + row + x);
    floatL by_mean = (floatL)(0.0f), by_variance = by_mean, by_covariance = by_mean;
    for (int tap = tap0; tap < tap1; ++tap) {
      __global const float *in = partials + in_plane * channel + x + (size_t)stride * (y + tap - REACH);
      const size_t at = row + x + (long)(tap - REACH) * stride;
      const floatL p = LOADL(image + at) - p0, q = LOADL(target + at) - q0;
      const floatL w = (floatL)(window[tap]);
      const floatL v = w * LOADL(in + channels * in_plane), c = w * LOADL(in + 2 * channels * in_plane);
      by_mean = fmaL(w, LOADL(in), by_mean) - fmaL(2.0f * p, v, q * c);
      by_variance += v;
      by_covariance += c;
    }
    __global float *out = moments + padded_row + x;
    STOREL(by_mean, out);
    STOREL(by_variance, out + channels * padded_plane);
    STOREL(by_covariance, out + 2 * channels * padded_plane);
    STOREL(p0, out + 3 * channels * padded_plane);
    STOREL(q0, out + 4 * channels * padded_plane);
  }
}

// moments, image, target -> gradient (3, rows, stride), sums[1]: |image - target|, sums[2]: its square.
// l1_scale and ssim_scale are the weights over the number of pixels and channels.
__kernel void loss_grad(const int first, const int width, const int height, const int stride, const int plane,
                        const float l1_scale, const float ssim_scale, __global const float *moments,
                        __global const float *image, __global const float *target, __global float *gradient,
                        __global float *sums) {
  OWN_ROWS
  floatL absolute = (floatL)(0.0f), squares = absolute;
  for (int x = x_first; x < stride; x += step) {
    __global const float *in = moments + padded_row;
    const floatL p = LOADL(image + row + x), q = LOADL(target + row + x);
    floatL ssim = (floatL)(0.0f);
    for (int tap = 0; tap < TAPS; ++tap) {
      __global const float *at = in + x + tap - REACH;
      const floatL by_p = 2.0f * (p - LOADL(at + 3 * channels * padded_plane));
      const floatL by_q = q - LOADL(at + 4 * channels * padded_plane);
      const floatL here = fmaL(by_q, LOADL(at + 2 * channels * padded_plane), LOADL(at));
      ssim = fmaL((floatL)(window[tap]), fmaL(by_p, LOADL(at + channels * padded_plane), here), ssim);
    }
    const floatL difference = p - q;
    const floatL sign =
        difference > 0.0f ? (floatL)(l1_scale) : (difference < 0.0f ? (floatL)(-l1_scale) : (floatL)(0.0f));
    const floatL column = (floatL)(x) + LANE_INDEX;
    const floatL g = fmaL((floatL)(-ssim_scale), ssim, sign);
    STOREL(column < (floatL)(width) ? g : (floatL)(0.0f), gradient + row + x);
    absolute += fabs(difference);
    squares = fmaL(difference, difference, squares);
  }
  const size_t count = (size_t)3 * height * get_global_size(0);
  const size_t at = ((size_t)(first + channel) * height + y) * get_global_size(0) + get_global_id(0);
  sums[count + at] = sumL(absolute);
  sums[2 * count + at] = sumL(squares);
}

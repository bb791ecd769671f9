// The chain rule of projection: from the sums of a Gaussian's slots to the gradients with respect to the parameters of
// LANES Gaussians and to the camera's lens. Equation numbers refer to docs/gradients.md, with RAYS to docs/cameras.md.
// project_grad.cl includes this file after splat.h, gaussian.h and sh.h, with RAYS also tangent.h.

// OWN_ROW: a work-item has copied its Gaussian's parameters, number of tiles and first slot. Its SH coefficients are in
// local memory, and their gradients overwrite them.
//
// Types with address space: LISTED of tile_counts and first_slots, SH_COEFFICIENT of sh_rest, SH_GRADIENT of the
// gradients of sh_rest. These are in global memory for all Gaussians, in private memory for those of a work-item, and
// in local memory for those of a group. OWN: the index of a Gaussian's row in arrays of the types PARAMETER and LISTED.
// ADDENDS_AHEAD makes a GPU load four slots of a Gaussian before it adds them up.
#ifdef OWN_ROW
#define LISTED const uint
#define SH_COEFFICIENT __local const float
#define SH_GRADIENT __local float
#define OWN(row) 0
#define ADDENDS_AHEAD _Pragma("unroll 4")
#else
#define LISTED __global const uint
#define SH_COEFFICIENT __global const float
#ifdef ADAM
#define SH_GRADIENT float
#else
#define SH_GRADIENT __global float
#endif
#define OWN(row) (row)
#define ADDENDS_AHEAD
#endif

#define SH_HIGHER 15 // the largest number of SH coefficients from degree 1 on

// The gradients of a Gaussian's SH coefficient and of its basis function, equations (39) and (40) of docs/gradients.md.
// f, d_f: the coefficient and its gradient, three channels each; d_colour: the colour's gradient; basis: the basis
// function. Returns the gradient of the basis function.
__attribute__((always_inline)) static inline float coefficient_gradient(SH_COEFFICIENT *f, float4 d_colour, float basis,
                                                                        SH_GRADIENT *d_f) {
  const float weight = fma1(d_colour.x, f[0], fma1(d_colour.y, f[1], d_colour.z * f[2]));
#ifndef NO_SH_REST // set in steps that do not update sh_rest (OptimiserConfig.sh_rest_every)
  d_f[0] = basis * d_colour.x;
  d_f[1] = basis * d_colour.y;
  d_f[2] = basis * d_colour.z;
#endif
  return weight;
}

// FOR_DEGREE loops over the SH coefficients k of a degree, unrolled, if all of them are used.
#if LANES == 1
#define FOR_DEGREE(degree, k, used)                                                                                    \
  if ((used) >= ((degree) + 1) * ((degree) + 1))                                                                       \
  UNROLL for (int k = (degree) * (degree); k < ((degree) + 1) * ((degree) + 1); ++k)
#endif

// Weights of the penalties on opacity and scales, as parameters and as arguments, each after a comma, in the order of
// `Exploration.weights` (clsplat/optimisation/step_noise.py).
#ifdef PENALTIES
#define PENALTY_PARAMETERS , const float opacity_weight, const float scale_weight
#define PENALTY_WEIGHTS , opacity_weight, scale_weight
#else
#define PENALTY_PARAMETERS
#define PENALTY_WEIGHTS
#endif

// Gradients with respect to the parameters of LANES Gaussians, except for the SH bands from degree 1 on. scale: with
// respect to the log scales; opacity: to the logit; colour: to red, green and blue, zero where the colour is clamped.
typedef struct {
  Lanes mean[3], quaternion[4], scale[3], opacity, colour[3];
} Gradients;

#ifdef REGION
#define TRAINED trained
// Sets the gradients of the Gaussians that are not `trained` (LANES) to zero.
static inline void clear_lanes(const int *trained, Gradients *d) {
  for (uint lane = 0; lane < LANES; ++lane) {
    if (trained[lane]) continue;
    FOR_AXES(k) d->mean[k].lane[lane] = d->scale[k].lane[lane] = d->colour[k].lane[lane] = 0.0f;
    for (int k = 0; k < 4; ++k) d->quaternion[k].lane[lane] = 0.0f;
    d->opacity.lane[lane] = 0.0f;
  }
}
#else
#define TRAINED shown
#endif

// Computes the gradients *d of the visible Gaussians among LANES rows from first_row on. Returns 0 if none is visible.
// Sets `shown` (LANES) to 1 for visible rows, and writes their rows of screen, contributions, by_lens and d_sh_rest.
// Row 0 of d_sh_rest belongs to first_row. Visible Gaussians outside the region (REGION) get zeros in all results.
static inline int gradients_of(const uint n, const uint first_row, const int coefficients, __constant float *camera,
                               LISTED *tile_counts, LISTED *first_slots, __global const float *slots,
                               __global const float *splats, PARAMETER *means, PARAMETER *quaternions,
                               PARAMETER *log_scales, PARAMETER *opacity_logits, __global const float *sh_rest,
                               __global float *screen,
#ifdef CONTRIBUTIONS
                               __global float *contributions,
#endif
#ifdef LENS
                               __global float *by_lens,
#endif
                               SH_GRADIENT *d_sh_rest, int *shown, Gradients *d PENALTY_PARAMETERS REGION_PARAMETERS) {
  uint row[LANES];
  for (uint lane = 0; lane < LANES; ++lane) row[lane] = OWN(first_row + lane < n ? first_row + lane : n - 1);
  const uint lanes_used = n - first_row < LANES ? n - first_row : LANES;
  Lanes m[SLOT_STRIDE];
  int any = 0;
#ifdef REGION
  int trained[LANES], frozen = 0;
#endif
  for (int field = 0; field < SLOT_STRIDE; ++field) m[field].all = (floatL)(0.0f);
  Lanes whitening[3]; // zero for invisible Gaussians, whose splats are uninitialised
  for (int k = 0; k < 3; ++k) whitening[k].all = (floatL)(0.0f);
  for (uint lane = 0; lane < LANES; ++lane) {
    const uint count = lane < lanes_used ? tile_counts[OWN(first_row + lane)] : 0;
    shown[lane] = count > 0;
#ifdef REGION
    trained[lane] = 0;
#endif
    if (count == 0) continue;
#ifdef REGION
    const size_t at = first_row + lane;
    trained[lane] = in_region(means + 3 * OWN(at) REGION_NUMBERS);
    if (!trained[lane]) {
      frozen = 1;
      for (int k = 0; k < 2; ++k) screen[2 * at + k] = 0.0f;
#ifdef CONTRIBUTIONS
      contributions[at] = 0.0f;
#endif
#ifdef LENS
      for (int k = 0; k < 4; ++k) by_lens[4 * at + k] = 0.0f;
#endif
#ifndef NO_SH_REST
      SH_GRADIENT *d_f = d_sh_rest + 3 * (coefficients - 1) * lane;
      for (int k = 0; k < 3 * (SH_USED(coefficients) - 1); ++k) d_f[k] = 0.0f;
#endif
      continue;
    }
#endif
    any = 1;
#ifdef ADDED_UP
    __global const float *slot = slots + (size_t)SLOT_STRIDE * (first_row + lane);
    const uint addends = 1;
#else
    __global const float *slot = slots + (size_t)SLOT_STRIDE * first_slots[OWN(first_row + lane)];
    const uint addends = count;
#endif
    float sums[SLOT_STRIDE];
    for (int field = 0; field < SLOT_STRIDE; ++field) sums[field] = 0.0f;
    ADDENDS_AHEAD for (uint k = 0; k < addends; ++k, slot += SLOT_STRIDE) {
      for (int field = 0; field < SLOT_STRIDE; ++field) sums[field] += slot[field];
    }
    for (int field = 0; field < SLOT_STRIDE; ++field) m[field].lane[lane] = sums[field];
    __global const float *splat = splats + (size_t)SPLAT_SIZE * (first_row + lane);
    FOR_AXES(k) { // equation (39) of docs/gradients.md: a clamped channel has no gradient
      if (!(splat[SPLAT_RED + k] > 0.0f)) m[SLOT_RED + k].lane[lane] = 0.0f;
    }
#ifndef RAYS
    whitening[0].lane[lane] = splat[SPLAT_L11];
    whitening[1].lane[lane] = splat[SPLAT_L12];
    whitening[2].lane[lane] = splat[SPLAT_L22];
#endif
  }
#ifdef REGION
  if (frozen && !any) {
    clear_lanes(trained, d);
    return 1;
  }
#endif
  if (!any) return 0;

  // Opacity, equations (29) and (41) of docs/gradients.md: the sum of g is o dL/do, and do/dlogit = o (1 - o). This
  // comes before the projection, which needs the most registers.
  d->opacity.all = m[SLOT_G].all * sigmoidL(-GATHER(opacity_logits, 1, 0)); // 1 - o, also for o close to 1
#ifdef PENALTIES
  // Equation (91) of docs/gradients.md
  const floatL opacity = sigmoidL(GATHER(opacity_logits, 1, 0));
  d->opacity.all = fmaL(opacity_weight * opacity, sigmoidL(-GATHER(opacity_logits, 1, 0)), d->opacity.all);
#endif

#ifdef RAYS
  RayProjection p;
  if (!project_ray(OWN(first_row), means, quaternions, log_scales, camera, &p)) return 0;
  whitening[0].all = WHITEN * sqrt(p.syy / p.det);
  whitening[1].all = -(p.sxy / p.syy) * whitening[0].all;
  whitening[2].all = WHITEN / sqrt(p.syy);
#else
  Projection p;
  if (!project_gaussians(row, means, quaternions, log_scales, camera, &p)) return 0;
#endif
  const floatL l11 = whitening[0].all, l12 = whitening[1].all, l22 = whitening[2].all;
  const floatL m_g = m[SLOT_G].all, m_gu = m[SLOT_GU].all, m_gv = m[SLOT_GV].all;

  Lanes d_screen[2];
#ifdef RAYS // d_mx, d_my: along e1 and e2 of the tangent plane; d_screen: per pixel at the mean
  const floatL d_mx = INVERSE_WHITEN2 * m_gu, d_my = INVERSE_WHITEN2 * m_gv;
  const float side_x = sqrt(fma1(p.t.k[0], p.t.k[0], p.t.k[1] * p.t.k[1]));
  const float side_y = sqrt(fma1(p.t.k[2], p.t.k[2], p.t.k[3] * p.t.k[3]));
#ifdef ABSOLUTE_GRADIENTS
  d_screen[0].all = side_x * (INVERSE_WHITEN2 * m[SLOT_ABSX].all);
  d_screen[1].all = side_y * (INVERSE_WHITEN2 * m[SLOT_ABSY].all);
#else
  d_screen[0].all = side_x * d_mx;
  d_screen[1].all = side_y * d_my;
#endif
#else
  // Equation (50) of docs/gradients.md: the gradient with respect to the mean's image position, -W^T (sum of g w).
  const floatL d_mx = -INVERSE_WHITEN2 * (l11 * m_gu);
  const floatL d_my = -INVERSE_WHITEN2 * fmaL(l12, m_gu, l22 * m_gv);
#ifdef ABSOLUTE_GRADIENTS
  d_screen[0].all = INVERSE_WHITEN2 * m[SLOT_ABSX].all;
  d_screen[1].all = INVERSE_WHITEN2 * m[SLOT_ABSY].all;
#else
  d_screen[0].all = d_mx;
  d_screen[1].all = d_my;
#endif
#endif

  // Equation (58) of docs/gradients.md: the whitened columns of M = J A S are (wu[k], wv[k]) times the scale s[k]. They
  // are of order one, and no large numbers are subtracted.
  const float unwhiten = INVERSE_WHITEN2 * INVERSE_WHITEN2;
#ifdef ANTIALIASED
  // Equation (84) of docs/gradients.md: the compensated opacity falls with p.det (low-pass included) and rises with
  // p.det0 (without low-pass).
  const intL compensated = p.det0 / p.det > LEAST_COMPENSATION * LEAST_COMPENSATION;
  const floatL thinner = compensated ? m_g : (floatL)(0.0f), by_det0 = compensated ? m_g / p.det0 : (floatL)(0.0f);
  const floatL uu = fmaL((floatL)(unwhiten), m[SLOT_GUU].all, -INVERSE_WHITEN2 * thinner),
               uv = unwhiten * m[SLOT_GUV].all;
  const floatL vv = fmaL((floatL)(unwhiten), m[SLOT_GVV].all, -INVERSE_WHITEN2 * thinner);
  floatL across_x = (floatL)(0.0f), across_y = across_x;
#else
  const floatL uu = unwhiten * m[SLOT_GUU].all, uv = unwhiten * m[SLOT_GUV].all, vv = unwhiten * m[SLOT_GVV].all;
#endif
  floatL wu[3], wv[3];
  const floatL lean = l11 / p.syy;
  FOR_AXES(k) {
#ifdef RAYS // as in the branch below, with the minors of M on the tangent plane, low-pass columns included
    const float inverse = 1.0f / p.distance, b1 = inverse * p.c1[k], b2 = inverse * p.c2[k];
    float minors = 0.0f;
    for (int j = 3; j < 5; ++j) minors = fma1(p.m2[j], fma1(p.m2[j], b1, -(p.m1[j] * b2)), minors);
    const int l = (k + 1) % 3, n = (k + 2) % 3;
    const float by_n = minor_of_axis(&p, camera, n), by_l = minor_of_axis(&p, camera, l);
    minors = fma1(p.m2[l], p.s[l] * by_n, fma1(-p.m2[n], p.s[n] * by_l, minors));
    wu[k] = lean * minors;
    wv[k] = l22 * b2;
#else
    const int l = (k + 1) % 3, n = (k + 2) % 3;
    const floatL minors = fmaL(p.s[l] * p.b2[l], p.s[l] * p.c[n], -(p.s[n] * p.b2[n] * (p.s[n] * p.c[l])));
    wu[k] = lean * fmaL((floatL)(LOW_PASS), p.b1[k], minors);
    wv[k] = l22 * p.b2[k];
#endif
  }

  // Equation (122) of docs/gradients.md: the gradient through nearness, 1 / depth, with respect to the depth z.
#ifndef NEARNESS
#define LESS_NEAR(z)
#else
#define LESS_NEAR(z) -m[SLOT_NEAR].all / ((z) * (z))
#endif

  // Equations (59) to (61) of docs/gradients.md: the gradients with respect to the log scales and to a rotation about
  // the Gaussian's axes, and the gradient through the Jacobian.
  floatL d_size = (floatL)(0.0f), along_u = d_size, along_v = d_size, turned[3];
#ifdef LENS
  Lanes lens[4];
  lens[0].all = lens[1].all = d_size;
#endif
  FOR_AXES(k) {
    const int l = (k + 1) % 3, n = (k + 2) % 3;
    const floatL nu = p.s[k] * wu[k], nv = p.s[k] * wv[k];
    const floatL tu = fmaL(uu, nu, uv * nv), tv = fmaL(uv, nu, vv * nv);
    d->scale[k].all = fmaL(nu, tu, nv * tv);
#ifdef ANTIALIASED
#ifdef RAYS
    const float c[3] = {minor_of_axis(&p, camera, k), minor_of_axis(&p, camera, l), minor_of_axis(&p, camera, n)};
#else
    const floatL c[3] = {p.c[k], p.c[l], p.c[n]};
#endif
    const floatL area = p.s[l] * p.s[n], minor = area * c[0]; // equations (85) to (87) of docs/gradients.md
    const floatL other_l = p.s[n] * p.s[k] * c[1], other_n = p.s[k] * p.s[l] * c[2];
    d->scale[k].all = fmaL(by_det0, fmaL(other_l, other_l, other_n * other_n), d->scale[k].all);
    const floatL lever = by_det0 * minor * area;
#ifdef RAYS // (29) of docs/cameras.md: the minors are the axes' components along the mean's direction
    const float turned_by = camera[CAMERA_HAND] / (p.distance * p.distance);
    across_x = fma1(lever, turned_by * p.c1[k], across_x);
    across_y = fma1(lever, turned_by * p.c2[k], across_y);
#else
    across_x = fmaL(lever, fmaL(p.jx * p.rx, p.a2[k], p.b1[k]), across_x);
    across_y = fmaL(lever, fmaL(p.jy * p.ry, p.a2[k], p.b2[k]), across_y);
#endif
#endif
    d_size += d->scale[k].all;
#ifdef RAYS
    const floatL depth = p.s[k] * depth_of_axis(&p, k);
#else
    const floatL depth = p.s[k] * p.a2[k];
#endif
    along_u = fmaL(tu, depth, along_u);
    along_v = fmaL(tv, depth, along_v);
#ifdef LENS // equation (144) of docs/gradients.md: a focal length is a factor of a row of M
    lens[0].all = fmaL(l11 * tu, p.s[k] * p.b1[k], lens[0].all);
    lens[1].all = fmaL(fmaL(l12, tu, l22 * tv), p.s[k] * p.b2[k], lens[1].all);
#endif
    const floatL apart = scale_difference(GATHER(log_scales, 3, l) - GATHER(log_scales, 3, n), p.s[l], p.s[n]);
    const floatL au = apart * wu[l], av = apart * wv[l], sum = p.s[l] + p.s[n];
    turned[k] = fmaL(fmaL(uu, au, uv * av), sum * wu[n], fmaL(uv, au, vv * av) * (sum * wv[n]));
#ifdef ANTIALIASED
    turned[k] = fmaL(-(by_det0 * p.s[k] * c[1]), apart * sum * (p.s[k] * c[2]), turned[k]);
#endif
  }
#ifdef PENALTIES
  FOR_AXES(k) d->scale[k].all = fmaL((floatL)(scale_weight), p.s[k], d->scale[k].all);
#endif
  const floatL w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
  const floatL turn = 2.0f / p.length;
  d->quaternion[0].all = turn * -fmaL(x, turned[0], fmaL(y, turned[1], z * turned[2]));
  d->quaternion[1].all = turn * fmaL(w, turned[0], fmaL(y, turned[2], -(z * turned[1])));
  d->quaternion[2].all = turn * fmaL(w, turned[1], fmaL(z, turned[0], -(x * turned[2])));
  d->quaternion[3].all = turn * fmaL(w, turned[2], fmaL(x, turned[1], -(y * turned[0])));

#ifdef RAYS                                               // (22) to (28) of docs/cameras.md
  const float half_u = 0.5f * l11, half_uu = half_u * uu; // G = W^T (sum of g w w^T) W / 2
  const float turned_v = fma1(l12, uu, l22 * uv);
  const float by_covariance[3] = {half_uu * l11, half_u * turned_v,
                                  0.5f * fma1(l12, turned_v, l22 * fma1(l12, uv, l22 * vv))};
  float by_low_pass[2];
  low_pass_gradient(p.f, camera, by_covariance, by_low_pass);
#ifdef ANTIALIASED
  by_low_pass[0] += across_x;
  by_low_pass[1] += across_y;
#endif
  const float turn_x = (d_mx + by_low_pass[0] - l11 * along_u / p.distance) / p.distance;
  const float turn_y = (d_my + by_low_pass[1] - fma1(l12, along_u, l22 * along_v) / p.distance) / p.distance;
  const float shrink = d_size / p.distance - (0.0f LESS_NEAR(p.distance));
  const float d_x = fma1(turn_x, p.t.e1[0], fma1(turn_y, p.t.e2[0], -(shrink * p.f[0])));
  const float d_y = fma1(turn_x, p.t.e1[1], fma1(turn_y, p.t.e2[1], -(shrink * p.f[1])));
  const float d_z = fma1(turn_x, p.t.e1[2], fma1(turn_y, p.t.e2[2], -(shrink * p.f[2])));
#else
#ifdef ANTIALIASED
  const float hand = camera[CAMERA_HAND];
  const floatL by_j02 = fmaL(l11, along_u, -(hand * (p.jy / p.jx) * across_x));
  const floatL by_j12 = fmaL(l12, along_u, fmaL(l22, along_v, -(hand * (p.jx / p.jy) * across_y)));
#else
  const floatL by_j02 = l11 * along_u, by_j12 = fmaL(l12, along_u, l22 * along_v);
#endif
  const floatL at[3] = {p.x, p.y, p.z}, limited[2] = {p.rx, p.ry};
  floatL by_mean[3], beyond[2];
  mean_gradient(at, limited, p.jx, p.jy, d_mx, d_my, by_j02, by_j12, d_size, by_mean, beyond);
  const floatL d_x = by_mean[0], d_y = by_mean[1], d_z = by_mean[2] LESS_NEAR(p.z);
#endif

#ifdef LENS
#ifdef ANTIALIASED
  lens[0].all += compensated ? m_g : (floatL)(0.0f);
  lens[1].all += compensated ? m_g : (floatL)(0.0f);
#endif
  // Equation (145) of docs/gradients.md
  lens[0].all = fmaL(p.jx * p.x, d_mx, fmaL(p.jx * p.z * p.rx, beyond[0], lens[0].all));
  lens[1].all = fmaL(p.jy * p.y, d_my, fmaL(p.jy * p.z * p.ry, beyond[1], lens[1].all));
  lens[2].all = d_mx + beyond[0];
  lens[3].all = d_my + beyond[1];
#endif

  // Colour, equations (38) to (40) of docs/gradients.md: a clamped channel has no gradient. The SH basis depends on the
  // mean through the view direction; the gradient through the direction is omitted if it overflows for very large SH
  // coefficients.
  floatL vx = FROM_CAMERA(means, X, 0), vy = FROM_CAMERA(means, Y, 1), vz = FROM_CAMERA(means, Z, 2);
  const floatL length = sqrt(fmaL(vx, vx, fmaL(vy, vy, vz * vz)));
  vx = (floatL)(SEEN_ALONG(vx, length, camera[CAMERA_R20]));
  vy = (floatL)(SEEN_ALONG(vy, length, camera[CAMERA_R21]));
  vz = (floatL)(SEEN_ALONG(vz, length, camera[CAMERA_R22]));
  Lanes basis[16], weight[16];
  sh_basis(SH_USED(coefficients), vx, vy, vz, &basis[0].all);
  for (uint lane = 0; lane < lanes_used; ++lane) {
    const size_t i = first_row + lane;
    if (!TRAINED[lane]) continue;
    const float4 d_colour = (float4)(m[SLOT_RED].lane[lane], m[SLOT_GREEN].lane[lane], m[SLOT_BLUE].lane[lane], 0.0f);
    d->colour[0].lane[lane] = d_colour.x;
    d->colour[1].lane[lane] = d_colour.y;
    d->colour[2].lane[lane] = d_colour.z;
    SH_GRADIENT *d_f = d_sh_rest + 3 * (coefficients - 1) * lane;
#ifdef OWN_ROW
    SH_COEFFICIENT *f = d_f;
#else
    SH_COEFFICIENT *f = sh_rest + (size_t)3 * (coefficients - 1) * i;
#endif
#define COEFFICIENT(k)                                                                                                 \
  weight[k].lane[lane] = coefficient_gradient(f, d_colour, basis[k].lane[lane], d_f), f += 3, d_f += 3
#if LANES == 1 // a branch for each degree, unrolled
    FOR_DEGREE(1, k, SH_USED(coefficients)) COEFFICIENT(k);
    FOR_DEGREE(2, k, SH_USED(coefficients)) COEFFICIENT(k);
    FOR_DEGREE(3, k, SH_USED(coefficients)) COEFFICIENT(k);
#else
    for (int k = 1; k < SH_USED(coefficients); ++k) COEFFICIENT(k);
#endif
  }
  floatL d_v[3];
  sh_direction_gradient(SH_USED(coefficients), vx, vy, vz, &weight[0].all, d_v);
  const floatL along = d_v[0] * vx + d_v[1] * vy + d_v[2] * vz;
  FOR_AXES(k) {
    const floatL v = k == 0 ? vx : (k == 1 ? vy : vz);
    const floatL by_colour = (floatL)(BY_DIRECTION(d_v[k] - along * v, length));
    const floatL above = by_colour < 1e37f ? by_colour : (floatL)(0.0f);
    d->mean[k].all = camera[CAMERA_R00 + k] * d_x + camera[CAMERA_R10 + k] * d_y + camera[CAMERA_R20 + k] * d_z +
                     (by_colour > -1e37f ? above : (floatL)(0.0f));
  }

  for (uint lane = 0; lane < lanes_used; ++lane) {
    const size_t i = first_row + lane;
    if (!TRAINED[lane]) continue;
    for (int k = 0; k < 2; ++k) screen[2 * i + k] = d_screen[k].lane[lane];
#ifdef CONTRIBUTIONS
    contributions[i] = m[SLOT_WEIGHT].lane[lane];
#endif
#ifdef LENS
    for (int k = 0; k < 4; ++k) by_lens[4 * i + k] = lens[k].lane[lane];
#endif
  }
#ifdef REGION
  if (frozen) clear_lanes(trained, d);
#endif
  return 1;
}

// A pair's sums over pixels in blend_grad.cl: the fields of its slot, in the whitened units of equation (49) of
// docs/gradients.md.
#ifdef RAYS
// Adds a pixel to the sums along rays: SLOT_GU and SLOT_GV get the gradient with respect to the mean on its tangent
// plane. This gradient is not linear in (u, v), because the plane turns with the mean: equation (21) of
// docs/cameras.md.
static inline void add_ray_moments(floatL g, floatL u, floatL v, float l11, float l12, float l22, floatL *sums) {
  const floatL q = fmaL(u, u, v * v);
  const floatL y = v / l22, x = fmaL((floatL)(-l12), y, u) / l11;
  const floatL by_x = g * fmaL(q, x, l11 * u), by_y = g * fmaL(q, y, fmaL((floatL)(l12), u, l22 * v));
  add_moments_by(g, u, v, by_x, by_y, sums);
#ifdef ABSOLUTE_GRADIENTS
  sums[SLOT_ABSX] += fabs(by_x);
  sums[SLOT_ABSY] += fabs(by_y);
#endif
}
#endif

// Adds the gradients of one vector of pixels to a pair's sums (SLOT_STRIDE). place: the vector's index among the cells.
#define IN_PLACE(cells, place) (((const floatS *)(cells))[place])
static inline void add_gradients(floatS *sums, const Pixels *p, uint place, floatS g, floatS weight, floatS u, floatS v,
                                 float l11, float l12, float l22) {
  sums[SLOT_RED] = fmaS(weight, IN_PLACE(p->red, place), sums[SLOT_RED]);
  sums[SLOT_GREEN] = fmaS(weight, IN_PLACE(p->green, place), sums[SLOT_GREEN]);
  sums[SLOT_BLUE] = fmaS(weight, IN_PLACE(p->blue, place), sums[SLOT_BLUE]);
#ifdef RAYS
  add_ray_moments(g, u, v, l11, l12, l22, sums);
#else
  add_moments(g, u, v, sums);
#ifdef ABSOLUTE_GRADIENTS
  sums[SLOT_ABSX] += fabs(g * (l11 * u));
  sums[SLOT_ABSY] += fabs(g * fmaS((floatS)(l12), u, l22 * v));
#endif
#endif
#ifdef CONTRIBUTIONS
  sums[SLOT_WEIGHT] += weight;
#endif
#ifdef NEARNESS
  sums[SLOT_NEAR] = fmaS(weight, IN_PLACE(p->near, place), sums[SLOT_NEAR]);
#endif
}

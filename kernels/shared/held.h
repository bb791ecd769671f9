// Holdout: surfaces of CG elements in each pixel. Each surface transmits a fraction of the light from behind it.
//
// held_starts (pixels of a plane + 1): the index of each pixel's first surface, then the number of all surfaces.
// held_surfaces (surfaces, HELD_SIZE): the depths of front and back, the transmitted fraction, and log2 of this
// fraction divided by the thickness. Each pixel's surfaces are sorted by the depth of their fronts. Equation (75)
// of docs/pictures.md.
#ifdef HOLDOUT
// State of a cell while depth increases. at: the index of the pixel's first surface whose back has not been passed;
// through: the transmittance of all surfaces before `at`; next: the depth of the front of surface `at`; end: one more
// than the index of the pixel's last surface.
typedef struct {
  Lanes through, next;
  uint at[LANES], end[LANES];
} Held;

static inline Held held_of(__global const uint *starts, __global const float *surfaces, size_t stride) {
  Held held;
  held.through.all = (floatL)(1.0f);
  for (int lane = 0; lane < LANES; ++lane) {
    const size_t pixel = LANE_IN_PLANE(lane);
    held.at[lane] = starts[pixel];
    held.end[lane] = starts[pixel + 1];
    held.next.lane[lane] = held.at[lane] < held.end[lane] ? surfaces[HELD_SIZE * held.at[lane] + HELD_Z] : INFINITY;
  }
  return held;
}

// The fraction of light from `depth` that passes the surfaces in front of it. From call to call, depths must not
// decrease.
static inline floatL let_through(float depth, Held *held, __global const float *surfaces) {
  if (!ANYL(MASKL(held->next.all <= (floatL)(depth)))) return held->through.all;
  Lanes within; // log2 of the transmittance, up to `depth`, of surfaces that extend beyond `depth`
  Lanes through;
  for (int lane = 0; lane < LANES; ++lane) {
    uint k = held->at[lane];
    const uint end = held->end[lane];
    float left = held->through.lane[lane], power = 0.0f;
    for (; k < end && surfaces[HELD_SIZE * k + HELD_BACK] <= depth; ++k) left *= surfaces[HELD_SIZE * k + HELD_KEEP];
    held->at[lane] = k;
    held->through.lane[lane] = left;
    held->next.lane[lane] = k < end ? surfaces[HELD_SIZE * k + HELD_Z] : INFINITY;
    for (; k < end && surfaces[HELD_SIZE * k + HELD_Z] <= depth; ++k) {
      __global const float *surface = surfaces + HELD_SIZE * k;
      if (surface[HELD_BACK] <= depth) left *= surface[HELD_KEEP];
      else power = fma1(surface[HELD_RATE], depth - surface[HELD_Z], power);
    }
    through.lane[lane] = left;
    within.lane[lane] = power > -126.0f ? power : -126.0f;
  }
  return through.all * exp2L(within.all);
}
#define HELD_PARAMETERS , __global const uint *held_starts, __global const float *held_surfaces
#else
#define HELD_PARAMETERS
#endif

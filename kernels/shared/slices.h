// The division of a pixel's light into slices by depth, (73) and (74) of docs/pictures.md.
#define STEPS 8                          // two walks over the list search the slack, coarse then fine, in 8 steps each
#define TRIED (STEPS - 1)                // slacks tried in a walk
#define WALKS 3                          // the last walk makes the slices
#define FIRST_STEP (DEEP_LEVELS / STEPS) // in levels; STEPS * STEPS is DEEP_LEVELS

// (73): advances a slice past a Gaussian that reduces the light from `before` to `after`. open: the light at the
// slice's start; after its depth is fixed, minus the light behind the Gaussian at this depth. may_begin: lanes of
// `taken` in which a slice may begin. Returns the lanes in which a slice begins.
static inline intL begins_slice(floatL *open, floatL before, floatL after, floatL slack, intL taken, intL may_begin) {
  const intL placed = taken & MASKL(*open - before > slack);
  const floatL now = placed ? -before : *open;
  const intL begins = may_begin & MASKL(now < 0.0f) & MASKL(-now - after > slack);
  *open = begins ? before : now;
  return begins;
}

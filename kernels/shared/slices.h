// Divides a pixel's light into slices by depth, for deep pictures: equations (73) and (74) of docs/pictures.md. A slice
// begins where the error of the transmittance would exceed a limit, the slack. Two walks over the list of Gaussians
// search for the least slack that gives few enough slices: first coarse, then fine. A third walk makes the slices.
#define STEPS 8                          // number of steps that divide the slack in each of the two searches
#define TRIED (STEPS - 1)                // number of slacks tried in a walk
#define WALKS 3                          // number of walks over the list
#define FIRST_STEP (DEEP_LEVELS / STEPS) // coarse step of the slack, in levels; STEPS * STEPS is DEEP_LEVELS

// Advances the current slice past a Gaussian that reduces the light from `before` to `after`, equation (73) of
// docs/pictures.md. Light means the transmittance. *open is the light at the slice's start as long as the slice's depth
// is not known; afterwards it is minus the light behind the Gaussian whose depth the slice has. slack: the largest
// error; taken: the lanes that the Gaussian reaches; may_begin: the lanes in `taken` in which a new slice may begin.
// Returns the lanes in which a slice begins.
static inline intL begins_slice(floatL *open, floatL before, floatL after, floatL slack, intL taken, intL may_begin) {
  const intL placed = taken & MASKL(*open - before > slack);
  const floatL now = placed ? -before : *open;
  const intL begins = may_begin & MASKL(now < 0.0f) & MASKL(-now - after > slack);
  *open = begins ? before : now;
  return begins;
}

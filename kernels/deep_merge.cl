// Merges several deep pictures of the same size with weights. The pictures are the samples of a shutter or lens, or the
// source pixels of a warp. At every depth the transmittance is the weighted mean of the pictures' transmittances.
//
// Owner: A work-item owns a pixel.
// Launch: One work-item for each pixel.
// Buffers: share: 1 / (DEEP_LEVELS * bins), the unit of the slack (shared/slices.h) in a pixel of alpha 1.
//   lists (pictures, bins, DEEP_SIZE, pixels): laid out like the planes of deep.cl.
//   weights (pictures, pixels): their sum over the pictures is 1.
//   -> sources (pictures * bins, pixels): the picture of each slice, front to back.
//   left (pictures * bins, pixels): the transmittance behind each of these slices.
//   planes (bins, DEEP_SIZE, pixels): laid out like the planes of deep.cl.
// Equations: docs/pictures.md, (73), (74) and (187).
#include "shared/math.h"
#include "shared/lanes.h"
#include "shared/slices.h"

// Writes the slice in which the transmittance falls from `first` to `after`, and sets `colour` to zero for the next
// slice. to: the slice's address in the planes; plane: the distance of planes in floats.
static inline void write_slice(__global float *to, size_t plane, float *colour, float first, float after, float depth) {
  for (int channel = 0; channel < 3; ++channel) {
    to[plane * (DEEP_RED + channel)] = colour[channel] / first;
    colour[channel] = 0.0f;
  }
  to[plane * DEEP_ALPHA] = 1.0f - after / first;
  to[plane * DEEP_DEPTH] = depth;
}

__kernel void deep_merge(const int pixels, const int pictures, const int bins, const float share,
                         __global const float *lists, __global const float *weights, __global uchar *sources,
                         __global float *left, __global float *planes) {
  const size_t pixel = get_global_id(0), plane = pixels;
  if (pixel >= plane) return;
  const size_t slice = DEEP_SIZE * plane, picture = slice * bins;
  lists += pixel;
  planes += pixel;
  int next[DEEP_PICTURES];
  float depth[DEEP_PICTURES], t[DEEP_PICTURES];
  float whole = 0.0f;
  for (int p = 0; p < pictures; ++p) {
    next[p] = 0;
    t[p] = weights[plane * p + pixel];
    whole += t[p];
    const bool any = lists[picture * p + plane * DEEP_ALPHA] > 0.0f;
    depth[p] = any ? lists[picture * p + plane * DEEP_DEPTH] : INFINITY;
  }

  int events = 0, told = 0;
  float after = whole, last = INFINITY;
  for (; events < pictures * bins; ++events) {
    int p = 0;
    for (int other = 1; other < pictures; ++other) p = depth[other] < depth[p] ? other : p;
    if (depth[p] == INFINITY) break;
    if (depth[p] > last) // slices of equal depth count as one: `left` has the same transmittance for all of them
      for (; told < events; ++told) left[plane * told + pixel] = after;
    last = depth[p];
    __global const float *at = lists + picture * p + slice * next[p];
    t[p] = fma1(-t[p], at[plane * DEEP_ALPHA], t[p]);
    after = 0.0f; // summed anew for each slice: a running sum would lose small remainders
    for (int each = 0; each < pictures; ++each) after += t[each];
    sources[plane * events + pixel] = (uchar)p;
    const bool more = ++next[p] < bins && at[slice + plane * DEEP_ALPHA] > 0.0f;
    depth[p] = more ? at[slice + plane * DEEP_DEPTH] : INFINITY;
  }
  for (; told < events; ++told) left[plane * told + pixel] = after;

  const float unit = (whole - after) * share;
  float level = 0.0f;
  for (int walk = 0, step = FIRST_STEP; walk < WALKS - 1; ++walk, step /= STEPS) {
    float open[TRIED], before = whole;
    int counts[TRIED];
    for (int k = 0; k < TRIED; ++k) {
      open[k] = whole;
      counts[k] = 1;
    }
    for (int event = 0; event < events; ++event) {
      const float behind = left[plane * event + pixel];
      for (int k = 0; k < TRIED; ++k)
        counts[k] -= begins_slice(open + k, before, behind, unit * (level + (float)(step * (k + 1))), -1, -1);
      before = behind;
    }
    for (int k = 0; k < TRIED; ++k) level += counts[k] > bins ? (float)step : 0.0f;
  }

  for (int p = 0; p < pictures; ++p) {
    next[p] = 0;
    t[p] = weights[plane * p + pixel];
  }
  float open = whole, before = whole, first = whole, place = 0.0f, colour[3] = {0.0f, 0.0f, 0.0f};
  int slices = 0;
  for (int event = 0; event < events; ++event) {
    const int p = sources[plane * event + pixel];
    __global const float *at = lists + picture * p + slice * next[p]++;
    const float behind = left[plane * event + pixel];
    if (begins_slice(&open, before, behind, unit * (level + 1.0f), -1, MASKL(slices < bins - 1))) {
      write_slice(planes + slice * slices++, plane, colour, first, before, place);
      first = before;
    }
    place = open > 0.0f ? at[plane * DEEP_DEPTH] : place;
    before = behind;
    for (int channel = 0; channel < 3; ++channel)
      colour[channel] = fma1(t[p], at[plane * (DEEP_RED + channel)], colour[channel]);
    t[p] = fma1(-t[p], at[plane * DEEP_ALPHA], t[p]);
  }
  if (before < first) write_slice(planes + slice * slices++, plane, colour, first, before, place);
  for (; slices < bins; ++slices)
    for (int field = 0; field < DEEP_SIZE; ++field) planes[slice * slices + plane * field] = 0.0f;
}

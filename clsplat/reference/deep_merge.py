# SPDX-License-Identifier: Apache-2.0
"""The weighted mean of several deep pictures: float64 twin of kernels/deep_merge.cl.

Equation numbers refer to docs/pictures.md.
"""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64
from clsplat.reference.blend import Layer
from clsplat.reference.deep import Deep, sliced


def deep_merge(pictures: Float64, weights: Float64) -> Deep:
    """Return the weighted mean of deep pictures, cut into slices again: eqs. (187), (73) and (74).

    pictures: (P, bins, H, W, 5), the slices of P pictures as in `Deep.slices`.
    weights: (P, H, W), weight of each picture in each pixel.
    """
    count, bins, height, width, _ = pictures.shape
    whole = weights.sum(axis=0)
    depths = np.where(pictures[..., 3] > 0, pictures[..., 4], np.inf).reshape(count * bins, height, width)
    everywhere, undecided = (slice(0, height), slice(0, width)), np.full((height, width), np.inf)
    rows, columns = np.mgrid[:height, :width]
    left = weights.copy()
    order = np.argsort(depths, axis=0, kind="stable")
    depths = np.take_along_axis(depths, order, axis=0)
    there = depths < np.inf
    behind, colours = np.empty((len(order) + 1, height, width)), np.empty((*depths.shape, 3))
    behind[0] = whole
    for at, event in enumerate(order):
        picture, index = np.divmod(event, bins)
        values, light = pictures[picture, index, rows, columns], left[picture, rows, columns]
        left[picture, rows, columns] = np.where(there[at], light * (1 - values[..., 3]), light)
        behind[at + 1], colours[at] = left.sum(axis=0), light[:, :, None] * values[..., :3]
    before, after = behind[:-1].copy(), behind[1:]
    for at in range(len(order) - 1, 0, -1):  # merges slices of equal depth
        again = there[at] & (depths[at] == depths[at - 1])
        after[at - 1] = np.where(again, after[at], after[at - 1])
        colours[at - 1] += np.where(again[:, :, None], colours[at], 0)
        there[at] &= ~again
    taken = [
        Layer(at, at, everywhere, np.empty(0), before[at], after[at], there[at], undecided) for at in range(len(order))
    ]
    return sliced(taken, list(colours), list(depths), whole, bins)

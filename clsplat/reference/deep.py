# SPDX-License-Identifier: Apache-2.0
"""Deep pictures, whose pixels are slices by depth: float64 twin of kernels/deep.cl.

Equation numbers refer to docs/pictures.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.layouts.columns import DEEP_LEVELS
from clsplat.reference.blend import Layer, layers
from clsplat.reference.project import ProjectedTwin

SLACKS_PER_WALK = 8
"""A pixel's `Deep.slack` is found by two searches: a coarse one in this many intervals, then a fine one in this many
parts of one interval."""


@dataclass(frozen=True, eq=False)
class Deep:
    """A deep picture.

    slices: (bins, H, W, 5), red, green, blue, alpha and depth of each slice: eqs. (70) to (72).
    slack: (H, W), the most by which a pixel's transmittance may deviate from that of the Gaussians: s of eq. (74).
    margin: (H, W), the smallest distance of a transmittance from the threshold that it is compared with.
    """

    slices: Float64
    slack: Float64
    margin: Float64


class _Cut:
    """Divides each pixel's layers, from front to back, into slices: equation (73) of docs/pictures.md.

    slack: (H, W), the slack s of each pixel.
    whole: (H, W), transmittance in front of the first layer.
    open: (H, W), transmittance in front of the current slice.
    placed: (H, W), True if the depth of the current slice is fixed.
    count: (H, W), number of slices.
    margin: (H, W), as in `Deep`.
    """

    def __init__(self, slack: Float64, whole: Float64) -> None:
        self.slack, self.count = slack, np.ones(slack.shape, np.int64)
        self.open, self.placed = whole.copy(), np.zeros(slack.shape, np.bool_)
        self.margin = np.full(slack.shape, np.inf)

    def begins(self, layer: Layer, may: NDArray[np.bool_] | bool = True) -> NDArray[np.bool_]:
        """Add a layer. Returns True for the pixels of its box in which the layer begins a new slice.

        may: mask of the pixels of the box in which a slice may begin.
        """
        box = layer.box
        opened, placed, slack, added = self.open[box], self.placed[box], self.slack[box], layer.added
        in_front = opened - layer.before - slack
        margin = np.where(added & ~placed, np.abs(in_front), np.inf)
        turns = added & ~placed & (in_front > 0)
        placed, opened = placed | turns, np.where(turns, layer.before, opened)
        behind = opened - layer.after - slack
        margin = np.minimum(margin, np.where(added & placed, np.abs(behind), np.inf))
        begins = added & placed & (behind > 0) & may
        self.margin[box] = np.minimum(self.margin[box], margin)
        self.open[box] = np.where(begins, layer.before, opened)
        self.placed[box] = placed & ~begins
        self.count[box] += begins
        return np.asarray(begins, np.bool_)


def slacks(taken: Sequence[Layer], whole: Float64, total: Float64, bins: int) -> tuple[Float64, Float64]:
    """Return the slack (H, W) of each pixel, and the margin (H, W), as in `Deep`: eq. (74).

    The slack is the smallest of DEEP_LEVELS values with which the pixel has at most `bins` slices.

    taken: the layers, front to back.
    whole: (H, W), transmittance in front of the layers.
    total: (H, W), transmittance that the layers take away.
    """
    unit, level, margin = total / (DEEP_LEVELS * bins), np.zeros(total.shape), np.full(total.shape, np.inf)
    for step in (DEEP_LEVELS // SLACKS_PER_WALK, 1):
        cuts = [_Cut(unit * (level + step * k), whole) for k in range(1, SLACKS_PER_WALK)]
        for layer in taken:
            for cut in cuts:
                cut.begins(layer)
        for cut in cuts:
            margin = np.minimum(margin, cut.margin)
            level = level + step * (cut.count > bins)
    return unit * (level + 1), margin


def sliced(
    taken: Sequence[Layer], colours: Sequence[Float64], depths: Sequence[Float64], whole: Float64, bins: int
) -> Deep:
    """Divide each pixel's layers into slices: eqs. (70) to (74).

    taken: the layers, front to back.
    colours: for each layer, its colour times its blending weight, on its box (h, w, 3).
    depths: for each layer, its depth on its box (h, w).
    whole: (H, W), transmittance in front of all layers.
    bins: maximum number of slices per pixel.
    """
    height, width = whole.shape
    end = whole.copy()
    for layer in taken:
        end[layer.box] = np.where(layer.added, layer.after, end[layer.box])
    slack, margin = slacks(taken, whole, whole - end, bins)
    slices, cut = np.zeros((bins, height, width, 5)), _Cut(slack, whole)
    first, places, at = whole.copy(), np.zeros((height, width)), np.mgrid[:height, :width]
    for layer, colour, depth in zip(taken, colours, depths, strict=True):
        box, added = layer.box, layer.added
        begins = cut.begins(layer, (cut.count[box] < bins) & (depth > places[box]))
        light = first[box] = np.where(begins, layer.before, first[box])
        here = (cut.count[box] - 1, *at[(slice(None), *box)])
        slices[(*here, slice(3))] += np.where(added[:, :, None], colour / light[:, :, None], 0.0)
        slices[(*here, 3)] = np.where(added, 1 - layer.after / light, slices[(*here, 3)])
        places[box] = np.where(added & ~cut.placed[box], depth, places[box])
        slices[(*here, 4)] = np.where(added, places[box], slices[(*here, 4)])
    return Deep(slices, slack, np.minimum(margin, cut.margin))


def deep(projected: ProjectedTwin, width: int, height: int, bins: int) -> Deep:
    """Return the deep picture of a frame, with at most `bins` slices per pixel."""
    taken = list(layers(projected, width, height))
    colours = [(layer.before * layer.alpha)[:, :, None] * projected.colors[layer.gaussian] for layer in taken]
    depths = [np.full(layer.alpha.shape, np.float64(np.float32(projected.depths[layer.gaussian]))) for layer in taken]
    return sliced(taken, colours, depths, np.ones((height, width)), bins)

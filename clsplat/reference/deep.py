# SPDX-License-Identifier: Apache-2.0
"""A frame in slices by depth in float64: twin of kernels/deep.cl. Equation numbers are those of docs/pictures.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.reference.blend import Layer, layers
from clsplat.reference.project import Projected

LEVELS, STEPS = 64, 8
"""Slacks that a pixel may have, and in how many steps a walk tries them."""


@dataclass(frozen=True, eq=False)
class Deep:
    """slices (bins, H, W, 5) by (70) to (72): red, green, blue, alpha, depth; slack (H, W) of each pixel, (74); margin
    (H, W): the least distance of a decision to its threshold, of transmittances that are compared."""

    slices: Float64
    slack: Float64
    margin: Float64


class _Cut:
    """The walk of (73) with one slack for each pixel."""

    def __init__(self, slack: Float64) -> None:
        self.slack, self.count = slack, np.ones(slack.shape, np.int64)
        self.open, self.placed = np.ones(slack.shape), np.zeros(slack.shape, np.bool_)
        self.margin = np.full(slack.shape, np.inf)

    def begins(self, layer: Layer, may: NDArray[np.bool_] | bool = True) -> NDArray[np.bool_]:
        """True where the layer begins a slice; may: where it is allowed to."""
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


def slacks(taken: Sequence[Layer], total: Float64, bins: int) -> tuple[Float64, Float64]:
    """(74): (H, W), the least of LEVELS slacks with which no pixel has more slices than `bins`; and the margin."""
    unit, level, margin = total / (LEVELS * bins), np.zeros(total.shape), np.full(total.shape, np.inf)
    for step in (LEVELS // STEPS, 1):
        cuts = [_Cut(unit * (level + step * k)) for k in range(1, STEPS)]
        for layer in taken:
            for cut in cuts:
                cut.begins(layer)
        for cut in cuts:
            margin = np.minimum(margin, cut.margin)
            level = level + step * (cut.count > bins)
    return unit * (level + 1), margin


def deep(projected: Projected, width: int, height: int, bins: int) -> Deep:
    """The frame in slices by depth."""
    taken = list(layers(projected, width, height))
    total = np.zeros((height, width))
    for layer in taken:
        total[layer.box] = np.where(layer.added, 1 - layer.after, total[layer.box])
    slack, margin = slacks(taken, total, bins)
    slices, cut = np.zeros((bins, height, width, 5)), _Cut(slack)
    left, depths, at = np.ones((height, width)), np.zeros((height, width)), np.mgrid[:height, :width]
    for layer in taken:
        box, added, depth = layer.box, layer.added, np.float64(np.float32(projected.depths[layer.gaussian]))
        begins = cut.begins(layer, (cut.count[box] < bins) & (depth > depths[box]))
        u = left[box] = np.where(begins, 1.0, left[box])
        here = (cut.count[box] - 1, *at[(slice(None), *box)])
        weight = np.where(added, u * layer.alpha, 0.0)
        slices[(*here, slice(3))] += weight[:, :, None] * projected.colors[layer.gaussian]
        left[box] = np.where(added, u * (1 - layer.alpha), u)
        slices[(*here, 3)] = 1 - left[box]
        depths[box] = np.where(added & ~cut.placed[box], depth, depths[box])
        slices[(*here, 4)] = np.where(added, depths[box], slices[(*here, 4)])
    return Deep(slices, slack, np.minimum(margin, cut.margin))

# SPDX-License-Identifier: Apache-2.0
"""Thresholds by which density control clones, splits and prunes Gaussians, as float32 for comparisons on the device.

Their values are settings: `DensityConfig` in `config/training.py`. Steps and opacity resets:
`training/density/adaptive.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from clsplat.arrays import Float32
from clsplat.optimisation.trained_region import TrainedRegion

FRESH = np.uint32(1 << 31)
"""Bit of an entry in a list of a model's rows. It marks the row as a new Gaussian, whose moments start at zero."""
UNWANTED, USELESS, FROZEN = -1.0, -2.0, -3.0
"""Scores that mark Gaussians: never densify (UNWANTED); prune, because they contribute too little (USELESS); neither
densify nor prune, because they are outside the region of the training (FROZEN)."""


@dataclass(frozen=True)
class MarkRules:
    """Thresholds by which Gaussians are densified or pruned, each computed with `edge`. No Gaussian meets the defaults.

    A Gaussian is densified if its mean gradient norm is over `gradient` and it passes `cut_off`. It is split if the log
    of its largest scale is over `large`, otherwise cloned.

    A Gaussian is pruned in any of these cases:

    - Its opacity logit is at most `transparent`.
    - The log of its largest scale is over `oversized`; of a half of a split Gaussian, over `oversized_half`.
    - It is not new and its radius on an image, in pixels, is over `radius`.
    - It contributes at most `contribution` to every view.

    cut_off: (value, row). A Gaussian passes if its score is over `value`, or equals `value` and its
        row is at most `row`.
    region: the region in which the rules hold, in the coordinates of the means; None for everywhere. Gaussians outside
        it stay as they are.
    """

    gradient: float = inf
    cut_off: tuple[float, int] = (-inf, 0)
    large: float = inf
    transparent: float = -inf
    oversized: float = inf
    oversized_half: float = inf
    radius: float = inf
    contribution: float = -inf
    region: TrainedRegion | None = None


def edge(holds: Callable[[Float32], Any]) -> float:
    """The largest float32 x for which holds(x) is false. So x > edge is the same as holds(x).

    `holds` must be false for small numbers and true for large numbers. The result is -inf if `holds` is
    true for all numbers, and inf if it is false for all.
    """
    low, high = _ordered(-inf), _ordered(inf)
    with np.errstate(over="ignore", under="ignore"):
        if holds(_number(low))[0]:
            return -inf
        if not holds(_number(high))[0]:
            return inf
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if holds(_number(middle))[0] else (middle, high)
    return float(_number(low)[0])


def _ordered(value: float) -> int:
    """Position of a float32 number in the order of all float32 numbers. The number 0 has position 0."""
    bits = int(np.float32(value).view(np.uint32))
    return -(bits & 0x7FFFFFFF) if bits >> 31 else bits


def _number(order: int) -> Float32:
    """Return the float32 at position `order` among all float32 numbers, counted from 0.0. The result is an array (1,),
    so that NumPy compares in float32."""
    return np.array([order if order >= 0 else -order | 0x80000000], np.uint32).view(np.float32)

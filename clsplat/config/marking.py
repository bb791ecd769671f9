# SPDX-License-Identifier: Apache-2.0
"""Thresholds by which density control marks Gaussians, as the device compares them: in float32, exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from clsplat.arrays import Float32

FRESH = np.uint32(1 << 31)
"""Bit of an entry in a list of rows: the row is a copy whose moments start from zero."""
UNWANTED, USELESS = -1.0, -2.0
"""Scores of Gaussians that are not densified, and of those that are pruned for what they contribute."""


@dataclass(frozen=True)
class MarkRules:
    """Edges (`edge`) that Gaussians are on one side of or the other; the defaults change nothing.

    Densified is what has a mean gradient over `gradient` in more views than `agreeing`, and of these, by `strongest`
    (value, row), what has more than the value, or as much and no later row: split where its log of the largest scale is
    over `large`, else cloned. Pruned is what has a logit of at most `transparent`, a log of the largest scale over
    `oversized`, of a half over `oversized_half`, and unless new a radius over `radius`; and what is useless: at most
    `contribution` to any view, or a total less than the value of `least` (value, row), or as much and no later row.
    """

    gradient: float = inf
    agreeing: float = -inf
    strongest: tuple[float, int] = (-inf, 0)
    large: float = inf
    transparent: float = -inf
    oversized: float = inf
    oversized_half: float = inf
    radius: float = inf
    contribution: float = -inf
    least: tuple[float, int] = (-inf, 0)


def edge(holds: Callable[[Float32], Any]) -> float:
    """The largest float32 for which `holds` is false: x > edge is the same as holds(x). It is false for small numbers
    and true for large ones; infinite where it is one of these for all."""
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
    """Whole number in the order of the float32 numbers."""
    bits = int(np.float32(value).view(np.uint32))
    return -(bits & 0x7FFFFFFF) if bits >> 31 else bits


def _number(order: int) -> Float32:
    """An array (1,) of the float32 with this place in the order: an array, so that it is compared as one."""
    return np.array([order if order >= 0 else -order | 0x80000000], np.uint32).view(np.float32)

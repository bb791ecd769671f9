# SPDX-License-Identifier: Apache-2.0
"""Colour models: distances from the principal point, the pull of gains to initial values, and Adam's update.

Float64 twin of kernels/appearance.cl and kernels/shared/develop.h.
"""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64


def spread(width: int, height: int, centre: tuple[float, float]) -> Float64:
    """Return each pixel's squared distance (H, W) from the principal point, in units of half the picture's diagonal.

    centre: the principal point, in pixels.
    """
    x, y = np.arange(width) + 0.5 - centre[0], np.arange(height) + 0.5 - centre[1]
    squared: Float64 = 4 * (x**2 + y[:, None] ** 2) / (width**2 + height**2)
    return squared


def pull(logs: Float64, start: Float64, weights: Float64) -> Float64:
    """Return the gradient (photographs, 3) that pulls log2 gains `logs` towards their initial values `start`.

    It is W (d - m). Here W is the matrix `weights` (photographs, photographs), d is logs - start, and m is the mean of
    the rows of d that belong to nonzero rows of W.
    """
    told, apart = weights.any(axis=1), logs - start
    mean = apart[told].mean(axis=0) if told.any() else 0.0
    result: Float64 = weights @ (apart - mean)
    return result


def step(
    logs: Float64,
    first: Float64,
    second: Float64,
    by_logs: Float64,
    number: int,
    rate: float | Float64,
    *,
    mean: Float64 | None = None,
) -> tuple[Float64, Float64, Float64]:
    """Return entries and both moments (photographs, entries) after step `number` of Adam with the gradient `by_logs`.

    logs: the entries before the step; the first three of a photograph are log2 gains.
    number: counts from 1.
    rate: learning rate of all entries, or of each entry.
    mean: (entries,), the mean over the photographs to which each entry is shifted after the step. None shifts nothing.
    """
    first, second = 0.9 * first + 0.1 * by_logs, 0.999 * second + 0.001 * by_logs**2
    change = rate * (first / (1 - 0.9**number)) / (np.sqrt(second / (1 - 0.999**number)) + 1e-15)
    moved = logs - change
    return moved if mean is None else moved - moved.mean(axis=0) + mean, first, second

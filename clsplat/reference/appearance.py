# SPDX-License-Identifier: Apache-2.0
"""The entries of photographs and lenses: distances in a picture, the pull to initial values, and the update by Adam.

Float64 twin of kernels/appearance.cl and kernels/shared/develop.h.
"""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64


def spread(width: int, height: int, centre: tuple[float, float]) -> Float64:
    """The squared distances (H, W) from the principal point, in half diagonals. centre: in pixels."""
    x, y = np.arange(width) + 0.5 - centre[0], np.arange(height) + 0.5 - centre[1]
    squared: Float64 = 4 * (x**2 + y[:, None] ** 2) / (width**2 + height**2)
    return squared


def pull(logs: Float64, start: Float64, weights: Float64) -> Float64:
    """The pull (photographs, 3) to the initial logs, which is added to the gradients with respect to the logs.

    It is weights (photographs, photographs) times the distances from `start`, after subtraction of their mean. The
    mean is over photographs with a nonzero weight.
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
    centred: bool = True,
) -> tuple[Float64, Float64, Float64]:
    """Logs and moments (photographs, entries) after a step of Adam with the gradient `by_logs`.

    rate: learning rate of all entries, or of each entry.
    centred: subtract each entry's mean over the photographs afterwards.
    """
    first, second = 0.9 * first + 0.1 * by_logs, 0.999 * second + 0.001 * by_logs**2
    change = rate * (first / (1 - 0.9**number)) / (np.sqrt(second / (1 - 0.999**number)) + 1e-15)
    moved = logs - change
    return moved - moved.mean(axis=0) if centred else moved, first, second

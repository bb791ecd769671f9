# SPDX-License-Identifier: Apache-2.0
"""Gains of photographs, their gradient and their update by Adam: float64 twin of kernels/appearance.cl."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64


def removed(photograph: Float64, logs: Float64) -> Float64:
    """Divide the photograph (H, W, 3) by its gains 2^logs (3,)."""
    result: Float64 = photograph / np.exp2(logs)
    return result


def gradient(image: Float64, by_image: Float64) -> Float64:
    """Gradient (3,) of a loss of the product image times 2^logs, with respect to logs at 0.

    by_image: (H, W, 3), the gradient of the loss with respect to the product.
    """
    by_logs: Float64 = np.log(2) * (image * by_image).sum(axis=(0, 1))
    return by_logs


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

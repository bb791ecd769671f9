# SPDX-License-Identifier: Apache-2.0
"""Gains of photographs, their gradient and Adam's step: float64 twin of kernels/appearance.cl."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64


def removed(photograph: Float64, logs: Float64) -> Float64:
    """Divide the gains 2^logs (3,) out of the photograph (H, W, 3)."""
    result: Float64 = photograph / np.exp2(logs)
    return result


def gradient(image: Float64, by_image: Float64) -> Float64:
    """Gradient by the logs (3,) at 0, for a loss of the image times 2^logs.

    by_image: (H, W, 3), the loss's gradient by that product.
    """
    by_logs: Float64 = np.log(2) * (image * by_image).sum(axis=(0, 1))
    return by_logs


def pull(logs: Float64, start: Float64, weights: Float64) -> Float64:
    """The pull that is added to the gradients by the logs, (photographs, 3).

    It is weights (photographs, photographs) times the distances from the start, less their mean over the photographs
    with weights.
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
    """Logs and moments (photographs, entries) after Adam's step along by_logs.

    rate: learning rate of all entries, or of each.
    centred: True to subtract each entry's mean over the photographs afterwards.
    """
    first, second = 0.9 * first + 0.1 * by_logs, 0.999 * second + 0.001 * by_logs**2
    change = rate * (first / (1 - 0.9**number)) / (np.sqrt(second / (1 - 0.999**number)) + 1e-15)
    moved = logs - change
    return moved - moved.mean(axis=0) if centred else moved, first, second

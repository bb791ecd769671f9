# SPDX-License-Identifier: Apache-2.0
"""A step of Adam, and the sum of gradients over a batch: float64 twin of kernels/adam.cl."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64


def adam(
    parameters: Float64,
    gradients: Float64,
    first: Float64,
    second: Float64,
    step: int,
    rate: float,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-15,
) -> tuple[Float64, Float64, Float64]:
    """Eq. (42): the new parameters and both moments, arrays of the same shape. `step` counts from 1."""
    first = beta1 * first + (1 - beta1) * gradients
    second = beta2 * second + (1 - beta2) * gradients**2
    mean = first / (1 - beta1**step)
    spread = np.sqrt(second / (1 - beta2**step))
    return parameters - rate * mean / (spread + epsilon), first, second


def missed_steps(
    parameters: Float64, first: Float64, second: Float64, step: int, rates: Sequence[float]
) -> tuple[Float64, Float64, Float64]:
    """Eq. (42) without a gradient, once for each rate: the parameters and moments after the steps from `step` + 1 on.

    It is the twin of kernels/settle.cl, which has the closed form (190) to (192).
    """
    none = np.zeros_like(parameters)
    for number, rate in enumerate(rates, step + 1):
        parameters, first, second = adam(parameters, none, first, second, number, rate)
    return parameters, first, second


def add_views(gradients: Sequence[Float64], seen: Sequence[NDArray[np.bool_]]) -> Float64:
    """Sum the gradients (n, ...) of several views. Each view adds the rows of its visible Gaussians (`seen`, (n,))."""
    total = np.zeros_like(gradients[0])
    for gradient, rows in zip(gradients, seen, strict=True):
        total[rows] += gradient[rows]
    return total

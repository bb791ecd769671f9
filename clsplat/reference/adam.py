# SPDX-License-Identifier: Apache-2.0
"""The Adam optimiser's step, and the sum of gradients over a batch of views: float64 twin of kernels/adam.cl.

Equation numbers refer to docs/gradients.md.
"""

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
    """Return parameters and both moments after step number `step` of Adam, counted from 1: eq. (42).

    All arrays have the same shape. rate: learning rate.
    """
    first = beta1 * first + (1 - beta1) * gradients
    second = beta2 * second + (1 - beta2) * gradients**2
    mean = first / (1 - beta1**step)
    spread = np.sqrt(second / (1 - beta2**step))
    return parameters - rate * mean / (spread + epsilon), first, second


def missed_steps(
    parameters: Float64, first: Float64, second: Float64, step: int, rates: Sequence[float]
) -> tuple[Float64, Float64, Float64]:
    """Return parameters and both moments after Adam steps with a zero gradient, one for each of `rates`: eq. (42).

    rates: learning rates of the steps, which have the numbers `step` + 1, `step` + 2 and so on.
    kernels/settle.cl computes the same by the closed form (190) to (192).
    """
    none = np.zeros_like(parameters)
    for number, rate in enumerate(rates, step + 1):
        parameters, first, second = adam(parameters, none, first, second, number, rate)
    return parameters, first, second


def add_views(gradients: Sequence[Float64], seen: Sequence[NDArray[np.bool_]]) -> Float64:
    """Sum the gradients (n, ...) of several views. Only rows where a view's `seen` (n,) is True are added."""
    total = np.zeros_like(gradients[0])
    for gradient, rows in zip(gradients, seen, strict=True):
        total[rows] += gradient[rows]
    return total

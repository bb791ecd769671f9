# SPDX-License-Identifier: Apache-2.0
"""Random dropout of Gaussians in a training step: float64 twin of kernels/project.cl with THINNED.

Equation numbers refer to docs/gradients.md.
"""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64
from clsplat.optimisation.dropout import Thinning
from clsplat.reference.noise import mixed


def factors(thinning: Thinning, count: int, first_row: int = 0) -> Float64:
    """Return the factor (count,) of each Gaussian's opacity, 0 for a dropped Gaussian: eq. (101).

    first_row: row in the model of the first of the `count` Gaussians.
    """
    rows = (first_row + np.arange(count)).astype(np.uint32)
    key0, key1 = (np.uint32(word) for word in thinning.key)
    words = mixed(mixed(rows ^ key0) + key1)
    return np.where(words < thinning.threshold, 0.0, thinning.factor)


def thinned_logits(opacity_logits: Float64, by: Float64) -> Float64:
    """Return the logits (n,) of opacities times the factors `by` (n,); -700 where a factor is 0.

    The products must be below 1.
    """
    opacities = by / (1 + np.exp(-opacity_logits))
    logits: Float64 = np.where(by > 0, np.log(np.maximum(opacities, 1e-300)) - np.log1p(-opacities), -700.0)
    return logits


def logit_grad(opacity_logits: Float64, by: Float64, gradient: Float64) -> Float64:
    """Return the gradient with respect to the original logits: eq. (101).

    by: (n,), factors of the opacities. gradient: (n,), gradient with respect to the logits after multiplication.
    """
    opacities = 1 / (1 + np.exp(-opacity_logits))
    return np.where(by > 0, gradient * (1 - opacities) / (1 - by * opacities), 0.0)

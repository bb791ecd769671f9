# SPDX-License-Identifier: Apache-2.0
"""Thinning of the model in a step: float64 twin of project.cl with THINNED."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64
from clsplat.optimisation.dropout import Thinning
from clsplat.reference.noise import mixed


def factors(thinning: Thinning, count: int, first_row: int = 0) -> Float64:
    """Eq. (101): the factor (n,) of each Gaussian's opacity, 0 if the Gaussian is dropped."""
    rows = (first_row + np.arange(count)).astype(np.uint32)
    key0, key1 = (np.uint32(word) for word in thinning.key)
    words = mixed(mixed(rows ^ key0) + key1)
    return np.where(words < thinning.threshold, 0.0, thinning.factor)


def thinned_logits(opacity_logits: Float64, by: Float64) -> Float64:
    """Logits of the opacities multiplied by `by` (n,). The products must be below 1; a product of 0 gives -700."""
    opacities = by / (1 + np.exp(-opacity_logits))
    logits: Float64 = np.where(by > 0, np.log(np.maximum(opacities, 1e-300)) - np.log1p(-opacities), -700.0)
    return logits


def logit_grad(opacity_logits: Float64, by: Float64, gradient: Float64) -> Float64:
    """Eq. (101): gradient with respect to the original logits, from that with respect to `thinned_logits`."""
    opacities = 1 / (1 + np.exp(-opacity_logits))
    return np.where(by > 0, gradient * (1 - opacities) / (1 - by * opacities), 0.0)

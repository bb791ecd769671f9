# SPDX-License-Identifier: Apache-2.0
"""Noise of MCMC training on means, and penalties on opacity and scale.

Float64 twin of kernels/noise.cl and of the penalties in project_grad.cl. Equation numbers refer to docs/gradients.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.optimisation.step_noise import Exploration
from clsplat.reference.project import rotation_matrices

HALF_WORDS_PER_NORMAL = 8
"""Number of random 16-bit integers whose sum makes one normally distributed number."""


def mixed(words: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Hash 32-bit words, as in kernels/shared/random.h. Different words get different hashes."""
    words = (words ^ (words >> np.uint32(16))) * np.uint32(0x7FEB352D)
    words = (words ^ (words >> np.uint32(15))) * np.uint32(0x846CA68B)
    return words ^ (words >> np.uint32(16))


def normal_numbers(key: tuple[int, int], rows: NDArray[np.integer]) -> Float64:
    """Return three normally distributed numbers for each row of a model, (n, 3): eq. (93). key: the step's key."""
    of_row = mixed(rows.astype(np.uint32) ^ np.uint32(key[0])) + np.uint32(key[1])
    counters = np.arange(3 * HALF_WORDS_PER_NORMAL // 2, dtype=np.uint32) * np.uint32(0x9E3779B9)
    words = mixed(of_row[:, None] + counters)
    halves = (words & np.uint32(0xFFFF)).astype(np.int64) + (words >> np.uint32(16)).astype(np.int64)
    sums = halves.reshape(len(rows), 3, HALF_WORDS_PER_NORMAL // 2).sum(axis=2) - HALF_WORDS_PER_NORMAL * 65535 // 2
    numbers: Float64 = sums / np.sqrt(HALF_WORDS_PER_NORMAL * (65536.0**2 - 1) / 12)
    return numbers


def displacements(
    explore: Exploration, quaternions: Float64, log_scales: Float64, opacity_logits: Float64, first_row: int = 0
) -> Float64:
    """Return the random displacements (n, 3) of the means of n consecutive rows: eq. (92).

    first_row: number of the first of these rows in the model.
    """
    eta = normal_numbers(explore.key, first_row + np.arange(len(opacity_logits)))
    opacities = 1 / (1 + np.exp(-opacity_logits))
    weights = explore.amount / (1 + np.exp(100 * (opacities - explore.dead)))
    axes = rotation_matrices(quaternions)
    along = np.einsum("nij,ni->nj", axes, eta) * np.exp(2 * log_scales)
    moved: Float64 = np.einsum("nij,nj->ni", axes, along) * weights[:, None]
    return moved


def penalty(explore: Exploration, log_scales: Float64, opacity_logits: Float64) -> float:
    """Return the penalty on opacities and scales, summed over all Gaussians, visible or not."""
    opacities = 1 / (1 + np.exp(-opacity_logits))
    return float(explore.opacity * opacities.sum() + explore.scale * np.exp(log_scales).sum())


def penalty_grad(explore: Exploration, log_scales: Float64, opacity_logits: Float64) -> tuple[Float64, Float64]:
    """Return gradients of the penalty with respect to log scales (n, 3) and opacity logits (n,): eq. (91)."""
    opacities = 1 / (1 + np.exp(-opacity_logits))
    return explore.scale * np.exp(log_scales), explore.opacity * opacities * (1 - opacities)

# SPDX-License-Identifier: Apache-2.0
"""Density control: scores of Gaussians, and lists of the Gaussians to keep, clone and split.

NumPy twin of kernels/density.cl, in float32 like the kernel.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.optimisation.density_rules import FRESH, FROZEN, UNWANTED, USELESS, MarkRules


def scores(rules: MarkRules, statistics: Mapping[str, Float32], means: Float32) -> Float32:
    """Return a score (n,) of each Gaussian: its mean gradient norm if it may be densified, otherwise UNWANTED.

    A Gaussian whose largest contribution to a view is at most `rules.contribution` gets USELESS instead, and a Gaussian
    outside `rules.region` FROZEN.

    statistics: the statistics of density control, arrays (n,) by their names in a checkpoint.
    means: (n, 3).
    """
    with np.errstate(all="ignore"):
        norms = statistics["gradient_sums"] / np.maximum(statistics["seen"], np.float32(1))
    norms = np.where(np.isfinite(norms), norms, np.float32(0))
    wanted = norms > np.float32(rules.gradient)
    found = np.where(wanted, norms, np.float32(UNWANTED))
    if "whole_largest" in statistics:
        largest = np.maximum(statistics["current_largest"], statistics["whole_largest"])
        found[largest <= np.float32(rules.contribution)] = USELESS
    if rules.region is not None:
        found[~rules.region.contains(means)] = FROZEN
    return found.astype(np.float32)


def rows(
    rules: MarkRules,
    statistics: Mapping[str, Float32],
    means: Float32,
    log_scales: Float32,
    opacity_logits: Float32,
) -> tuple[NDArray[np.uint32], int]:
    """Return the old row that each Gaussian of the new model comes from, and the number of halves of split Gaussians.

    The Gaussians are in this order: remaining ones, clones, first halves, second halves. The rows of clones and halves
    have the bit FRESH. statistics: as for `scores`.
    """
    found, largest = scores(rules, statistics, means), log_scales.max(axis=1)
    value, row = rules.cut_off
    wanted = (found > np.float32(value)) | ((found == np.float32(value)) & (np.arange(len(found)) <= row))
    wanted &= found >= 0
    large = largest > np.float32(rules.large)
    gone = (found == USELESS) | (opacity_logits <= np.float32(rules.transparent))
    oversized = gone | (largest > np.float32(rules.oversized))
    stays = ~oversized & ~(wanted & large) & ~(statistics["radii"] > np.float32(rules.radius)) | (found == FROZEN)
    split = np.flatnonzero(wanted & large & ~gone & ~(largest > np.float32(rules.oversized_half)))
    fresh = np.concatenate([np.flatnonzero(wanted & ~large & ~oversized), split, split])
    return np.concatenate([np.flatnonzero(stays), fresh | int(FRESH)]).astype(np.uint32), 2 * len(split)

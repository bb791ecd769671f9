# SPDX-License-Identifier: Apache-2.0
"""Adaptive density control (Kerbl et al. 2023, section 5): what to clone, split and prune. Policy only: no device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.config import DensityConfig

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Plan:
    """The Gaussians after density control.

    rows (m,) uint32: which Gaussian each comes from, kept ones first and in order; fresh (m,) bool: clones and halves
    of splits, whose moments start at zero; split (m,) bool: halves, to be moved and shrunk.
    """

    rows: NDArray[np.uint32]
    fresh: NDArray[np.bool_]
    split: NDArray[np.bool_]


def is_due(config: DensityConfig, step: int) -> bool:
    """Whether Gaussians are cloned, split and pruned after this step."""
    return config.every > 0 and config.start < step < config.stop and step % config.every == 0


def is_reset_due(config: DensityConfig, step: int, *, white: bool) -> bool:
    """Whether opacities are reset after this step; once early before a white background, as the authors' code."""
    if config.every <= 0 or step >= config.stop:
        return False
    return (config.opacity_reset_every > 0 and step % config.opacity_reset_every == 0) or (
        white and step == config.start
    )


def plan(
    config: DensityConfig,
    step: int,
    extent: float,
    *,
    gradient_sums: Float32,
    seen: Float32,
    radii: Float32,
    log_scales: Float32,
    opacity_logits: Float32,
) -> Plan:
    """Clone the small and split the large among those with a large mean gradient; prune the transparent and oversized.

    gradient_sums, seen, radii, opacity_logits (n,); log_scales (n, 3); extent: the scene's, in world units.
    """
    n = len(seen)
    gradients = gradient_sums / np.maximum(seen, 1)
    sizes = np.exp(log_scales.max(axis=1))
    wanted = gradients >= config.gradient_threshold
    room = config.max_gaussians - n
    if wanted.sum() > room:
        strongest = np.argsort(-gradients, kind="stable")[: max(room, 0)]
        allowed = np.zeros(n, bool)
        allowed[strongest] = True
        wanted &= allowed
    large = sizes > config.dense_fraction * extent
    to_clone, to_split = np.flatnonzero(wanted & ~large), np.flatnonzero(wanted & large)
    kept = np.flatnonzero(~(wanted & large))

    rows = np.concatenate([kept, to_clone, to_split, to_split])
    origin = np.repeat([0, 1, 2], [len(kept), len(to_clone), 2 * len(to_split)])
    sizes_after = np.where(origin == 2, sizes[rows] / config.split_factor, sizes[rows])
    logit_floor = np.log(config.min_opacity / (1 - config.min_opacity))
    prune = opacity_logits[rows] < logit_floor
    if config.opacity_reset_every > 0 and step > config.opacity_reset_every:
        prune |= sizes_after > config.max_world_fraction * extent
        if config.max_screen_radius > 0:
            prune |= (radii[rows] > config.max_screen_radius) & (origin == 0)
    rows, origin = rows[~prune], origin[~prune]
    return Plan(rows.astype(np.uint32), origin > 0, origin == 2)


def split_halves(
    config: DensityConfig, *, means: Float32, quaternions: Float32, log_scales: Float32, rng: np.random.Generator
) -> tuple[Float32, Float32]:
    """Means and log scales of halves: drawn from the Gaussian they come from, and smaller. (m, 3), (m, 4), (m, 3)."""
    offsets = rng.standard_normal(means.shape) * np.exp(log_scales.astype(np.float64))
    q = quaternions.astype(np.float64)
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    w, axis = q[:, :1], q[:, 1:]
    twice = 2 * np.cross(axis, offsets)
    rotated = offsets + w * twice + np.cross(axis, twice)
    smaller = log_scales - np.float32(np.log(config.split_factor))
    return (means + rotated).astype(np.float32), smaller.astype(np.float32)


def reset_opacities(config: DensityConfig, opacity_logits: Float32) -> Float32:
    """At most `opacity_reset_to`."""
    ceiling = np.log(config.opacity_reset_to / (1 - config.opacity_reset_to))
    return np.minimum(opacity_logits, np.float32(ceiling))

# SPDX-License-Identifier: Apache-2.0
"""Penalties on opacity and scale, and the noise of MCMC, in a training step: parameters for the kernels.

Weights and the rate of the noise are settings: `config/training.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from clsplat.config.training import TrainConfig


@dataclass(frozen=True)
class Exploration:
    """Penalties and noise of a step.

    opacity, scale: weights of two loss terms: the sum of the visible Gaussians' opacities, and the sum of their
        scales, three per Gaussian in world units.
    amount: factor of the noise, in 1 / world units. The noise is proportional to the covariance, in squared world
        units.
    dead: opacity at which the noise is halved.
    key: two 32-bit words, different for each step. They and a Gaussian's row determine its noise.
    """

    opacity: float = 0.0
    scale: float = 0.0
    amount: float = 0.0
    dead: float = 0.005
    key: tuple[int, int] = (0, 0)

    @cached_property
    def weights(self) -> tuple[float, ...]:
        """Weights of the penalties, in the order of PENALTY_PARAMETERS (kernels/shared/project_grad.h); empty without
        penalties."""
        weights = (self.opacity, self.scale)
        return weights if any(weight > 0 for weight in weights) else ()

    def of_view(self) -> Exploration:
        """Copy for a view of a batch: penalties without noise, which the batch adds once."""
        return replace(self, amount=0.0)

    def scaled(self, factor: float) -> Exploration:
        """Copy with `factor` times the noise."""
        return replace(self, amount=factor * self.amount)


NO_EXPLORATION = Exploration()
"""The exploration of a step with neither penalties nor noise."""


def exploration_of(config: TrainConfig, step: int, means_rate: float, count: int, length_unit: float) -> Exploration:
    """Penalties and noise of step number `step`, for a model of `count` Gaussians.

    Noise is added only with growth mcmc and before the cooldown. Its amount is relative to the scene's length unit.
    means_rate: learning rate of the means, in world units.
    length_unit: the scene's length unit, in world units.
    """
    density = config.density
    if density.growth != "mcmc":
        penalty = config.penalty
        return _penalties(penalty, penalty, count, length_unit) if penalty > 0 else NO_EXPLORATION
    cools = step > config.iterations - config.optimiser.cooldown
    return replace(
        _penalties(density.opacity_weight, density.scale_weight, count, length_unit),
        amount=0.0 if cools else density.noise_rate * means_rate / length_unit**2,
        dead=density.min_opacity,
        key=step_key(config.seed, step),
    )


def _penalties(opacity: float, scale: float, count: int, length_unit: float) -> Exploration:
    """Convert weights of penalties: from means over all `count` Gaussians to sums over the visible Gaussians.

    opacity, scale: weights of the mean opacity, and of the mean scale in length units of the scene (equation (91) of
        docs/gradients.md).
    """
    return Exploration(opacity=opacity / count, scale=scale / (3 * count * length_unit))


def step_key(seed: int, step: int) -> tuple[int, int]:
    """Two random 32-bit words for step number `step` of a training with this seed."""
    first, second = np.random.SeedSequence(seed, spawn_key=(step,)).generate_state(2)
    return int(first), int(second)

# SPDX-License-Identifier: Apache-2.0
"""Penalties and noise of a training step: their parameters for the kernels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Exploration:
    """Penalties and noise of one step.

    opacity, scale: weights of two penalties, whose gradients are added to the loss's. They are the sums of opacities
    and of scales (three a Gaussian, world units) over the Gaussians in view.
    amount: factor of the noise, one over world units, as the noise is this times the covariance, in squared world
    units.
    dead: opacity at which half of that is added.
    key: two 32-bit words that no other step has. With a Gaussian's row they give its noise.
    """

    opacity: float = 0.0
    scale: float = 0.0
    amount: float = 0.0
    dead: float = 0.005
    key: tuple[int, int] = (0, 0)

    @property
    def penalised(self) -> bool:
        """True if the gradient includes penalties."""
        return self.opacity > 0 or self.scale > 0

    def of_view(self) -> Exploration:
        """The terms that each view of a batch applies: the penalties, without noise."""
        return replace(self, amount=0.0)

    def scaled(self, factor: float) -> Exploration:
        """The same with `factor` times the noise."""
        return replace(self, amount=factor * self.amount)


def step_key(seed: int, step: int) -> tuple[int, int]:
    """The two random words of a step in a training run with this seed."""
    first, second = np.random.SeedSequence(seed, spawn_key=(step,)).generate_state(2)
    return int(first), int(second)

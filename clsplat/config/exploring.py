# SPDX-License-Identifier: Apache-2.0
"""Penalties and noise of a training step, as a strategy asks for them and kernels do them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Exploration:
    """Penalties and noise of one step.

    opacity, scale: weights of the sums over the Gaussians in view of opacities and of scales (three a Gaussian, world
    units), whose gradient is added to the loss's. amount: of noise, one over world units, as the covariance is their
    square; dead: opacity at which half of that is added; key: two words of 32 bits that no other step has, from which
    and from its row a Gaussian has its noise.
    """

    opacity: float = 0.0
    scale: float = 0.0
    amount: float = 0.0
    dead: float = 0.005
    key: tuple[int, int] = (0, 0)

    @property
    def penalised(self) -> bool:
        """True if the gradient is another than that of the loss."""
        return self.opacity > 0 or self.scale > 0

    def of_view(self) -> Exploration:
        """The part that each view of a batch has: the penalties."""
        return replace(self, amount=0.0)

    def scaled(self, factor: float) -> Exploration:
        """The same with `factor` times the noise."""
        return replace(self, amount=factor * self.amount)


def step_key(seed: int, step: int) -> tuple[int, int]:
    """The words of a step of a training of this seed."""
    first, second = np.random.SeedSequence(seed, spawn_key=(step,)).generate_state(2)
    return int(first), int(second)

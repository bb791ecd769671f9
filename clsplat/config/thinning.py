# SPDX-License-Identifier: Apache-2.0
"""Thinning of the model in a training step (DropGaussian), as a step asks for it and projection does it."""

from __future__ import annotations

from dataclasses import dataclass

from clsplat.config.exploring import step_key
from clsplat.config.training import TrainConfig

THINNING_WORDS = 0x5EED
"""Added to a step's first word, so that its noise and its thinning are drawn apart."""


@dataclass(frozen=True)
class Thinning:
    """Gaussians that are left out of one step. rate: the share of them; key: two words of 32 bits, from which and from
    its row it is drawn whether a Gaussian is."""

    rate: float
    key: tuple[int, int]

    @property
    def threshold(self) -> int:
        """A Gaussian is left out whose word of 32 bits is less than this."""
        return round(self.rate * 2**32)

    @property
    def factor(self) -> float:
        """Factor of the opacities of the others."""
        return 1 / (1 - self.rate)


def thinning_of(config: TrainConfig, step: int) -> Thinning | None:
    """The thinning of step number `step` of all the run's steps, each of `config.batch` views; None without it."""
    if config.thinning == 0:
        return None
    first, second = step_key(config.seed, step)
    share = min(step * config.batch / config.iterations, 1.0)
    return Thinning(config.thinning * share, ((first + THINNING_WORDS) & 0xFFFFFFFF, second))

# SPDX-License-Identifier: Apache-2.0
"""Dropout of Gaussians in a training step (--thinning; DropGaussian): parameters for the projection kernels."""

from __future__ import annotations

from dataclasses import dataclass

from clsplat.config.training import TrainConfig
from clsplat.optimisation.step_noise import step_key

THINNING_KEY_OFFSET = 0x5EED
"""Number that is added to the first word of a step's key, so that noise and dropout are independent."""


@dataclass(frozen=True)
class Thinning:
    """Random choice of the Gaussians that a step drops.

    rate: the fraction of Gaussians that are dropped.
    key: two 32-bit words. They and a Gaussian's row determine its random word, by which it is dropped or not.
    """

    rate: float
    key: tuple[int, int]

    @property
    def threshold(self) -> int:
        """Number below which a Gaussian's 32-bit random word means that the Gaussian is dropped."""
        return round(self.rate * 2**32)

    @property
    def factor(self) -> float:
        """The factor by which the opacities of the remaining Gaussians are multiplied."""
        return 1 / (1 - self.rate)


def thinning_of(config: TrainConfig, step: int) -> Thinning | None:
    """Dropout in step number `step`; None without --thinning.

    The rate grows linearly over the steps of the training, up to the value of the setting.
    """
    if config.thinning == 0:
        return None
    first, second = step_key(config.seed, step)
    share = min(step * config.batch / config.iterations, 1.0)
    return Thinning(config.thinning * share, ((first + THINNING_KEY_OFFSET) & 0xFFFFFFFF, second))

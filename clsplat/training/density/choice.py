# SPDX-License-Identifier: Apache-2.0
"""Choice of the density control strategy."""

from __future__ import annotations

from dataclasses import replace

from clsplat.config.points import SKY_RADIUS_RATIO
from clsplat.config.training import TrainConfig
from clsplat.training.density import Strategy
from clsplat.training.density.adaptive import Adaptive
from clsplat.training.density.mcmc import Mcmc


def strategy_of(config: TrainConfig) -> Strategy:
    """New strategy for one training."""
    if config.density.growth == "mcmc":
        return Mcmc(config)
    if config.sky:  # without a larger limit, the whole sky would be pruned as oversized
        size = config.density.max_world_fraction * SKY_RADIUS_RATIO
        config = replace(config, density=replace(config.density, max_world_fraction=size))
    return Adaptive(config)

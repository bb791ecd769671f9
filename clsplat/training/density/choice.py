# SPDX-License-Identifier: Apache-2.0
"""Choice of the density control strategy by --density.growth."""

from __future__ import annotations

from clsplat.config.training import TrainConfig
from clsplat.training.density import Strategy
from clsplat.training.density.adaptive import Adaptive
from clsplat.training.density.mcmc import Mcmc


def strategy_of(config: TrainConfig) -> Strategy:
    """Make the strategy that the settings name, for one training."""
    return Mcmc(config) if config.density.growth == "mcmc" else Adaptive(config)

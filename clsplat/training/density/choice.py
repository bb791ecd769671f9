# SPDX-License-Identifier: Apache-2.0
"""The strategy that the settings name."""

from __future__ import annotations

from clsplat.config.training import TrainConfig
from clsplat.training.density import Strategy
from clsplat.training.density.adaptive import Adaptive
from clsplat.training.density.mcmc import Mcmc


def strategy_of(config: TrainConfig) -> Strategy:
    """A new one, for one training."""
    return Mcmc(config) if config.density.growth == "mcmc" else Adaptive(config)

# SPDX-License-Identifier: Apache-2.0
"""Learning rates by step."""

from __future__ import annotations

from clsplat.config.training import TrainConfig
from clsplat.gaussians import PARAMETER_GROUPS

_RATE_SETTINGS = {name: group.rate for name, group in PARAMETER_GROUPS.items()}


def rates_at(config: TrainConfig, step: int, length_unit: float, factor: float) -> dict[str, float]:
    """Learning rate of each group at a step.

    The means' rate falls exponentially, and is relative to the scene's length unit. All rates fall in the cooldown.
    factor: factor on all rates, which falls with each return to a checkpoint.
    """
    optimiser = config.optimiser
    into = optimiser.cooldown - max(config.iterations - step, 0)
    cooled = optimiser.cooldown_to ** (into / optimiser.cooldown) if into > 0 else 1.0
    fraction = min(step / optimiser.means_rate_steps, 1.0)
    means_rate = optimiser.means_rate ** (1 - fraction) * optimiser.means_rate_end**fraction
    given = vars(optimiser)
    rates = {name: given[setting] * cooled * factor for name, setting in _RATE_SETTINGS.items()}
    rates["means"] = means_rate * length_unit * cooled * factor
    return rates

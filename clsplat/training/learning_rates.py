# SPDX-License-Identifier: Apache-2.0
"""Learning rates of the parameter groups by step: exponential decay of the means' rate, cooldown of all rates, and the
rates and decays of steps of several views.

The rates themselves are settings: `OptimiserConfig` in `config/training.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import sqrt

from clsplat.config.training import OptimiserConfig, TrainConfig
from clsplat.gaussians import PARAMETER_GROUPS

_RATE_SETTINGS = {name: group.rate for name, group in PARAMETER_GROUPS.items()}


def rates_at(config: TrainConfig, step: int, length_unit: float, factor: float) -> dict[str, float]:
    """Learning rate of each parameter group at a step. Batches scale them: `scaled_rates`.

    The means' rate changes exponentially, and is relative to the scene's length unit. All rates fall in the cooldown.
    factor: factor on all rates, smaller after each return to a checkpoint (`RetryBudget.rate_factor`).
    """
    cooled, given = _cooled(config, step), vars(config.optimiser)
    rates = {name: given[setting] * cooled * factor for name, setting in _RATE_SETTINGS.items()}
    rates["means"] = means_rate_at(config, step) * length_unit * cooled * factor
    return rates


def largest_rates(config: TrainConfig, steps: range, length_unit: float) -> dict[str, float]:
    """Upper limit of each parameter group's learning rate over the range `steps`.

    The factor of the cooldown is largest at the first step. The means' rate is largest at the first or the last step,
    because it rises or falls all the way.
    """
    rates, cooled = rates_at(config, steps[0], length_unit, 1.0), _cooled(config, steps[0])
    rates["means"] = max(rates["means"], means_rate_at(config, steps[-1]) * length_unit * cooled)
    return rates


def scaled(config: OptimiserConfig, batch: int) -> OptimiserConfig:
    """Return Adam's settings for steps of `batch` views: moments decay as much per view as in steps of one view.

    Zhao et al. 2024, "On Scaling Up 3D Gaussian Splatting Training", section 4.
    """
    every = max(config.sh_rest_every // batch, 1)
    return replace(config, beta1=config.beta1**batch, beta2=config.beta2**batch, sh_rest_every=every)


def scaled_rates(rates: Mapping[str, float], batch: int) -> dict[str, float]:
    """Return the learning rates for steps of `batch` views, from `rates` for steps of one view.

    Gradients of different views are nearly independent, so their sum grows with the root of their number. Adam divides
    by the sum's size, which cancels this growth, so the rates are multiplied by the root (Zhao et al. 2024, section 4).
    """
    return {group: rate * sqrt(batch) for group, rate in rates.items()}


def _cooled(config: TrainConfig, step: int) -> float:
    """Factor on every learning rate at a step, because of the cooldown; 1 before the cooldown."""
    cooldown = config.optimiser.cooldown
    into = cooldown - max(config.iterations - step, 0)
    return config.optimiser.cooldown_to ** (into / cooldown) if into > 0 else 1.0


def means_rate_at(config: TrainConfig, step: int) -> float:
    """The means' learning rate in a scene of length unit 1, before the cooldown."""
    optimiser = config.optimiser
    fraction = min(step / optimiser.means_rate_steps, 1.0)
    return float(optimiser.means_rate ** (1 - fraction) * optimiser.means_rate_end**fraction)

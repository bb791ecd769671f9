# SPDX-License-Identifier: Apache-2.0
"""Upper limits of the movement of Gaussians by Adam, by which the bounds of chunks are widened after training steps."""

from __future__ import annotations

from math import isfinite

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.chunks.bounds import hidden_path, largest_step
from clsplat.config.training import TrainConfig
from clsplat.training.learning_rates import largest_rates, scaled, scaled_rates

_STEPS_TOGETHER = 16
"""Number of consecutive steps that share their limits of the learning rates, which the first of them finds."""


class MovementLimits:
    """Upper limits of the movement of means and log scales in steps of a training's Adam.

    unit: the scene's length unit.
    optimiser: Adam's settings for a step with all its views.
    """

    def __init__(self, config: TrainConfig, unit: float) -> None:
        self._config, self._unit = config, unit
        self.optimiser = scaled(config.optimiser, config.batch)
        self._rates = dict.fromkeys((False, True), (range(0), np.zeros((2, 1))))
        """Numbers of steps, and limits of the learning rates in them. The key is True for limits of single steps."""
        self.set(largest_step(self.optimiser))

    def set(self, limit: float) -> None:
        """Set the limit of a parameter's movement in one step, as a multiple of the learning rate."""
        self._step = limit
        self._hidden = 0.0 if self._config.optimiser.sparse else hidden_path(self.optimiser, limit)

    @property
    def finite(self) -> bool:
        """True if there is a limit of a parameter's movement in one step."""
        return isfinite(self._step)

    def in_step(self, step: int) -> Float64:
        """Return limits (2, 1) of the movement of means' coordinates and of log scales in step number `step`."""
        return np.asarray(self._step * self._largest_rates(step, step))

    def in_missed_steps(self, oldest: int, step: int, last: NDArray[np.uint32] | int) -> Float64:
        """Return limits (2, n or 1) of the movement of means' coordinates and of log scales in steps with gradient 0,
        before step number `step`.

        oldest: lower limit of `last`.
        last: number of the last step that updated a Gaussian with its gradients: one for each of n chunks, or one.
        """
        path = np.minimum(self._step * (step - 1 - last), self._hidden)
        return np.asarray(self._largest_rates(oldest + 1, step) * path)

    def _largest_rates(self, first: int, last: int) -> Float64:
        """Return upper limits (2, 1) of the learning rates of means and log scales in the steps `first` to `last`."""
        known, rates = self._rates[first == last]
        if first not in known or last not in known:
            known = range(first, last + _STEPS_TOGETHER)
            batch = self._config.batch
            views = range((known[0] - 1) * batch + 1, known[-1] * batch + 1)
            by_group = scaled_rates(largest_rates(self._config, views, self._unit), batch)
            rates = np.array([[by_group["means"]], [by_group["log_scales"]]])
            self._rates[first == last] = known, rates
        return rates

# SPDX-License-Identifier: Apache-2.0
"""Limits of Adam's movement, against the learning rates of each step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny import short

from clsplat.chunks.bounds import hidden_path, largest_step
from clsplat.config.training import OptimiserConfig
from clsplat.training.learning_rates import largest_rates, rates_at, scaled, scaled_rates
from clsplat.training.step.movement import MovementLimits

COOLED = OptimiserConfig(cooldown=100, cooldown_to=1e-4)
RISING = OptimiserConfig(means_rate=1e-5, means_rate_end=1e-3, means_rate_steps=150)


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("optimiser", [OptimiserConfig(), COOLED, RISING])
def test_no_step_exceeds_its_limit(optimiser: OptimiserConfig, batch: int) -> None:
    """In order, and again from an earlier step on, as after a repeated step."""
    config = replace(short(iterations=200), optimiser=optimiser, batch=batch)
    limits = MovementLimits(config, 2.0)
    step_limit = largest_step(scaled(optimiser, batch))
    for step in (*range(1, 60), *range(41, 66)):
        rates = [
            scaled_rates(rates_at(config, view, 2.0, 1.0), batch)
            for view in range(batch * (step - 1) + 1, batch * step + 1)
        ]
        wanted = [[max(each[group] for each in rates)] for group in ("means", "log_scales")]
        found = limits.in_step(step)
        assert (found >= step_limit * np.array(wanted) * (1 - 1e-12)).all()
        later = limits.in_missed_steps(max(step - 20, 0), step, np.array([max(step - 20, 0), step - 1], np.uint32))
        assert (later[:, 1] == 0).all(), "no step was missed"
        assert (later[:, 0] >= 0).all()


def test_missed_steps_move_no_farther_than_a_path() -> None:
    config = short(iterations=20_000)
    limits, path = MovementLimits(config, 1.0), hidden_path(config.optimiser)
    rates = rates_at(config, 1, 1.0, 1.0)
    found = limits.in_missed_steps(0, 10_001, 0)
    assert found[:, 0] == pytest.approx([path * rates["means"], path * rates["log_scales"]], rel=1e-12)


def test_sparse_adam_moves_no_hidden_gaussian() -> None:
    limits = MovementLimits(replace(short(iterations=20), optimiser=OptimiserConfig(sparse=True)), 1.0)
    assert not limits.in_missed_steps(0, 10, 0).any()
    assert limits.in_step(10).all()


@pytest.mark.parametrize("end", [1e-6, 1e-3])
def test_largest_rates_are_limits(end: float) -> None:
    """Of means' rates that fall or rise, and of a cooldown that begins within the steps."""
    optimiser = OptimiserConfig(means_rate=1e-4, means_rate_end=end, means_rate_steps=30, cooldown=20, cooldown_to=0.01)
    config = replace(short(iterations=40), optimiser=optimiser)
    for first in range(1, 40, 3):
        steps = range(first, 41)
        limits = largest_rates(config, steps, 2.0)
        for name, limit in limits.items():
            assert max(rates_at(config, step, 2.0, 1.0)[name] for step in steps) <= limit, name
        assert largest_rates(config, range(first, first + 1), 2.0) == rates_at(config, first, 2.0, 1.0)

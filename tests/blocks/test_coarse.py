# SPDX-License-Identifier: Apache-2.0
"""Settings of the coarse model, and the steps of blocks and finish."""

from __future__ import annotations

import pytest

from clsplat.blocks.planning.coarse import (
    block_steps,
    coarse_settings,
    coarse_steps,
    finish_steps,
    without_density_control,
)
from clsplat.config.presets import bundled, stretched
from clsplat.config.training import TrainConfig


def test_the_coarse_model_has_a_shorter_schedule_at_half_the_size() -> None:
    coarse = coarse_settings(TrainConfig(seed=4, eval_at=(7000,)), 1601)
    coarse.check()
    assert (coarse.iterations, coarse.resolution, coarse.seed, coarse.eval_at) == (4500, 800, 4, ())
    assert coarse.warmup == (38, 75)
    assert (coarse.sh_degree_every, coarse.optimiser.means_rate_steps) == (150, 4500)
    assert (coarse.density.start, coarse.density.stop, coarse.density.every) == (75, 2250, 100)
    assert coarse.density.opacity_reset_every == 0


def test_a_short_schedule_still_has_eight_densifications() -> None:
    coarse = coarse_settings(bundled("default", "short", 3000), 800)
    assert (coarse.density.start, coarse.density.stop, coarse.density.every) == (75, 321, 30)  # 246 steps


def test_density_control_that_ends_with_the_coarse_model_is_named() -> None:
    whole = TrainConfig(iterations=1000)  # the coarse model has 150 steps
    assert without_density_control(whole.changed("density.stop", 151)) == []
    (line,) = without_density_control(whole.changed("density.stop", 150))
    assert line.startswith("density.stop is 150, but blocks begin after step 150")
    assert without_density_control(whole.changed("density.stop", 150).changed("density.every", 0)) == []


def test_other_kinds_of_density_control() -> None:
    whole = TrainConfig()
    assert coarse_settings(whole.changed("density.every", 0), 800).density.every == 0
    assert coarse_settings(whole, 800).density.max_gaussians == whole.density.max_gaussians
    filled = whole.changed("density.growth", "budget").changed("density.max_gaussians", 1_000_000)
    assert coarse_settings(filled, 800).density.max_gaussians == 250_000
    coarse_settings(bundled("fast", None, 7000), 800).check()


@pytest.mark.parametrize("steps", [1, 2, 7, 100])
def test_the_shortest_trainings_have_settings_too(steps: int) -> None:
    coarse = coarse_settings(stretched(TrainConfig(), steps), 1)
    coarse.check()
    assert coarse.iterations >= 1 and coarse.resolution == 1
    assert block_steps(TrainConfig(iterations=steps), 1, 1000) >= 1
    assert finish_steps(TrainConfig(iterations=steps)) >= 1


def test_all_photographs_get_the_passes_of_the_whole() -> None:
    whole = TrainConfig(iterations=30_000)
    assert coarse_steps(whole) == 4500
    assert block_steps(whole, 500, 500) == 25_500
    assert block_steps(whole, 100, 500) == 5100
    assert finish_steps(whole) == 1500

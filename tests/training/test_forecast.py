# SPDX-License-Identifier: Apache-2.0
"""The time that a training still takes, told from recorded growths at made-up costs of a step."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.training.forecast import Forecast

RECORDED = json.loads((Path(__file__).parent / "recorded_steps.json").read_text())
"""Trainings of 3000 steps on two cores: Gaussians of each hundred steps, milliseconds of each twenty."""
CPU, GAUSSIANS, OVERHEAD = (1.0, 0.5, 1.0, 20.0), (1.0, 0.1, 2.0, 5.0), (4.0, 0.3, 0.6, 5.0)
"""Costs: milliseconds of a step, 0.25 us of a pixel and of a Gaussian, milliseconds of reading a photograph."""


@dataclass
class Report:
    step: int
    gaussians: int
    seconds: float


def made_up(config: TrainConfig, counts: Sequence[int], costs: tuple[float, float, float, float]) -> list[Report]:
    """A report every ten steps of a training with these costs. Kernels are built in the first 5 s."""
    sizes, seconds, made = Forecast(config, 30, 38_400).sizes, 5.0, []
    for step in range(1, config.iterations + 1):
        count = counts[(step - 1) // 100]
        pixels = 38_400 / sizes.factor(step) ** 2
        read = step <= 30
        seconds += 1e-3 * (costs[0] + 2.5e-4 * (costs[1] * pixels + costs[2] * count) + costs[3] * read)
        if step % 10 == 0:
            made.append(Report(step, count, seconds))
    return made


def recorded(training: dict[str, Any]) -> list[Report]:
    """The reports of a training that took place."""
    seconds, made = 0.0, []
    for step, milliseconds in zip(range(20, 3001, 20), training["milliseconds"], strict=True):
        seconds += milliseconds / 1000
        made.append(Report(step, training["gaussians"][(step - 1) // 100], seconds))
    return made


def ratios(config: TrainConfig, made: list[Report], every: int, forecast: Forecast | None = None) -> list[float]:
    """Forecast over the time that was left, at each `every`-th step but the last."""
    forecast, told = forecast or Forecast(config, 30, 38_400), []
    for report in made:
        forecast.see(report)
        if report.step % every == 0 and report.step < config.iterations:
            left = forecast.left()
            assert left is not None
            told.append(left / (made[-1].seconds - report.seconds))
    return told


BOUNDS = {"bonsai": 0.15, "fox": 0.25, "fox_at_640": 0.3, "banana": 0.5}
"""Largest error of the time told in the first four tenths.

A room's is known best. A scene by phone tells little of its growth before it grows. The 13 photographs of banana grow
to three times as many Gaussians as its number of points tells: with the true numbers the times told are within a ninth.
"""


@pytest.mark.parametrize("training", RECORDED, ids=lambda training: training["scene"])
def test_each_tenth_of_a_real_training(training: dict[str, Any]) -> None:
    """Within a quarter from the fifth tenth on, the room within a seventh from the first."""
    config = TrainConfig(iterations=3000)
    forecast = Forecast(config, training["photographs"], training["pixels"])
    told = ratios(config, recorded(training), 300, forecast)
    assert max(abs(ratio - 1) for ratio in told[:4]) < BOUNDS[training["scene"]]
    assert max(abs(ratio - 1) for ratio in told[4:]) < 0.25


@pytest.mark.parametrize("counts", [training["gaussians"] for training in RECORDED[:2]], ids=["room", "phone"])
@pytest.mark.parametrize("costs", [CPU, GAUSSIANS, OVERHEAD], ids=str)
def test_other_costs_of_a_step(counts: Sequence[int], costs: tuple[float, float, float, float]) -> None:
    """The prior costs are those of one processor. Others are learnt as Gaussians grow: within a quarter after four
    tenths, within a seventh after six."""
    config = TrainConfig(iterations=3000)
    told = ratios(config, made_up(config, counts, costs), 300)
    assert max(abs(ratio - 1) for ratio in told[4:]) < 0.25
    assert max(abs(ratio - 1) for ratio in told[6:]) < 0.14


def test_without_growth_the_sizes_ahead_are_known() -> None:
    """Steps at half and a quarter of the size cost a fraction of those to come: the time told is never more than two
    fifths off, and within a fifth once half the size is known."""
    config = TrainConfig(iterations=1000, density=DensityConfig(every=0))
    made = made_up(config, 10 * (5000,), CPU)
    told = ratios(config, made, 100)
    assert max(abs(ratio - 1) for ratio in told) < 0.4
    assert max(abs(ratio - 1) for ratio in told[2:]) < 0.2


def test_a_kernel_that_is_built_late_tells_nothing_of_the_steps_ahead() -> None:
    config = TrainConfig(iterations=1000, density=DensityConfig(every=0))
    made = made_up(config, 10 * (5000,), CPU)
    late = [replace(report, seconds=report.seconds + 9.0 * (report.step > 500)) for report in made]
    assert ratios(config, late, 100)[5] == pytest.approx(ratios(config, made, 100)[5], rel=0.2)


@pytest.mark.parametrize("growth", ["mcmc", "budget"])
def test_growth_that_is_planned_is_known_exactly(growth: str) -> None:
    density = replace(DensityConfig(), growth=growth, stop=2000, max_gaussians=50_000)
    config = TrainConfig(iterations=3000, density=density)
    forecast = Forecast(config, 30, 38_400)
    for step in (10, 20):
        forecast.see(Report(step, 10_000, 0.1 * step))
    numbers = [span.gaussians for span in forecast._ahead(20, 10_000)]
    assert numbers[0] == 10_000
    assert numbers[-1] == pytest.approx(50_000, abs=1)
    assert numbers == sorted(numbers)


def test_nothing_is_told_before_two_reports_and_after_a_return() -> None:
    forecast = Forecast(TrainConfig(iterations=100), 30, 38_400)
    assert forecast.left() is None
    forecast.see(Report(1, 100, 9.0))
    assert forecast.left() is None
    forecast.see(Report(11, 100, 10.0))
    first = forecast.left()
    forecast.see(Report(5, 100, 11.0))  # a return to a checkpoint
    forecast.see(Report(15, 100, 12.0))
    last = forecast.left()
    assert first is not None
    assert last is not None
    assert 0 < last < first


def test_the_end_has_nothing_left() -> None:
    config = TrainConfig(iterations=300)
    forecast = Forecast(config, 30, 38_400)
    for report in made_up(config, 3 * (1000,), CPU):
        forecast.see(report)
    assert forecast.left() == 0

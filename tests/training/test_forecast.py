# SPDX-License-Identifier: Apache-2.0
"""The time that a training still takes, told from recorded growths at made-up costs of a step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest

from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.training.forecast import Forecast

ROOM = (
    *(6 * [78868]), 84843, 96638, 114069, 136340, 161953, 188641, 214943, 240478, 263684, 285668, 304037, 320966,
    *(335882, 349756, 361842, 373317, 384958, 395184, 404822, 413584, 421619, 429438, 436894, 443954),
)  # fmt: skip
"""Gaussians of each hundred steps of 3000: bonsai, 26 photographs at 240 pixels."""
PHONE = (
    *(6 * [13560]), 17008, 22790, 30097, 37776, 45569, 53132, 60483, 66862, 72878, 78252, 83162, 87273, 91409, 95314,
    *(98587, 101738, 104853, 107777, 110562, 112917, 115389, 117701, 119980, 121993),
)  # fmt: skip
"""The same of fox, 43 photographs."""
CPU, HALVES = (0.75, 0.1, 0.15), (0.2, 0.5, 0.3)
"""Parts of a step's cost at the start: by pixels, by Gaussians, by both."""


@dataclass
class Report:
    step: int
    gaussians: int
    seconds: float


def reports(config: TrainConfig, counts: tuple[int, ...], cost: tuple[float, float, float]) -> list[Report]:
    """A report each tenth step of a training whose steps cost so; 5 s go before the first, when kernels are built."""
    sizes, seconds, made = Forecast(config).sizes, 5.0, []
    for step in range(1, config.iterations + 1):
        count = counts[(step - 1) // 100]
        pixels, number = 1 / sizes.factor(step) ** 2, count / counts[0]
        seconds += 0.02 * (cost[0] * pixels + cost[1] * number + cost[2] * pixels * number)
        if step % 10 == 0:
            made.append(Report(step, count, seconds))
    return made


def ratios(config: TrainConfig, made: list[Report], every: int) -> list[float]:
    """The time told over the time that it then took, at each `every`-th step but the last."""
    forecast, told = Forecast(config), []
    for report in made:
        forecast.see(report)
        if report.step % every == 0 and report.step < config.iterations:
            left = forecast.left()
            assert left is not None
            told.append(left / (made[-1].seconds - report.seconds))
    return told


@pytest.mark.parametrize("counts", [ROOM, PHONE], ids=["room", "phone"])
@pytest.mark.parametrize("cost", [CPU, HALVES, (0.5, 0.3, 0.1)], ids=str)
def test_each_tenth_is_told_before_it_comes(counts: tuple[int, ...], cost: tuple[float, float, float]) -> None:
    """Before growth begins nothing but the number of points tells of it, and nothing but halves of how the cost of a
    step goes by it: within four tenths there, then within the quarter that is promised."""
    config = TrainConfig(iterations=3000)
    told = ratios(config, reports(config, counts, cost), 300)
    assert max(abs(ratio - 1) for ratio in told[:1]) < 0.4
    assert max(abs(ratio - 1) for ratio in told[1:]) < 0.25
    assert max(abs(ratio - 1) for ratio in told[4:]) < 0.1


def test_without_growth_the_sizes_ahead_are_known() -> None:
    """Steps at half and a quarter of the size are a seventh of those to come: the time told is never less than a fifth
    off, where the mean of the steps so far is a quarter of it."""
    config = TrainConfig(iterations=1000, density=DensityConfig(every=0))
    made = reports(config, 10 * (5000,), CPU)
    told = ratios(config, made, 100)
    assert max(abs(ratio - 1) for ratio in told) < 0.2
    seconds = (made[19].seconds - made[0].seconds) / 19  # the mean of steps 11 to 200, ten at a time
    assert 80 * seconds < 0.3 * (made[-1].seconds - made[19].seconds)


@pytest.mark.parametrize("growth", ["mcmc", "budget"])
def test_growth_that_is_planned_is_known_exactly(growth: str) -> None:
    density = replace(DensityConfig(), growth=growth, stop=2000, max_gaussians=50_000)
    config = TrainConfig(iterations=3000, density=density)
    forecast = Forecast(config)
    for step in (10, 20):
        forecast.see(Report(step, 10_000, 0.1 * step))
    numbers = [number for _, number, _ in forecast._ahead(20, 10_000)]
    assert numbers[0] == 10_000
    assert numbers[-1] == pytest.approx(50_000, abs=1)
    assert numbers == sorted(numbers)


def test_nothing_is_told_before_two_reports_and_after_a_return() -> None:
    forecast = Forecast(TrainConfig(iterations=100))
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
    forecast = Forecast(config)
    for report in reports(config, 3 * (1000,), CPU):
        forecast.see(report)
    assert forecast.left() == 0

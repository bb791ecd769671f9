# SPDX-License-Identifier: Apache-2.0
"""Remaining time of a training, from its schedule and the cost of a step by picture size and number of Gaussians."""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np

from clsplat.arrays import Float64
from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.training.density.adaptive import budget, is_due
from clsplat.training.density.mcmc import wanted
from clsplat.training.supervision.resolution import by_doubling

PRIOR_GROWTH_FACTOR, PRIOR_GROWTH_EXPONENT = 26.0, 0.6
"""Prior of the peak growth: the number of Gaussians that one densification by the paper's rule adds at most.

It is this factor times the initial number of Gaussians to this power. Five scenes of 2,754 to 78,868 points add 0.7 to
1.5 times as many.
"""
GROWTH_RAMP = (0.35, 0.55, 0.75, 0.9)
"""Growth at the first densifications, as fractions of the peak."""
PEAK_DENSIFICATIONS = 3
"""Number of densifications after the ramp in which the growth stays at its peak."""
GROWTH_DECAY_STEPS, GROWTH_FLOOR_FRACTION = 1100.0, 0.2
"""Time constant in steps of the growth's exponential decay, and the fraction of the peak that it decays to. Growth
decays because small Gaussians fall below the gradient threshold."""
RECENT_DENSIFICATIONS = 4
"""Number of latest densifications from which the growth by the next ones is predicted."""
PRIOR_GROWTH_WEIGHT = 0.5
"""Weight of the prior of the peak growth: it counts as much as this many measured densifications at the peak."""
PRIOR_COSTS = np.array([8000.0, 0.6, 1.2, 80_000.0])
"""Prior of the parts of a step's time on CPUs, relative to each other. They are the constant part, then the time per
pixel, per Gaussian, and per photograph that is read."""
PRIOR_COST_WEIGHT_SECONDS = 0.03
"""Weight of the prior costs: they count as much as this many measured seconds."""
OUTLIER_FACTOR = 4.0
"""Steps that took over this many times the usual time are left out, because a kernel was probably built then."""
PACE_WINDOW_SECONDS = 60.0
"""Length in seconds of the period before the last report over which the machine's current speed is measured."""


class TimedStep(Protocol):
    """Fields of a step's report that a forecast reads (`loop.StepReport`)."""

    step: int
    gaussians: int
    seconds: float


class Span(NamedTuple):
    """Consecutive steps with one picture size and one number of Gaussians.

    factor: divisor of the photographs' width and height (`Sizes`).
    reads: number of photographs that these steps read from files, on average if the steps are still to come.
    seconds: measured duration of the steps; 0 if they are still to come.
    """

    factor: float
    gaussians: float
    steps: int
    reads: float
    seconds: float = 0.0


class Forecast:
    """Forecast of the seconds until the end of a training. Call `see` with each report, in order.

    photographs: number of photographs to train on. Each is read once, at its first use, for all sizes.
    pixels: number of pixels of a photograph at full size.
    """

    def __init__(self, config: TrainConfig, photographs: int, pixels: float) -> None:
        self.config, self.photographs, self.pixels = config, photographs, pixels
        self.sizes = by_doubling(config.warmup)
        self.begun: tuple[int, int] | None = None
        self.last: tuple[int, int, float] | None = None
        self.spans: list[Span] = []
        """Done steps, a span from each report to the next."""
        self.amounts: list[tuple[float, ...]] = []
        """Result of `_amounts` for each of `spans`."""
        self.added: list[tuple[int, int]] = []
        """Step of each densification, and the number of Gaussians that it added."""

    def see(self, report: TimedStep) -> None:
        """Record the report of a step."""
        step, count, seconds = report.step, report.gaussians, report.seconds
        if self.last is None or step <= self.last[0]:  # the first report, or the first after a return to a checkpoint
            self.begun, self.last = self.begun or (step, count), (step, count, seconds)
            return
        before, previous, at = self.last
        density = self.config.density
        due = [each for each in range(before, step) if is_due(density, each)]
        self.added += [(each, (count - previous) // len(due)) for each in due]
        reads = self._reads(before, step)
        self.spans.append(Span(self.sizes.factor(step), count, step - before, reads, max(seconds - at, 0.0)))
        self.amounts.append(self._amounts(self.spans[-1]))
        self.last = (step, count, seconds)

    def left(self) -> float | None:
        """Seconds from the last report to the end; None before the second report."""
        if not self.spans or self.last is None:
            return None
        step, count, _ = self.last
        ahead = self._ahead(step, count)
        cost, pace = self._cost()
        return pace * float(sum(span.steps * (cost @ np.array(self._amounts(span))) for span in ahead))

    def _reads(self, before: int, step: int) -> float:
        """Expected number of photographs that the steps after `before` up to `step` read. A photograph is read at its
        first use.

        Each epoch shows every photograph once, in an order that is taken as random. A training may resume in the middle
        of an epoch.
        """
        assert self.begun is not None
        begin = self.begun[0] - 1
        epoch = self.photographs / self.config.batch
        epoch_end = math.ceil(begin / epoch) * epoch
        unseen = 1 - (epoch_end - begin) / epoch  # fraction of the photographs that only the next epoch reads

        def read(until: int) -> float:
            return min(until, epoch_end) - begin + unseen * min(max(until - epoch_end, 0), epoch)

        return self.config.batch * (read(step) - read(max(before, begin)))

    def _ahead(self, step: int, count: int) -> list[Span]:
        """Remaining steps, as spans with one picture size and one number of Gaussians."""
        density, last, number = self.config.density, self.config.iterations, float(count)
        height, peak = self._height()
        bounds = {last, *(each for each, _ in self.sizes.until if step < each < last)}
        bounds |= {each for each in range(step, last) if is_due(density, each)}
        spans, at = [], step
        if is_due(density, step):
            number = self._grown(density, step, number, height, peak)
        for bound in sorted(each for each in bounds if each > step):
            spans.append(Span(self.sizes.factor(bound), number, bound - at, self._reads(at, bound)))
            if is_due(density, bound):
                number = self._grown(density, bound, number, height, peak)
            at = bound
        return spans

    def _grown(self, density: DensityConfig, step: int, number: float, height: float, peak: int) -> float:
        """Predict the number of Gaussians after the densification at step `step`, from their `number` before it.

        height: peak growth of a densification by the paper's rule, in Gaussians.
        peak: step of the densification that has added most so far.
        """
        most = max(density.max_gaussians, number)
        if density.growth == "mcmc":
            return min(wanted(density, step, max(round(number), 1)), most)
        if density.growth == "budget":
            return min(max(budget(density, step, round(number)), number), most)
        return min(max(number + height * _course(density, step, peak), 1.0), most)

    def _height(self) -> tuple[float, int]:
        """Return the peak growth of a densification by the paper's rule, in Gaussians, and the step that has added most
        Gaussians so far."""
        assert self.begun is not None
        taken = self.added[-RECENT_DENSIFICATIONS:]
        peak = max(self.added, key=lambda one: one[1])[0] if self.added else 0
        before = PRIOR_GROWTH_FACTOR * self.begun[1] ** PRIOR_GROWTH_EXPONENT
        added = PRIOR_GROWTH_WEIGHT * before + sum(each for _, each in taken)
        return added / (PRIOR_GROWTH_WEIGHT + sum(_course(self.config.density, step, peak) for step, _ in taken)), peak

    def _amounts(self, span: Span) -> tuple[float, ...]:
        """Amounts (4,) on which the time of a step depends: 1, pixels, Gaussians, photographs read."""
        return 1.0, self.pixels / span.factor**2, span.gaussians, span.reads / span.steps

    def _cost(self) -> tuple[Float64, float]:
        """Fit the time of a step. Returns its parts in seconds (4,): constant, per pixel, per Gaussian, and per read
        photograph. Also returns the factor by which recent steps took longer than the parts predict."""
        spans = self.spans[1:] or self.spans  # without the first span, in which kernels were built
        parts = np.array(self.amounts[-len(spans) :])
        steps, seconds = np.array([(span.steps, span.seconds) for span in spans]).T
        rates = seconds / np.maximum(steps * (parts @ PRIOR_COSTS), 1e-12)
        usual_spans = rates <= OUTLIER_FACTOR * np.median(rates)
        parts, steps, seconds = parts[usual_spans], steps[usual_spans], seconds[usual_spans]
        rate = float(seconds.sum() / max((steps * (parts @ PRIOR_COSTS)).sum(), 1e-12))
        usual = rate * PRIOR_COSTS
        # least squares of relative errors, regularised towards the prior; each cost is at least a tenth of its prior
        weights = np.sqrt(seconds) / np.maximum(parts @ usual, 1e-12)
        strength = math.sqrt(PRIOR_COST_WEIGHT_SECONDS * max(float(seconds.sum()), 1e-9)) / np.maximum(usual, 1e-12)
        rows = np.concatenate([weights[:, None] * parts, np.diag(strength)])
        wanted_ = np.concatenate([weights * seconds / steps, strength * usual])
        cost = np.maximum(np.linalg.lstsq(rows, wanted_, rcond=None)[0], 0.1 * usual)
        recent = np.cumsum(seconds[::-1])[::-1] <= PACE_WINDOW_SECONDS
        recent[-1] = True
        pace = float(seconds[recent].sum() / max((steps * (parts @ cost))[recent].sum(), 1e-12))
        return cost, pace


def _course(density: DensityConfig, step: int, peak: int = 0) -> float:
    """Growth of the model by the densification at step `step`, as a fraction of the peak growth, by the paper's rule.

    peak: step of the densification that has added most so far. Growth does not decay before this step.
    """
    index = step // density.every - density.start // density.every - 1
    if index < len(GROWTH_RAMP):
        return GROWTH_RAMP[max(index, 0)]
    since = min((index - len(GROWTH_RAMP) - PEAK_DENSIFICATIONS) * density.every, step - peak)
    return GROWTH_FLOOR_FRACTION + (1 - GROWTH_FLOOR_FRACTION) * math.exp(-max(since, 0) / GROWTH_DECAY_STEPS)

# SPDX-License-Identifier: Apache-2.0
"""The time that a training still takes: what its schedule has ahead, at the cost of a step by size and by number of
Gaussians."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from clsplat.arrays import Float64
from clsplat.config.training import DensityConfig, TrainConfig
from clsplat.training.density.adaptive import budget, is_due
from clsplat.training.density.mcmc import wanted
from clsplat.training.resolution import by_doubling

FIRST_GROWTH, GROWTH_POWER = 26.0, 0.6
"""Gaussians that a densification by the paper's rule adds at its height, before any was seen: the factor of their
number at the start and its power. Five scenes of 2,754 to 78,868 points add between 0.7 and 1.5 of that."""
RAMP = (0.35, 0.55, 0.75, 0.9)
"""The first densifications, in parts of the height: Gaussians that were split have their gradients to gather first."""
HELD = 3
"""Densifications after these that are at the height."""
FADE, FLOOR = 1100.0, 0.2
"""Steps in which growth that fades falls to 1/e, to this part of its height: what is split enough is under the
threshold."""
TAKEN = 4
"""Latest densifications that tell how much the next ones add."""
BEFORE = 0.5
"""Weight of what is taken before any was seen, in densifications at the height."""
USUAL = np.array([0.75, 0.1, 0.15])
"""Parts of a step's cost at the start, as on CPUs: by pixels, by Gaussians, and by both, as more Gaussians lie over a
pixel."""
TRUST = 0.003
"""Weight of these parts against a measured second, in seconds."""
RECENT = 60.0
"""Seconds whose steps tell how quick the machine is just now."""


class Report(Protocol):
    """A report of a step (`loop.StepReport`)."""

    step: int
    gaussians: int
    seconds: float


class Forecast:
    """Seconds that the rest of a training takes. Call `see` with each report, in order."""

    def __init__(self, config: TrainConfig) -> None:
        self.config = config
        self.sizes = by_doubling(() if config.frequency_steps else config.warmup)
        self.begun: tuple[int, int] | None = None
        self.last: tuple[int, int, float] | None = None
        self.spans: list[tuple[float, float, int, float]] = []
        """Of the steps between two reports: factor of the size, Gaussians, steps, seconds."""
        self.added: list[tuple[int, int]] = []
        """Step of a densification, and what it added."""

    def see(self, report: Report) -> None:
        """Take a report."""
        step, count, seconds = report.step, report.gaussians, report.seconds
        if self.last is None or step <= self.last[0]:  # after a return to a checkpoint
            self.begun, self.last = self.begun or (step, count), (step, count, seconds)
            return
        before, previous, at = self.last
        density = self.config.density
        due = [each for each in range(before, step) if is_due(density, each)]
        self.added += [(each, (count - previous) // len(due)) for each in due]
        self.spans.append((self.sizes.factor(step), count, step - before, max(seconds - at, 0.0)))
        self.last = (step, count, seconds)

    def left(self) -> float | None:
        """Seconds from the last report to the end; None before there are two."""
        if not self.spans or self.last is None:
            return None
        step, count, _ = self.last
        ahead = self._ahead(step, count)
        cost, pace = self._cost()
        return pace * float(sum(steps * (cost @ self._shares(factor, number)) for factor, number, steps in ahead))

    def _ahead(self, step: int, count: int) -> list[tuple[float, float, int]]:
        """The steps that are left, in spans of one size and number: factor, Gaussians, steps."""
        density, last, number = self.config.density, self.config.iterations, float(count)
        height, peak = self._height()
        bounds = {last, *(each for each, _ in self.sizes.until if step < each < last)}
        bounds |= {each for each in range(step, last) if is_due(density, each)}
        spans, at = [], step
        if is_due(density, step):
            number = self._grown(density, step, number, height, peak)
        for bound in sorted(each for each in bounds if each > step):
            spans.append((self.sizes.factor(bound), number, bound - at))
            if is_due(density, bound):
                number = self._grown(density, bound, number, height, peak)
            at = bound
        return spans

    def _grown(self, density: DensityConfig, step: int, number: float, height: float, peak: int) -> float:
        """Gaussians after a densification."""
        most = max(density.max_gaussians, number)
        if density.growth == "mcmc":
            return min(wanted(density, step, max(round(number), 1)), most)
        if density.growth == "budget" and not density.edge_views:
            return min(max(budget(density, step, round(number)), number), most)
        return min(max(number + height * _course(density, step, peak), 1.0), most)

    def _height(self) -> tuple[float, int]:
        """Gaussians that a densification by the paper's rule adds at its height, and the step of the one that has added
        most."""
        assert self.begun is not None
        taken = self.added[-TAKEN:]
        peak = max(self.added, key=lambda one: one[1])[0] if self.added else 0
        before = FIRST_GROWTH * self.begun[1] ** GROWTH_POWER
        added = BEFORE * before + sum(each for _, each in taken)
        return added / (BEFORE + sum(_course(self.config.density, step, peak) for step, _ in taken)), peak

    def _shares(self, factor: float, number: float) -> Float64:
        """The measures of the parts of a step's cost, in those of a step at full size with the first number: (3,)."""
        assert self.begun is not None
        pixels, gaussians = 1 / factor**2, number / max(self.begun[1], 1)
        return np.array([pixels, gaussians, pixels * gaussians])

    def _cost(self) -> tuple[Float64, float]:
        """Seconds of a step by its parts (3,), and the factor by which recent ones took longer."""
        spans = self.spans[1:] or self.spans  # kernels are built in the time of the first
        parts = np.array([self._shares(factor, number) for factor, number, _, _ in spans])
        steps, seconds = (np.array(column, np.float64) for column in list(zip(*spans, strict=True))[2:])
        rate = float(seconds.sum() / max((steps * (parts @ USUAL)).sum(), 1e-12))
        usual = rate * USUAL
        # least squares in relative errors, towards the usual parts, each of which may not be less than a tenth of it
        weights = np.sqrt(seconds) / np.maximum(parts @ usual, 1e-12)
        strength = math.sqrt(TRUST * max(float(seconds.sum()), 1e-9)) / np.maximum(usual, 1e-12)
        rows = np.concatenate([weights[:, None] * parts, np.diag(strength)])
        wanted_ = np.concatenate([weights * seconds / steps, strength * usual])
        cost = np.maximum(np.linalg.lstsq(rows, wanted_, rcond=None)[0], 0.1 * usual)
        recent = np.cumsum(seconds[::-1])[::-1] <= RECENT
        recent[-1] = True
        pace = float(seconds[recent].sum() / max((steps * (parts @ cost))[recent].sum(), 1e-12))
        return cost, pace


def _course(density: DensityConfig, step: int, peak: int = 0) -> float:
    """Growth of a densification by the paper's rule in parts of its height, where it rises up to the step `peak`."""
    index = step // density.every - density.start // density.every - 1
    if index < len(RAMP):
        return RAMP[max(index, 0)]
    since = min((index - len(RAMP) - HELD) * density.every, step - peak)
    return FLOOR + (1 - FLOOR) * math.exp(-max(since, 0) / FADE)

# SPDX-License-Identifier: Apache-2.0
"""A probe that follows a training step for the trainer: what is not finite, what may fail, statistics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from clsplat.device.context import Device
from clsplat.device.launch import only_tried
from clsplat.rendering.rasterizer import Frame, Rasterizer
from clsplat.scenes.scene import View
from clsplat.stages.adam import updates_sh_rest
from clsplat.stages.density import DensityStatistics, add_contributions, add_statistics
from clsplat.stages.loss import Loss
from clsplat.training.density import StatisticsNeeds
from clsplat.training.monitor import LastStep, Watch
from clsplat.training.pending import Pending
from clsplat.training.step import GradientStep, Sample, StepProbe, StepRows, ViewRows


class InTraining(Protocol):
    """A model in training, as far as a step's probe knows of it: a `Trainer`."""

    device: Device
    rasterizer: Rasterizer
    views: list[View]
    statistics: DensityStatistics
    watch: Watch
    pending: Pending
    rehearsed: set[tuple[object, ...]]
    mark: Any


@dataclass(frozen=True, eq=False)
class Watched(StepProbe):
    """Follows a training step: notices what is not finite, rehearses what changes the state, adds the statistics that
    density control goes by. number: of views, this one among them."""

    trainer: InTraining
    step: GradientStep
    number: int
    sample: Sample
    needs: StatisticsNeeds

    def forward(self, frame: Frame) -> None:
        """Take the counts of the step before, which this pass has read back."""
        self.trainer.watch.notice(frame.refused)
        self.trainer.pending.seen(frame)

    def loss(self, result: Loss) -> None:
        """Remember the step, to look at if it turns out to have had trouble."""
        sums = result.copy or result.sums.get
        self.trainer.watch.begin(LastStep(self.number, self.sample.view, self.sample.background, sums))

    def before_rows(self, rows: StepRows) -> None:
        """Before the first row changes, have every kernel rehearsed that changes the state: a driver may fail in
        any."""
        trainer, step, parameters = self.trainer, self.step, rows.parameters
        sh_rest = updates_sh_rest(step.config.optimiser, step.step)
        size = (parameters.count, parameters.coefficients)
        build = (sh_rest, step.fields, rows.slots.first_slots is None, self.needs.gradients)
        key = (*size, *build, *self.sample.camera.kind.defines.items())
        if key not in trainer.rehearsed:
            with only_tried(trainer.device), only_tried(trainer.rasterizer.device), only_tried(rows.device):
                step.update(rows)
                self.add_statistics(trainer.statistics.rows(0, rows.stop - rows.start), rows)
            trainer.rehearsed.add(key)
        trainer.mark = None

    def after_rows(self, rows: ViewRows) -> None:
        """Add the rows to the statistics."""
        self.add_statistics(self.trainer.statistics.rows(rows.start, rows.stop), rows)

    def add_statistics(self, statistics: DensityStatistics, rows: ViewRows) -> None:
        """Add the step to the statistics of some rows, as far as density control needs them."""
        device, camera, screen = self.trainer.device, self.sample.camera, rows.screen
        if self.needs.gradients:
            size, threshold = (camera.width, camera.height, camera.fx), self.needs.threshold
            self.step.replayed(
                statistics,
                (rows.projected, screen.gradients, *size, threshold),
                lambda: add_statistics(device, statistics, camera, rows.projected, screen, threshold),
            )
        if screen.contributions is not None and statistics.current_totals is not None:
            full = self.trainer.views[self.sample.view].camera
            area = full.width * full.height / (camera.width * camera.height)
            add_contributions(device, statistics, rows.projected, screen.contributions, area)

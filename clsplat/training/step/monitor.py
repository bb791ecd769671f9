# SPDX-License-Identifier: Apache-2.0
"""Probe of a training step: non-finite values, trials of kernels in the sandbox, statistics for density control."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from clsplat.device.launch import only_tried
from clsplat.rendering.rasterizer import ForwardPass
from clsplat.stages.density import DensityStatistics, add_contributions, add_statistics, statistics_numbers
from clsplat.stages.loss import Loss
from clsplat.training.density import StatisticsNeeds
from clsplat.training.stability.non_finite import LastStep, NonFiniteMonitor
from clsplat.training.step.gradient_step import GradientStep, StepProbe
from clsplat.training.step.inputs import StepRows, ViewInputs, ViewRows
from clsplat.training.step.speculative_steps import SpeculativeSteps


@dataclass(eq=False)
class StepMonitor(StepProbe):
    """Probe of a step, which finds non-finite values and adds the view's statistics for density control.

    Before the first use of a kernel that changes the model, it also launches the kernel in the sandbox.

    number: number of views that training has used so far, including the views of this step.
    needs: the statistics that this step gathers for density control.
    tried: combinations of array sizes and build settings whose kernels have passed the sandbox; `before_rows` adds this
        step's.
    changes: function that is called before the model changes.
    """

    step: GradientStep
    number: int
    inputs: ViewInputs
    needs: StatisticsNeeds
    statistics: DensityStatistics
    monitor: NonFiniteMonitor
    pending: SpeculativeSteps
    tried: set[tuple[object, ...]]
    changes: Callable[[], None]

    def forward(self, frame: ForwardPass) -> None:
        """Record how many elements `adam` refused in the previous step. The forward pass has read this number back."""
        self.monitor.notice(frame.refused)
        self.pending.seen(frame)

    def loss(self, result: Loss) -> None:
        """Remember the step, to inspect it if non-finite values are found later."""
        sums = result.copy or result.sums.get
        inputs = self.inputs
        self.monitor.begin(LastStep(self.number, inputs.view, inputs.name, inputs.background, sums))

    @property
    def key(self) -> tuple[object, ...]:
        """Key of the launches of `add_statistics` in a command buffer: all that they depend on, except `numbers`."""
        camera = self.inputs.camera
        return (*self.statistics.named().values(), self.needs.gradients, camera.width, camera.height)

    @property
    def numbers(self) -> tuple[float, ...]:
        """Numbers that change from step to step in the launches of `add_statistics` (`LaunchParameter`)."""
        counted = self.step.fields.contributions and self.statistics.current_totals is not None
        of_view = statistics_numbers(self.inputs.camera) if self.needs.gradients else ()
        return (*of_view, self.inputs.area) if counted else of_view

    def before_replay(self) -> None:
        """Tell the trainer that the model is about to change."""
        self.changes()

    def before_rows(self, rows: StepRows) -> None:
        """Try in the sandbox every kernel that changes the model or the statistics, because a driver may fail in any of
        them. Then tell the trainer that the model is about to change."""
        step, parameters = self.step, rows.parameters
        size = (rows.stop - rows.start, parameters.coefficients)
        build = (step.adam_step.updates_sh_rest, step.fields, rows.slots.first_slots is None, self.needs.gradients)
        key = (*size, *build, rows.projected.chunks is None, *self.inputs.camera.model.defines.items())
        if key not in self.tried:
            with only_tried(step.device), only_tried(step.rasterizer.device), only_tried(rows.device):
                step.change(rows, self.inputs)
                self._add_rows(rows)
            self.tried.add(key)
        self.changes()

    def after_rows(self, rows: ViewRows) -> None:
        """Add the rows' gradients and contributions to the density statistics."""
        self._add_rows(rows)

    def _add_rows(self, rows: ViewRows) -> None:
        """Add these rows' gradients and contributions to the statistics that density control needs."""
        device, camera, screen = self.step.device, self.inputs.camera, rows.screen
        statistics, projected = self.statistics, rows.projected
        if projected.chunks is None:
            statistics = statistics.rows(rows.start, rows.stop)
        if self.needs.gradients:
            add_statistics(device, statistics, camera, projected, screen)
        if screen.contributions is not None and statistics.current_totals is not None:
            add_contributions(device, statistics, projected, screen.contributions, self.inputs.area)

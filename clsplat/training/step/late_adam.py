# SPDX-License-Identifier: Apache-2.0
"""Late Adam (--optimiser.late): Gaussians that no view shows miss steps of Adam, and take them when they are next shown
(docs/decisions/0049-late-adam.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.config.training import OptimiserConfig
from clsplat.device.buffers import DeviceArray, allocate, upload
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.optimisation.density_rules import FRESH
from clsplat.optimisation.missed_steps import MOST_MISSED, MissedSteps
from clsplat.rendering.rasterizer import MAX_COUNTED_PASSES, Rasterizer
from clsplat.stages.adam import AdamStep
from clsplat.stages.device_gaussians import AnyGaussians, DeviceGaussians, HostArray, HostGaussians, parts
from clsplat.stages.settle import settle
from clsplat.training.step.component import Component, Named
from clsplat.training.step.inputs import StepRows, ViewInputs, ViewPart

_GROUPS = tuple(PARAMETER_GROUPS)


class LateAdam(Component):
    """Component for late Adam. It keeps the last step that each Gaussian took, and factors for taking missed steps.

    step: number of the last step launched.
    """

    def __init__(self, config: OptimiserConfig, rasterizer: Rasterizer, count: int) -> None:
        self._device, self._config, self._rasterizer = rasterizer.device, config, rasterizer
        self._begin(np.zeros(count, np.uint32), MissedSteps(config, _GROUPS), 0)

    def _begin(self, last: NDArray[np.uint32], missed: MissedSteps, step: int) -> None:
        self._last, self._missed, self.step = upload(self._device, last), missed, step
        self._tables: dict[int, Float32] = {step: missed.rounded()}  # factors by step number, for repeated steps
        self._table = allocate(self._device, self._tables[step].shape, np.float32)

    @property
    def row_bytes(self) -> int:
        """Bytes per Gaussian on the device: the number of the last step that the Gaussian took."""
        return 4

    def is_due(self, step: int, views: int) -> bool:
        """True if all Gaussians must be settled before a step of the training.

        step: number of the last view of this step, counted from the start of the training.
        views: number of views of this step.
        """
        return (step - views) % MOST_MISSED == 0

    def join(self, inputs: Sequence[ViewInputs], step: int, count: int) -> Sequence[ViewInputs]:  # noqa: ARG002
        """Return the views, each with a part that settles the Gaussians that the view shows.

        step, count: number of the step's last view, and number of Gaussians; not used.
        """
        return [replace(each, parts=(*each.parts, _ShownRows(self))) for each in inputs]

    def settle_shown(self, rows: StepRows, step: AdamStep) -> None:
        """Settle the rows that a step's view shows, before Adam's step. A step that is repeated gives the same bits."""
        if step.number > self.step:
            self._missed.add(step.scales)
            self.step = step.number
            self._tables[step.number] = self._missed.rounded()
            self._tables.pop(step.number - MAX_COUNTED_PASSES - 2, None)
        last = self._last.rows(rows.start, rows.stop)
        self._settle(rows.model, step.number - 1, last, rows.projected.tile_counts)

    def complete(self, parameters: AnyGaussians, first: AnyGaussians, second: AnyGaussians) -> None:
        """Settle all Gaussians: take the steps of Adam that they missed, in place."""
        for start, stop, part in parts(self._rasterizer.work, parameters, first, second, keep=True):
            self._settle(part, self.step, self._last.rows(start, stop))

    def _settle(
        self,
        model: tuple[DeviceGaussians, ...],
        step: int,
        last: DeviceArray,
        tile_counts: DeviceArray | None = None,
    ) -> None:
        self._table.send(self._tables[step])
        readback = self._rasterizer.readback
        settle(self._device, self._config, model, step, last, self._table, readback, tile_counts)

    def completed(self, parameters: AnyGaussians, first: AnyGaussians, second: AnyGaussians) -> AnyGaussians:
        """Return the parameters with all rows settled. If rows have missed steps, the result is a copy, so that the
        training keeps its bits."""
        missed = self.step - self._last.get()
        if not missed.any():
            return parameters
        factors, found = self._tables[self.step][missed], {}
        for index, group in enumerate(PARAMETER_GROUPS):
            p, m, v = (model[group].get() for model in (parameters, first, second))
            drift = factors[:, index, 0].reshape(-1, *[1] * (p.ndim - 1))
            with np.errstate(invalid="ignore", over="ignore"):
                moved = p - drift * (m / (np.sqrt(v) + np.float32(self._config.epsilon)))
            found[group] = np.where(np.isfinite(moved), moved, p)
        if isinstance(parameters, HostGaussians):
            return replace(parameters, arrays={group: HostArray(values) for group, values in found.items()})
        return replace(parameters, arrays={group: upload(self._device, values) for group, values in found.items()})

    def rows_moved(self, listed: DeviceArray | HostArray) -> None:
        """Move each row's last step along with the row.

        A fresh row has the last step of its source. Its moments are zero, so that missed steps do not move it.
        """
        self._last = upload(self._device, self._last.get()[listed.get() & ~np.uint32(FRESH)])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of the Gaussians' last steps and of missed steps' factors, keyed by their names in a checkpoint."""
        return {"late/last": self._last.get(), "late/missed": self._missed.factors.copy()}

    def load(self, named: Named, step: int, count: int) -> None:
        """Continue from a checkpoint's arrays. If it has no arrays of late Adam, continue as if all rows had taken
        every step.

        named: function from a prefix to the checkpoint's arrays whose names have this prefix.
        step, count: step and number of Gaussians of the checkpoint.
        Raises ValueError for arrays of another model or step.
        """
        saved, missed = named("late/"), MissedSteps(self._config, _GROUPS)
        last = saved.get("last", np.full(count, step, np.uint32))
        factors = saved.get("missed", missed.factors)
        if last.shape != (count,) or last.dtype != np.uint32 or factors.shape != missed.factors.shape:
            raise ValueError(
                f"late/last is {last.dtype} of shape {last.shape}, expected uint32 of shape ({count},); late/missed "
                f"has shape {factors.shape}, expected {missed.factors.shape}"
            )
        if not np.isfinite(factors).all() or np.any(last > step) or np.any(last + MOST_MISSED < step):
            raise ValueError(f"late/last or late/missed does not belong to step {step}")
        self._begin(last, MissedSteps(self._config, _GROUPS, factors.astype(np.float64)), step)


@dataclass(frozen=True, eq=False)
class _ShownRows(ViewPart):
    """Part of a view that settles the rows that the view shows: it takes the steps of Adam that they missed."""

    late: LateAdam

    changes_rows = True

    def before_adam(self, rows: StepRows, step: AdamStep) -> None:
        """Settle the rows that the view shows, among these rows."""
        self.late.settle_shown(rows, step)

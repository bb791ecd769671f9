# SPDX-License-Identifier: Apache-2.0
"""Monitor of non-finite values: records elements that `adam` refused, and finds the stage at fault and a repair."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray
from clsplat.gaussians import PARAMETER_GROUPS
from clsplat.layouts.columns import REFUSED
from clsplat.stages.device_gaussians import AnyArray, AnyGaussians, rows_at
from clsplat.training.stability import health
from clsplat.training.stability.health import Incident, RetryBudget


@dataclass(eq=False)
class LastStep:
    """Record of a step, to be inspected if non-finite values are found later.

    view, name: index and name of the step's view.
    sums: function that returns the sums of the view's loss. Call it before the next step's loss, which overwrites them.
    others: records of further views of the same step, in a batch.
    """

    step: int
    view: int
    name: str
    background: NDArray[np.float32]
    sums: Callable[[], NDArray[np.float32]]
    others: tuple[LastStep, ...] = ()

    def with_bad_loss(self) -> LastStep | None:
        """The first view of the step whose loss is not finite; None if all losses are finite."""
        return next((one for one in (self, *self.others) if not np.isfinite(one.sums()).all()), None)


@dataclass(frozen=True, eq=False)
class Repair:
    """Repair of a model with non-finite values.

    rows: rows (Gaussians) to keep; None to keep all.
    moments: True to set non-finite moments to zero (`health.finite_or_zero`).
    """

    rows: NDArray[np.uint32] | None
    moments: bool


class NonFiniteMonitor:
    """Monitor of non-finite values in a training.

    readback: device array of `Rasterizer.readback`, whose last values are the numbers of elements that `adam` refused.
    last: record of the latest step whose loss has been launched.
    incidents: incidents that the training has not reported yet.
    latest: the latest incident.
    retries: counts of steps with non-finite values, and of returns to a checkpoint.
    """

    def __init__(self, readback: DeviceArray) -> None:
        self.readback = readback
        self.retries = RetryBudget()
        self.incidents: list[Incident] = []
        self.latest: Incident | None = None
        self.last: LastStep | None = None
        self._noticed: tuple[LastStep, str, int] | None = None

    @property
    def noticed(self) -> bool:
        """True if non-finite values have been recorded that `examine` has not handled yet."""
        return self._noticed is not None

    def forget(self) -> None:
        """Forget the last step and its non-finite values, because the model has been replaced."""
        self.last = self._noticed = None
        self.readback.fill(0)

    def begin(self, view: LastStep) -> None:
        """Remember a view of the current step, once its loss is launched."""
        last = self.last
        same = last is not None and last.step == view.step
        self.last = replace(last, others=(*last.others, view)) if last is not None and same else view

    def notice(self, refused: Sequence[int]) -> None:
        """Record the last step if `adam` refused elements in it. Its loss is then read too, as it may be at fault.

        refused: numbers of elements that `adam` did not update, one for each reason of `REFUSED`.
        """
        if not any(refused) or self._noticed is not None or self.last is None:
            return
        counts = dict(zip(REFUSED, refused, strict=True))
        stage = "parameters" if counts["parameters"] else ("project_grad" if counts["gradients"] else "adam")
        culprit = self.last.with_bad_loss()
        self._noticed = (culprit or self.last, "loss" if culprit else stage, sum(refused))

    def look(self) -> None:
        """Read from the device how many elements `adam` refused, without waiting for the next forward pass."""
        self.notice([int(value) for value in self.readback.get()[-len(REFUSED) :]])

    def loss_failed(self) -> None:
        """Record a non-finite loss. `adam` does not report it if all gradients of Gaussians are finite."""
        if self.last is not None and self._noticed is None:
            self._noticed = (self.last.with_bad_loss() or self.last, "loss", 0)

    def examine(self, models: Mapping[str, AnyGaussians]) -> Repair | None:
        """Find the repair of the non-finite values that `notice` recorded; None if nothing has to be repaired.

        models: the model under "parameters", and its moments under "first" and "second".
        """
        if self._noticed is None:
            return None
        (last, stage, elements), self._noticed = self._noticed, None
        self.readback.fill(0)
        return self._judge(last, stage, elements, {kind: model.arrays for kind, model in models.items()})

    def examine_all(self, models: Mapping[str, Mapping[str, AnyArray]]) -> Repair | None:
        """Check all values of a model, also of Gaussians that no step has updated. Returns the repair, or None.

        models: arrays by parameter group, of the "parameters" and of the moments "first" and "second".
        """
        if self.last is None or self.retries.lost or not np.any(health.examine(models)):
            return None
        return self._judge(self.last, "parameters", 0, models)

    def _judge(
        self, last: LastStep, stage: str, elements: int, models: Mapping[str, Mapping[str, AnyArray]]
    ) -> Repair | None:
        broken, refused = health.examine(models)
        lost = health.lost(stage, broken, refused)
        concerned = np.flatnonzero(broken | refused)
        hopeless = bool(np.mean(lost) > health.MAX_BROKEN_FRACTION)
        self.latest = Incident(
            step=last.step,
            view=last.view,
            name=last.name,
            stage=stage,
            count=len(concerned) or elements,
            done=_done(stage, int(lost.sum()), len(lost), hopeless=hopeless),
            background=last.background,
            gaussians={
                f"{k}/{g}": rows_at(model[g], concerned[: health.MAX_INCIDENT_GAUSSIANS])
                for k, model in models.items()
                for g in PARAMETER_GROUPS
            },
        )
        self.incidents.append(self.latest)
        self.retries.note(last.step, lost=hopeless)
        if hopeless:
            return None
        rows = np.flatnonzero(~lost).astype(np.uint32) if lost.any() else None
        return Repair(rows, moments=bool(refused.any()))


def _done(stage: str, lost: int, count: int, *, hopeless: bool) -> str:
    if hopeless:
        return f"{lost:,} of {count:,} are too many to remove"
    if lost:
        return f"{lost:,} removed"
    return "the Gaussians concerned are not updated" if stage == "loss" else "their moments begin again from zero"

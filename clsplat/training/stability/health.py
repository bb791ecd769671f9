# SPDX-License-Identifier: Apache-2.0
"""Policy for non-finite values: which Gaussians are removed, and when training returns to a checkpoint. No OpenCL.

docs/decisions/0016-never-a-nan.md gives the reasons.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import PARAMETER_GROUPS

MAX_TROUBLED_STEPS = 5
"""Number of steps with non-finite values, among the last TROUBLE_WINDOW_STEPS, at which training goes back to a
checkpoint."""
TROUBLE_WINDOW_STEPS = 100
"""Number of latest steps among which steps with non-finite values are counted."""
MAX_CHECKPOINT_RETURNS = 3
"""Maximum number of returns to a checkpoint. If one more would be needed, training ends with an error."""
RETURN_RATE_FACTOR = 0.5
"""Factor on the learning rates at each return to a checkpoint, for the rest of the run."""
MAX_BROKEN_FRACTION = 0.5
"""Fraction of broken Gaussians above which a model is not repaired: training returns to the last checkpoint at once."""
EXAMINED_ROWS = 1 << 16
"""Number of Gaussians that are examined at a time, which limits the size of copies."""
MAX_INCIDENT_GAUSSIANS = 1000
"""Maximum number of Gaussians that are copied into an incident, to reproduce it."""


class Rows(Protocol):
    """An array with a row for each Gaussian, on the device or the host."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""

    def get_rows(self, start: int, stop: int) -> NDArray[np.float32]:
        """Copy of the rows [start, stop)."""


Model = Mapping[str, Rows]
"""Arrays of the parameters, or of one of their moments, by parameter group."""


def examine(models: Mapping[str, Model]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return two masks (n,): Gaussians with a broken parameter, and Gaussians with a non-finite moment.

    A parameter is broken if it is not finite or over its limit. `adam` also writes a non-finite moment to mark a step
    that it has refused.

    models: the "parameters", and their moments "first" and "second".
    """
    count = models["parameters"]["means"].shape[0]
    broken, refused = np.zeros(count, bool), np.zeros(count, bool)
    for start in range(0, count, EXAMINED_ROWS):
        stop = min(start + EXAMINED_ROWS, count)
        for group, values in models["parameters"].items():
            broken[start:stop] |= _over(values.get_rows(start, stop), PARAMETER_GROUPS[group].limit)
        for values in (*models["first"].values(), *models["second"].values()):
            refused[start:stop] |= _any_in_row(~np.isfinite(values.get_rows(start, stop)))
    return broken, refused


def _over(values: NDArray[np.float32], limit: float) -> NDArray[np.bool_]:
    """Return a mask (n,) of the rows with a value that is not finite, or with an absolute value of at least `limit`."""
    return _any_in_row(~(np.abs(values, out=values) < limit))


def _any_in_row(marks: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask (n,) of the rows in which any of the marks (n, ...) is True."""
    return np.asarray(marks.any(axis=tuple(range(1, marks.ndim))))


def lost(stage: str, broken: NDArray[np.bool_], refused: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask (n,) of the Gaussians to remove. If the loss is not finite, Gaussians whose step was refused are
    not at fault and stay.

    stage: first stage with non-finite values.
    broken: (n,), True for Gaussians with a broken parameter.
    refused: (n,), True for Gaussians whose step `adam` refused.
    """
    return broken if stage == "loss" else broken | refused


def finite_or_zero(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Copy with zeros in place of non-finite values, to repair moments: zero is their initial value."""
    return np.where(np.isfinite(values), values, np.float32(0))


@dataclass(frozen=True, eq=False)
class Incident:
    """Occurrence of non-finite values in a step, and the response to it.

    step, view: number of the step, and index of the view, in which the values arose.
    name: name of the view.
    stage: first stage with non-finite values: "loss", "project_grad", "parameters" or "adam".
    count: number of Gaussians with such values or refused steps; if there are none, number of refused array elements.
    done: the response in words, for messages.
    background: background of the view.
    gaussians: up to MAX_INCIDENT_GAUSSIANS of these Gaussians: arrays by name, such as "parameters/means".
    """

    step: int
    view: int
    name: str
    stage: str
    count: int
    done: str
    background: NDArray[np.float32]
    gaussians: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)

    def __str__(self) -> str:
        concerned = len(self.gaussians.get("parameters/means", ()))
        whose = f"{self.count:,} {'Gaussian' if concerned else 'element'}{'' if self.count == 1 else 's'}"
        what = {
            "loss": "the loss is not finite",
            "project_grad": f"gradients of {whose} are not finite",
            "parameters": f"parameters of {whose} are not finite, or far too large",
            "adam": f"steps or moments of {whose} are not finite",
        }[self.stage]
        return f"step {self.step}, view {self.name}, stage {self.stage}: {what}; {self.done}"


@dataclass
class RetryBudget:
    """Recent steps with non-finite values, and the returns to a checkpoint so far. Checkpoints contain it.

    troubled: numbers of the steps with non-finite values, among the last TROUBLE_WINDOW_STEPS.
    rate_factor: factor on the learning rates, smaller after each return to a checkpoint.
    returns: number of returns to a checkpoint.
    lost: True if too much of the model is broken to continue with it.
    """

    troubled: list[int] = field(default_factory=list)
    rate_factor: float = 1.0
    returns: int = 0
    lost: bool = False

    def note(self, step: int, *, lost: bool = False) -> None:
        """Record a step with non-finite values. lost: True if too much of the model is broken to continue with it."""
        self.troubled = [*(earlier for earlier in self.troubled if step - TROUBLE_WINDOW_STEPS < earlier < step), step]
        self.lost = self.lost or lost

    @property
    def over(self) -> bool:
        """True if training has to go back to a checkpoint."""
        return self.lost or len(self.troubled) >= MAX_TROUBLED_STEPS

    @property
    def spent(self) -> bool:
        """True if no return to a checkpoint is left."""
        return self.returns >= MAX_CHECKPOINT_RETURNS

    def after_return(self) -> RetryBudget:
        """Budget after one more return to a checkpoint."""
        return RetryBudget(rate_factor=RETURN_RATE_FACTOR * self.rate_factor, returns=self.returns + 1)

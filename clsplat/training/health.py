# SPDX-License-Identifier: Apache-2.0
"""Health of a training: answers to numbers that are not finite in Gaussians, steps and runs. Policy only, no OpenCL.

docs/decisions/0016-never-a-nan.md says why it is so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians import GROUPS

PATIENCE = 5
"""Troubled steps among the last WINDOW with which training goes back to a checkpoint."""
WINDOW = 100
RETURNS = 3
"""Times that a run goes back; the next time it stops."""
SMALLER = 0.5
"""Factor on the learning rates at each return, for the rest of the run."""
MOST_LOST = 0.5
"""Share of broken Gaussians beyond which a model is not mended: training goes back at once."""
KEPT = 1000
"""Gaussians of an incident of which a copy is kept."""

Model = Mapping[str, NDArray[np.float32]]
"""Arrays by parameter group, the first axis of each being the Gaussians."""


def examine(parameters: Model, first: Model, second: Model) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The Gaussians with a parameter that is not finite or over its limit (n,), and those with a moment that is not
    finite (n,), which is also `adam`'s mark for a Gaussian that it has refused a step."""
    count = len(parameters["means"])
    broken, refused = np.zeros(count, bool), np.zeros(count, bool)
    for group, values in parameters.items():
        broken |= ~(np.abs(values) < GROUPS[group].limit).reshape(count, -1).all(axis=1)
    for moments in (first, second):
        for values in moments.values():
            refused |= ~np.isfinite(values).reshape(count, -1).all(axis=1)
    return broken, refused


def lost(stage: str, broken: NDArray[np.bool_], refused: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Gaussians to remove. A loss that is not finite is no fault of the Gaussians that got no gradient from it."""
    return broken if stage == "loss" else broken | refused


def finite_or_zero(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """A copy in which what is not finite is zero, as moments begin."""
    return np.where(np.isfinite(values), values, np.float32(0))


@dataclass(frozen=True, eq=False)
class Incident:
    """Something that was not finite. step and view: in which it arose; stage: the first in which it showed ("loss",
    "project_grad", "parameters", "adam"); count: Gaussians concerned, or where there are none elements of arrays; done:
    what was done about it; gaussians: up to KEPT of those concerned, by "parameters/means" and so on."""

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
class Patience:
    """Count of recent trouble, and what earlier trouble has left; a checkpoint has it."""

    troubled: list[int] = field(default_factory=list)
    rate_factor: float = 1.0
    returns: int = 0
    lost: bool = False

    def note(self, step: int, *, lost: bool = False) -> None:
        """Step number `step` had trouble; lost: too much of the model is gone to go on with it."""
        self.troubled = [*(earlier for earlier in self.troubled if step - WINDOW < earlier < step), step]
        self.lost = self.lost or lost

    @property
    def over(self) -> bool:
        """True if it is time to go back."""
        return self.lost or len(self.troubled) >= PATIENCE

    @property
    def spent(self) -> bool:
        """True if going back has been tried often enough."""
        return self.returns >= RETURNS

    def after_return(self) -> Patience:
        """The state that goes on with the model of a checkpoint."""
        return Patience(rate_factor=SMALLER * self.rate_factor, returns=self.returns + 1)

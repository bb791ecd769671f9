# SPDX-License-Identifier: Apache-2.0
"""Density control: strategies decide which Gaussians to copy, remove and change. Policy only, without OpenCL."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.optimisation.density_rules import MarkRules


class StatisticsNeeds(NamedTuple):
    """Statistics that a strategy needs.

    gradients: True for sums of screen-space gradients, number of views, and radii.
    absolute: True if the gradients are sums of the absolute values per pixel (AbsGS).
    contributions: True for contributions to the pictures of an epoch.
    """

    gradients: bool = False
    absolute: bool = False
    contributions: bool = False


class RowList(Protocol):
    """Rows of a model after density control, on the device or the host.

    halves: number of halves at the end: first one half of each split Gaussian, then the other halves.
    """

    @property
    def count(self) -> int:
        """Number of rows."""

    @property
    def halves(self) -> int:
        """Number of rows that are halves."""


class Marker(Protocol):
    """Marks the Gaussians of a model by rules, on the device or host of its arrays."""

    def scores(self, rules: MarkRules) -> Float32:
        """Mean gradients (n,) of the Gaussians that may be densified; negative for the rest."""

    def rows(self, rules: MarkRules) -> RowList:
        """List the rows that the rules produce: retained rows, clones, first halves, second halves."""


class HostCopy(Protocol):
    """An array on the device or the host."""

    def get(self) -> NDArray[Any]:
        """Copy on the host."""


@dataclass(frozen=True, eq=False)
class ModelState:
    """The model as a strategy sees it: `count` Gaussians after `step` steps.

    length_unit, extent: the scene's, in world units.
    parameters: parameter arrays by group.
    statistics: arrays by their names in a checkpoint.
    marker: compares the Gaussians with rules.
    """

    count: int
    step: int
    length_unit: float
    extent: float
    parameters: Mapping[str, HostCopy]
    statistics: Mapping[str, HostCopy]
    rng: np.random.Generator
    marker: Marker


SPLIT_GROUPS = ("means", "quaternions", "log_scales")
"""Parameter groups that halves are computed from, by default."""


@dataclass(frozen=True, eq=False)
class RowPlan:
    """Planned rows of the model.

    rows: (m,) uint32, the source row of each new row; None if all rows stay.
    fresh: (m,) bool, True for rows whose moments start at zero and whose contributions are unknown.
    listed: list from the model's marker, which takes the place of `rows` and `fresh`.
    values: by parameter group, the indices (k,) of new rows whose values change, and these values (k, ...).
    halves: function that computes the values of halves from the groups `halved` of split Gaussians. It is called with
        split Gaussians of one part after the other and False, for their first halves, then again with all and True.
    changes: by group, function that computes new values of rows from those of these rows alone.
    restarted: groups whose moments start at zero in every row.
    new_statistics: True if all statistics except contributions start from zero.
    forget_contributions: True if contributions become unknown in every row.
    """

    rows: NDArray[np.uint32] | None = None
    fresh: NDArray[np.bool_] | None = None
    listed: RowList | None = None
    values: Mapping[str, tuple[NDArray[Any], Float32]] = field(default_factory=dict)
    halves: Callable[[Mapping[str, Float32], bool], Mapping[str, Float32]] | None = None
    halved: tuple[str, ...] = SPLIT_GROUPS
    changes: Mapping[str, Callable[[Float32], Float32]] = field(default_factory=dict)
    restarted: tuple[str, ...] = ()
    new_statistics: bool = False
    forget_contributions: bool = False


class Strategy:
    """Density control of one training. A strategy defines `needs`, `is_due` and `before_step`; the other methods are
    optional."""

    def needs(self, step: int = 0) -> StatisticsNeeds:
        """Statistics that this step has to gather.

        step: from 1; 0 for the statistics that any step needs.
        """
        raise NotImplementedError

    def is_due(self, step: int) -> bool:
        """True if `before_step` may have a plan after `step` steps. The model is repaired before `before_step` runs."""
        raise NotImplementedError

    def before_step(self, model: ModelState) -> RowPlan | None:
        """Plan after `model.step` steps. It is carried out when the next step begins."""
        raise NotImplementedError

    def after_gradient(self, model: ModelState) -> RowPlan | None:  # noqa: ARG002  # most have none
        """Plan at the end of step number `model.step`, after Adam's step."""
        return None

    def at_end(self, model: ModelState) -> RowPlan | None:  # noqa: ARG002
        """Plan for a model at the end of its training."""
        return None

    def rearranged(self, rows: NDArray[np.uint32], fresh: NDArray[np.bool_]) -> None:
        """Called after this strategy's plan, or a repair, has moved rows: row j of the model is the old row rows[j]."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """State of the strategy by name, for a checkpoint."""
        return {}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Load the state from a checkpoint."""

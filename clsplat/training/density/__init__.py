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
from clsplat.optimisation.trained_region import TrainedRegion


class StatisticsNeeds(NamedTuple):
    """Statistics that a strategy needs for each Gaussian.

    gradients: True if it needs sums of screen-space gradients, numbers of views that show the Gaussian, and radii.
    absolute: True if it needs gradients as sums of absolute values per pixel (AbsGS).
    contributions: True if it needs contributions to the pictures of an epoch.
    """

    gradients: bool = False
    absolute: bool = False
    contributions: bool = False


class RowList(Protocol):
    """List of the rows of a model after density control, on the device or the host."""

    @property
    def count(self) -> int:
        """Number of rows."""

    @property
    def halves(self) -> int:
        """Number of rows that are halves of split Gaussians, two of each."""


class Marker(Protocol):
    """Applies density rules to the Gaussians of a model, on the device or the host, where the model's arrays are."""

    def scores(self, rules: MarkRules) -> Float32:
        """Return the mean gradient norms (n,) of the Gaussians that may be densified; negative for the others."""

    def rows(self, rules: MarkRules) -> RowList:
        """List the rows of the model after the rules are applied: remaining rows, clones and halves."""


class HostCopy(Protocol):
    """An array, on the device or the host, that can be copied to the host."""

    def get(self) -> NDArray[Any]:
        """Return a copy of the array in main memory."""


@dataclass(frozen=True, eq=False)
class ModelState:
    """The model as a strategy sees it: `count` Gaussians after `step` steps.

    length_unit, extent: length unit and extent of the scene, in world units.
    parameters: parameter arrays by group.
    statistics: arrays by name (`stages.density.DensityStatistics`).
    rng: random generator of the training.
    marker: applies rules to the Gaussians.
    region: the region in which Gaussians are trained, in the coordinates of their means; None for everywhere. Plans
        leave the other Gaussians as they are.
    """

    count: int
    step: int
    length_unit: float
    extent: float
    parameters: Mapping[str, HostCopy]
    statistics: Mapping[str, HostCopy]
    rng: np.random.Generator
    marker: Marker
    region: TrainedRegion | None = None


SPLIT_GROUPS = ("means", "quaternions", "log_scales")
"""Parameter groups that halves of split Gaussians are computed from, by default."""


@dataclass(frozen=True, eq=False)
class RowPlan:
    """Plan of a strategy: the rows of the new model, and changes of values.

    rows: (m,) uint32, the source row of each new row; None if all rows stay.
    fresh: (m,) bool, True for rows whose moments start at zero and whose contributions are unknown.
    listed: list of rows from the model's marker, in place of `rows` and `fresh`.
    values: by parameter group, the indices (k,) of new rows whose values change, and their new values (k, ...).
    halves: function that computes values of one half of each split Gaussian. Its arguments are the groups `halved` of
        some split Gaussians, and False for first or True for second halves. It is called for all first halves before
        any second half.
    halved: parameter groups that `halves` reads.
    changes: by parameter group, a function from values of some rows to the new values of these rows.
    region: the region in which `changes` apply, in the coordinates of the means; None for everywhere.
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
    region: TrainedRegion | None = None
    restarted: tuple[str, ...] = ()
    new_statistics: bool = False
    forget_contributions: bool = False


class Strategy:
    """Density control of one training. A strategy defines `needs`, `is_due` and `before_step`; the other methods are
    optional."""

    def needs(self, step: int = 0) -> StatisticsNeeds:
        """Return the statistics that step number `step` gathers; for step 0, all statistics that any step gathers."""
        raise NotImplementedError

    def is_due(self, step: int) -> bool:
        """True if `before_step` may return a plan after `step` steps. Non-finite values are then repaired before
        `before_step` is called."""
        raise NotImplementedError

    def before_step(self, model: ModelState) -> RowPlan | None:
        """Return a plan after `model.step` steps, to be carried out when the next step begins; None changes nothing."""
        raise NotImplementedError

    def after_gradient(self, model: ModelState) -> RowPlan | None:  # noqa: ARG002
        """Return a plan at the end of step number `model.step`, after Adam's step; None changes nothing."""
        return None

    def at_end(self, model: ModelState) -> RowPlan | None:  # noqa: ARG002
        """Return a plan for the model at the end of its training; None changes nothing."""
        return None

    def rearranged(self, rows: NDArray[np.uint32], fresh: NDArray[np.bool_]) -> None:
        """Update the strategy's own values of each Gaussian after a plan or a repair has moved rows: row j is the old
        row rows[j].

        fresh: (m,), True for rows of new Gaussians.
        """

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the state of the strategy by name, for a checkpoint."""
        return {}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Load the state from a checkpoint. arrays: as the method `arrays` returned them."""

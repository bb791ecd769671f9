# SPDX-License-Identifier: Apache-2.0
"""Density control: strategies decide which Gaussians are copied, dropped and changed. Policy only, without OpenCL."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.config.exploring import Exploration
from clsplat.config.marking import MarkRules


@dataclass(frozen=True, eq=False)
class StatisticsNeeds:
    """Statistics that a strategy goes by.

    gradients: sums of the gradients on the screen, views and radii; absolute: sums of the gradients' absolute values by
    pixel (AbsGS); agreement: the number of views with a gradient of at least `threshold`; contributions: shares in the
    pictures of an epoch.
    """

    gradients: bool = False
    absolute: bool = False
    agreement: bool = False
    threshold: float = 0.0
    contributions: bool = False


class RowList(Protocol):
    """Rows of a model as they are to become, wherever the list is. halves: how many, at its end, are halves: first
    those of every Gaussian that is split, then as many of the same."""

    @property
    def count(self) -> int:
        """Number of rows."""

    @property
    def halves(self) -> int:
        """Number of rows that are halves."""


class Marker(Protocol):
    """Comparisons of every Gaussian of a model with rules, where its arrays are."""

    def scores(self, rules: MarkRules) -> Float32:
        """Mean gradients (n,) of what may be densified, less than 0 for the rest."""

    def rows(self, rules: MarkRules, scores: Float32 | None = None) -> RowList:
        """List of the rows as they become by the rules: those that stay, clones, first and second halves. scores (n,):
        in place of those that `scores` has."""


class HostCopy(Protocol):
    """An array on the device or the host."""

    def get(self) -> NDArray[Any]:
        """A copy on the host."""


@dataclass(frozen=True, eq=False)
class ModelState:
    """The model of `count` Gaussians after `step` steps, as a strategy sees it. extent: the scene's, in world units;
    parameters by group; statistics by the names that they have in a checkpoint; marker: compares them with rules;
    edges: of so many training views drawn at random, what each Gaussian (n,) adds to the photographs' edges, in
    pixels."""

    count: int
    step: int
    extent: float
    parameters: Mapping[str, HostCopy]
    statistics: Mapping[str, HostCopy]
    rng: np.random.Generator
    marker: Marker
    edges: Callable[[int], Float32] | None = None


def penalties(opacity: float, scale: float, count: int, extent: float) -> Exploration:
    """Weights of the sums over the Gaussians in view, by those of the means over all `count`; scales count in parts of
    the scene's extent (docs/gradients.md, (91))."""
    return Exploration(opacity=opacity / count, scale=scale / (3 * count * extent))


HALVED = ("means", "quaternions", "log_scales")
"""Groups that halves are made by, if no others are told."""


@dataclass(frozen=True, eq=False)
class RowPlan:
    """The rows of the model as they are to become.

    rows (m,) uint32: the row that each is a copy of, None if all stay; fresh (m,) bool: rows whose moments start at
    zero and whose contributions are not known; listed: in place of both, what the model's marker has listed; values: by
    parameter group, the indices of rows that change, counted as they are then, and what they become (k, ...); halves:
    what becomes of a list's halves, by the groups `halved` of what is split; changes: by group, what becomes of
    all of it; restarted: groups whose moments start at zero in every row. new_statistics: all but contributions start
    from zero; forget_contributions: of no row they are known.
    """

    rows: NDArray[np.uint32] | None = None
    fresh: NDArray[np.bool_] | None = None
    listed: RowList | None = None
    values: Mapping[str, tuple[NDArray[Any], Float32]] = field(default_factory=dict)
    halves: Callable[[Mapping[str, Float32]], Mapping[str, Float32]] | None = None
    halved: tuple[str, ...] = HALVED
    changes: Mapping[str, Callable[[Float32], Float32]] = field(default_factory=dict)
    restarted: tuple[str, ...] = ()
    new_statistics: bool = False
    forget_contributions: bool = False


class Strategy:
    """Density control of one training. A strategy defines `needs`, `is_due` and `before_step`, and of the others what
    it has a use for."""

    def needs(self, step: int = 0) -> StatisticsNeeds:
        """Statistics that this step, from 1, has to gather; of step 0: that any step has to."""
        raise NotImplementedError

    def is_due(self, step: int) -> bool:
        """True if `before_step` may have a plan after `step` steps: then the model is looked through first."""
        raise NotImplementedError

    def before_step(self, model: ModelState) -> RowPlan | None:
        """The plan after `model.step` steps, which is carried out as the next one begins."""
        raise NotImplementedError

    def after_gradient(self, model: ModelState) -> RowPlan | None:  # noqa: ARG002  # most have none
        """The plan at the end of step number `model.step`, behind Adam's."""
        return None

    def exploration(self, step: int, means_rate: float, count: int, extent: float) -> Exploration | None:  # noqa: ARG002
        """Penalties and noise of step number `step`, of `count` Gaussians; means_rate, extent: world units."""
        return None

    def at_end(self, model: ModelState) -> RowPlan | None:  # noqa: ARG002
        """The plan for a model whose training is over."""
        return None

    def rearranged(self, rows: NDArray[np.uint32], fresh: NDArray[np.bool_]) -> None:
        """Row j of the model is now what row rows[j] was, by a plan of this strategy or because others were broken."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The strategy's own state by name, for a checkpoint."""
        return {}

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take the state that a checkpoint has."""

# SPDX-License-Identifier: Apache-2.0
"""Rows of a model after density control: their order in space, halves of split Gaussians, and rows outside a region."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.chunks.gathering import NewValues, SourceList, row_entries
from clsplat.chunks.order import ORDERED_ROWS, beside_parents, space_order
from clsplat.device.buffers import DeviceArray
from clsplat.errors import ClsplatError
from clsplat.optimisation.density_rules import FRESH
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.stages.density import DeviceRowList, new_values
from clsplat.stages.device_gaussians import AnyArray, AnyGaussians, rows_at, set_rows_at
from clsplat.stages.region import rows_inside
from clsplat.training.density import RowPlan

Places = NDArray[np.integer[Any]] | slice


@dataclass(frozen=True, eq=False)
class Move:
    """A move of a model's Gaussians to other arrays or chunks.

    rows: for each new row, the old row that it copies, with the bit FRESH set if its Gaussian is new. None keeps all
        rows.
    coefficients: number of SH coefficients after the move; 0 leaves their number unchanged.
    changes: function that is called before the first change of the model.
    values: values that are not copied, for a model in chunks: moments of new Gaussians, and statistics.
    """

    rows: NDArray[np.uint32] | None = None
    coefficients: int = 0
    changes: Callable[[], None] = lambda: None
    values: NewValues = field(default_factory=new_values)

    def count(self, before: int) -> int:
        """Number of Gaussians after the move. before: their number before the move."""
        return before if self.rows is None else len(self.rows)


@dataclass(frozen=True, eq=False)
class MovedRows:
    """The rows of a model after a plan is carried out. Each entry of the plan's list of rows becomes a row.

    rows: (m,) uint32, the source row of each row, with the bit FRESH set if the row is new.
    halves: number of halves of split Gaussians, two of each.
    places: the row that each entry of the plan's list has become. None if the list and the rows have the same order, or
        if `listed` gives the order.
    listed: the plan's list, in the order of the source rows, if the model is large and streamed; otherwise None.
    """

    rows: DeviceArray | NDArray[np.uint32]
    halves: int = 0
    places: NDArray[np.uint32] | None = None
    listed: SourceList | None = None

    def at(self, rows: NDArray[Any]) -> NDArray[Any]:
        """Return the rows of the new model that the entries `rows` of the plan's list have become."""
        places = self.places if self.listed is None else self.listed.by_kind()
        return rows if places is None else places[rows]

    @property
    def halves_at(self) -> tuple[Places, Places]:
        """Rows of the first halves, and rows of the second halves, in the order of the split Gaussians."""
        if self.listed is not None:
            return self.listed.seconds - 1, self.listed.seconds
        count = self.rows.shape[0]
        first, second = slice(count - self.halves, count - self.halves // 2), slice(count - self.halves // 2, count)
        return (first, second) if self.places is None else (self.places[first], self.places[second])


def ordered(plan: RowPlan, parameters: AnyGaussians) -> MovedRows | None:
    """Return the rows that a plan leads to, in the order of the new model; None if no row moves.

    In a model with more than ORDERED_ROWS rows, new rows stand behind the rows that they were copied from. When a model
    exceeds this number for the first time, its rows are sorted along a curve through space (`space_order`).

    parameters: the model before the plan.
    """
    listed, was_large = plan.listed, parameters.count > ORDERED_ROWS
    if plan.rows is not None:
        entries, halves = row_entries(plan.rows, plan.fresh), 0
    elif isinstance(listed, SourceList):
        if listed.count > ORDERED_ROWS and was_large:
            return MovedRows(listed.rows, listed.halves, listed=listed)
        entries, halves = listed.entries(), listed.halves
    elif isinstance(listed, DeviceRowList):
        if listed.count <= ORDERED_ROWS:
            return MovedRows(listed.rows, listed.halves)
        entries, halves = listed.entries(), listed.halves
    else:
        return None
    sources = entries & ~FRESH
    if len(entries) <= ORDERED_ROWS or (was_large and bool((sources[:-1] <= sources[1:]).all())):
        return MovedRows(entries, halves)
    order = beside_parents(sources) if was_large else space_order(parameters["means"].get()[sources])
    places = np.empty_like(order)
    places[order] = np.arange(len(order), dtype=np.uint32)
    return MovedRows(entries[order], halves, places)


def halve(
    parameters: AnyGaussians,
    moved: MovedRows,
    halves: Callable[[Mapping[str, Float32], bool], Mapping[str, Float32]],
    halved: Sequence[str],
    at_once: int,
) -> None:
    """Replace the two copies of each split Gaussian in `parameters` with its halves.

    parameters: the model after its rows have moved, in which each split Gaussian stands twice. Changed in place.
    moved: the rows of this model; its `halves_at` gives the rows of the two copies.
    halves: function that computes the first halves, or with True as second argument the second halves (`RowPlan`).
    halved: parameter groups that `halves` reads.
    at_once: number of split Gaussians whose halves are computed at a time; 0 computes all, so that one copy of each
        array crosses the bus.
    """
    first, second = moved.halves_at
    if at_once == 0:
        split = {group: rows_at(parameters[group], second) for group in halved}
        sides = [halves(split, later) for later in (False, True)]
        for group, values in sides[0].items():
            set_rows_at(parameters[group], both(first, second), np.concatenate([values, sides[1][group]]))
        return
    for places, begin in product((first, second), range(0, moved.halves // 2, at_once)):
        # The rows of the second halves keep copies of the split Gaussians until all first halves are written.
        copies, some = (some_of(each, begin, at_once) for each in (second, places))
        split = {group: rows_at(parameters[group], copies) for group in halved}
        for group, values in halves(split, places is second).items():
            set_rows_at(parameters[group], some, values)


def both(first: Places, second: Places) -> Places:
    """Concatenate the row numbers of first and second halves."""
    if isinstance(first, slice) or isinstance(second, slice):
        return slice(first.start, second.stop)  # type: ignore[union-attr]  # both are
    return np.concatenate([first, second])


def some_of(places: Places, begin: int, count: int) -> Places:
    """Return `count` of the row numbers `places` from index `begin` on, or as many as there are."""
    if isinstance(places, slice):
        return slice(places.start + begin, min(places.start + begin + count, places.stop))
    return places[begin : begin + count]


def drop_outside(means: AnyArray, region: TrainedRegion | None) -> RowPlan | None:
    """Plan to drop the Gaussians outside the region of a training; None if there are none.

    means: (n, 3). region: in their coordinates; None for everywhere.
    """
    if region is None:
        return None
    rows = rows_inside(means, region)
    if not len(rows):
        raise ClsplatError("no Gaussian is left in the region of the training; lower --density.min-opacity")
    return None if len(rows) == means.shape[0] else RowPlan(rows=rows)

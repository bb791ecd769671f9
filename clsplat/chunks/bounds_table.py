# SPDX-License-Identifier: Apache-2.0
"""Bounds of a model's chunks and of groups of chunks. Culling tests groups first, then the chunks of groups in view."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Bool, Float32, Float64
from clsplat.chunks.bounds import GROUP_FACTOR, ChunkBounds, rounded_share

GROUP = 64
"""Number of consecutive chunks in a group, and of groups in a group of the next level."""
MOST_ON_TOP = 2048
"""Maximum number of bounds on the highest level. Testing so many takes about as long as the calls of NumPy for another
level of groups."""
_TERMS = 8
"""Number of rows of `ChunkBounds.terms`."""

Sees = Callable[[ChunkBounds], Bool]
"""Function that returns True (n,) for bounds in view, such as `culling.visible` for a picture."""
Movement = Callable[[NDArray[np.integer]], Float64]
"""Function from numbers of chunks (n,) to the largest changes (2, n) of their means' coordinates and log scales."""


class BoundsTable:
    """Bounds of a model's chunks as they were last measured, and the most by which Gaussians may have moved since.

    The bounds of a group enclose the bounds of its chunks. They are NaN if a chunk's bounds are not finite.

    chunks: number of chunks. A chunk that has not been measured has bounds of NaN, and counts as in view.
    updates: largest number of updates of a parameter between two measurements, each of which rounds the parameter
        (`ChunkBounds.with_rounding`).
    """

    def __init__(self, chunks: int, updates: int) -> None:
        self._updates, self._rounded_share = updates, rounded_share(updates)
        self._counts = [chunks]
        """Numbers of chunks, of groups, of groups of groups and so on."""
        while self._counts[-1] > MOST_ON_TOP:
            self._counts.append(-(-self._counts[-1] // GROUP))
        self._levels = [np.full((_TERMS, -(-count // GROUP), GROUP), np.nan) for count in self._counts]
        """`ChunkBounds.terms` (_TERMS, groups, GROUP) by level, rounding included. Each is padded to whole groups."""
        self._moved = np.zeros((2, *self._levels[0].shape[1:]))
        self._most_moved = np.zeros((2, 1))

    def measure(self, numbers: NDArray[np.uint32], found: Float32) -> None:
        """Store the measured bounds `found` (n, 7) of the chunks `numbers` (n,). `measured_sides` has their order."""
        lowest, highest, largest = np.hsplit(found.astype(np.float64), (3, 6))
        bounds = ChunkBounds.of_sides(lowest, highest, largest[:, 0]).with_rounding(self._updates)
        self._levels[0].reshape(_TERMS, -1)[:, numbers] = bounds.terms
        moved = self._moved.reshape(2, -1)
        moved[:, numbers] = 0.0
        self._most_moved = moved.max(axis=1, initial=0.0, keepdims=True)
        changed = numbers.astype(np.int64)
        for (below, level), count in zip(pairwise(self._levels), self._counts[:-1], strict=True):
            changed = np.unique(changed // GROUP)
            members = np.minimum(_members(changed), count - 1)  # a short last group repeats its last member
            sides = ChunkBounds(below.reshape(_TERMS, -1)[:, members.ravel()])
            lowest, highest = (each.reshape(*members.shape, 3) for each in (sides.lowest, sides.highest))
            deviation = sides.terms[6].reshape(members.shape).max(axis=1)
            around = ChunkBounds.around(lowest.min(axis=1).T, highest.max(axis=1).T, deviation, GROUP_FACTOR)
            level.reshape(_TERMS, -1)[:, changed] = around.terms

    def move(self, numbers: NDArray[np.uint32], steps: Float64) -> None:
        """Record how far training steps may have moved the Gaussians of the chunks `numbers` (n,).

        steps: (2, n or 1), the largest change of a mean's coordinate, and of a log scale.
        """
        moved = self._moved.reshape(2, -1)
        after = moved[:, numbers] + self._rounded_share * steps
        moved[:, numbers] = after
        self._most_moved = np.maximum(self._most_moved, after.max(axis=1, initial=0.0, keepdims=True))

    def seen(
        self, sees: Sees, hidden: Movement | None = None, most_hidden: Float64 | float = 0.0
    ) -> NDArray[np.uint32]:
        """Return the numbers of the chunks for which `sees` is True, rising. Only chunks of groups in view are tested.

        sees: function that tells which bounds are in view.
        hidden: function that returns the largest changes in steps that chunks missed. `move` has not recorded these.
            None if no chunk has missed a step.
        most_hidden: (2, 1), the largest of these changes in any chunk; 0 if no chunk has missed a step.
        """
        most = self._most_moved + self._rounded_share * most_hidden
        near: NDArray[np.int64] | None = None
        """Groups in view whose members are tested next; None for all."""
        with np.errstate(invalid="ignore", over="ignore"):
            for level, count in zip(reversed(self._levels[1:]), reversed(self._counts[1:]), strict=True):
                numbers = _numbers(near, count)
                near = numbers[sees(ChunkBounds(_columns(level, near, numbers), GROUP_FACTOR).widen(*most))]
            numbers = _numbers(near, self._counts[0])
            terms, moved = (_columns(each, near, numbers) for each in (self._levels[0], self._moved))
            if hidden is not None:
                moved += self._rounded_share * hidden(numbers)
            return numbers[sees(ChunkBounds(terms).widen(*moved))].astype(np.uint32)


def _members(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the numbers (n, GROUP) of the members of groups (n,). The last group may list numbers past the end."""
    return GROUP * groups[:, None] + np.arange(GROUP)


def _numbers(groups: NDArray[np.int64] | None, count: int) -> NDArray[np.int64]:
    """Return the numbers (n,) of the members of groups, rising. groups: numbers of the groups, rising; None for all.

    count: number of members of all groups.
    """
    if groups is None:
        return np.arange(count)
    numbers = _members(groups).ravel()
    return numbers if len(numbers) == 0 or numbers[-1] < count else numbers[numbers < count]


def _columns(level: Float64, groups: NDArray[np.int64] | None, numbers: NDArray[np.int64]) -> Float64:
    """Return a copy (k, n) of some columns of a level (k, groups, GROUP), which is padded behind its last column.

    groups: numbers of the groups, rising; None for all. numbers: (n,), numbers of their columns.
    """
    columns = level.copy() if groups is None else level.take(groups, axis=1)
    return columns.reshape(len(level), -1)[:, : len(numbers)]

# SPDX-License-Identifier: Apache-2.0
"""Bounds of a model's chunks and of groups of chunks. Culling tests groups first, then the chunks of groups in view."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Bool, Float32, Float64
from clsplat.chunks.bounds import GROUP_FACTOR, ChunkBounds

GROUP = 64
"""Number of consecutive chunks in a group, and of groups in a group of the next level."""
MOST_ON_TOP = 2048
"""Maximum number of bounds on the highest level. Testing so many takes about as long as the calls of NumPy for another
level of groups."""
_FLOATS = 7
"""Number of floats of a chunk's bounds: lowest (3) and highest coordinates (3) of its means, and largest log scale."""

Sees = Callable[[ChunkBounds], Bool]
"""Function that returns True (n,) for bounds in view, such as `culling.visible` for a picture."""
Movement = Callable[[NDArray[np.integer]], Float64]
"""Function from numbers of chunks (n,) to the largest changes (2, n) of their means' coordinates and log scales."""


class BoundsTable:
    """Bounds of a model's chunks as they were last measured, and the most by which Gaussians may have moved since.

    The bounds of a group enclose the bounds of its chunks. They are NaN if a chunk's bounds are not finite.

    chunks: number of chunks. A chunk that has not been measured has bounds of NaN, and counts as in view.
    """

    def __init__(self, chunks: int) -> None:
        self._levels = [np.full((chunks, _FLOATS), np.nan)]
        while len(self._levels[-1]) > MOST_ON_TOP:
            self._levels.append(np.full((-(-len(self._levels[-1]) // GROUP), _FLOATS), np.nan))
        self._moved = np.zeros((2, chunks))
        self._most_moved = np.zeros((2, 1))

    def measure(self, numbers: NDArray[np.uint32], found: Float32) -> None:
        """Store the measured bounds `found` (n, 7) of the chunks `numbers` (n,); `_FLOATS` has the order of columns."""
        self._levels[0][numbers] = found
        self._moved[:, numbers] = 0.0
        self._most_moved = self._moved.max(axis=1, initial=0.0, keepdims=True)
        changed = numbers.astype(np.int64)
        for below, level in pairwise(self._levels):
            changed = np.unique(changed // GROUP)
            members = below[np.minimum(_members(changed), len(below) - 1)]  # a short last group repeats its last member
            sides = np.hstack([members[:, :, :3].min(axis=1), members[:, :, 3:].max(axis=1)])
            with np.errstate(invalid="ignore"):
                finite = np.isfinite(members.sum(axis=(1, 2)))
            level[changed] = np.where(finite[:, None], sides, np.nan)

    def move(self, numbers: NDArray[np.uint32], steps: Float64) -> None:
        """Record how far training steps may have moved the Gaussians of the chunks `numbers` (n,).

        steps: (2, n or 1), the largest change of a mean's coordinate, and of a log scale.
        """
        self._moved[:, numbers] += steps
        self._most_moved = np.maximum(self._most_moved, self._moved[:, numbers].max(axis=1, initial=0.0, keepdims=True))

    def seen(self, sees: Sees, hidden: Movement, most_hidden: Float64, updates: int) -> NDArray[np.uint32]:
        """Return the numbers of the chunks for which `sees` is True, rising. Only chunks of groups in view are tested.

        sees: function that tells which bounds are in view.
        hidden: function that returns the largest changes in steps that chunks missed. `move` has not recorded these.
        most_hidden: (2, 1), the largest of these changes in any chunk.
        updates: number of updates of a parameter since the oldest measurement (`ChunkBounds.widened`).
        """
        most = self._most_moved + most_hidden
        near = np.arange(len(self._levels[-1]))
        for below, level in reversed(list(pairwise(self._levels))):
            groups = _bounds(level[near], GROUP_FACTOR).widened(most[0], most[1], updates)
            near = _members(near[sees(groups)]).ravel()
            near = near[near < len(below)]
        moved = self._moved[:, near] + hidden(near)
        chunks = _bounds(self._levels[0][near]).widened(moved[0], moved[1], updates)
        return near[sees(chunks)].astype(np.uint32)


def _members(groups: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the numbers (n, GROUP) of the members of groups (n,). The last group may list numbers past the end."""
    return GROUP * groups[:, None] + np.arange(GROUP)


def _bounds(rows: Float64, factor: float = 1.0) -> ChunkBounds:
    return ChunkBounds(rows[:, :3], rows[:, 3:6], rows[:, 6], factor)

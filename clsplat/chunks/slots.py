# SPDX-License-Identifier: Apache-2.0
"""Slots of a scratch file: which of them hold chunks of the model or of kept checkpoints, and which are free."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

NO_SLOT = -1
"""Slot number of a chunk that has not been written. Each field of this chunk has one value in all its elements
(`manifest.CONSTANTS`)."""
MAX_TENTHS = 22
"""Number of slots beyond which old checkpoints are removed before a file grows, in tenths of the number of chunks. 22
allow two copies of each chunk, one for the latest checkpoint and one that later steps change, and a tenth more."""
_GROWTH_SHARE = 16
"""The number of chunks divided by this is the smallest number of slots by which a file grows."""


class SlotTable:
    """Table of the slots of a model's chunks in a file of `size` slots.

    A slot that a kept checkpoint names (`hold`) is not overwritten: when its chunk is written next, the chunk goes to a
    free slot. The lowest free slots are taken first. The file grows only when too few slots are free.

    current: (chunks,) int64, the slot of each chunk of the model; NO_SLOT if it has not been written.
    """

    def __init__(self, current: NDArray[np.int64], size: int) -> None:
        self.current, self.size = current, size
        self._taken = np.zeros(0, np.int64)
        self.hold(())

    @property
    def most(self) -> int:
        """Number of slots beyond which the file grows only after old checkpoints have been removed."""
        return max(MAX_TENTHS * len(self.current) // 10, 1)

    @property
    def free(self) -> int:
        """Number of free slots."""
        return int(np.count_nonzero(~self._used))

    @property
    def end(self) -> int:
        """Number of the last slot in use, plus 1; 0 if all slots are free."""
        return _end(self._used)

    def hold(self, kept: Sequence[NDArray[np.int64]]) -> None:
        """Protect the slots of the kept checkpoints, and no other slots, from being overwritten.

        kept: for each kept checkpoint, an array of its slots.
        """
        self._held, self._named_end = np.zeros(self.size, np.bool_), 0
        for slots in kept:
            self._held[slots[(slots >= 0) & (slots < self.size)]] = True
        self._mark()

    def _mark(self) -> None:
        self._used = self._held.copy()
        self._used[self.current[self.current != NO_SLOT]] = True
        self._used[self._taken] = True

    @property
    def end_of_held(self) -> int:
        """Number of the last slot that a kept checkpoint names, plus 1; 0 without kept checkpoints."""
        return max(_end(self._held), self._named_end)

    def name_current(self) -> None:
        """Include the model's present slots in `end_of_held`, because a new checkpoint will name them. This lasts until
        `hold` is called."""
        self._named_end = int(self.current.max(initial=NO_SLOT)) + 1

    def in_place(self, numbers: NDArray[np.integer[Any]]) -> NDArray[np.bool_]:
        """Return True (k,) for chunks whose own slot may be overwritten. numbers: (k,), the chunks to look up."""
        slots: NDArray[np.int64] = self.current[numbers]
        writable: NDArray[np.bool_] = slots != NO_SLOT
        writable[writable] = ~self._held[slots[writable]]
        return writable

    def needed(self, numbers: NDArray[np.integer[Any]]) -> int:
        """Return the number of free slots that are needed to write the chunks `numbers` (k,)."""
        return int(np.count_nonzero(~self.in_place(numbers)))

    def growth(self, lacking: int) -> int:
        """Return the number of slots to add if `lacking` slots are missing; 0 if the file would exceed `most` slots."""
        if self.size + lacking > self.most:
            return 0
        return min(self.least_growth(lacking), self.most - self.size)

    def least_growth(self, lacking: int) -> int:
        """Return the smallest number of slots by which the file grows if `lacking` slots are missing. It is at least a
        share of the number of chunks (_GROWTH_SHARE), so that the file seldom grows."""
        return max(lacking, len(self.current) // _GROWTH_SHARE)

    def grow(self, slots: int) -> None:
        """Record that the file has `slots` more slots."""
        self.size += slots
        self._held, self._used = (np.append(marks, np.zeros(slots, np.bool_)) for marks in (self._held, self._used))

    def cut(self, size: int) -> None:
        """Record that the file was cut to `size` slots, which include all slots in use."""
        self.size, self._held, self._used = size, self._held[:size], self._used[:size]

    def take(self, count: int) -> NDArray[np.int64]:
        """Reserve `count` free slots for new chunks, until `become` or `give_up` is called. Returns the slots."""
        slots = np.flatnonzero(~self._used)[:count]
        self._taken = np.append(self._taken, slots)
        self._used[slots] = True
        return slots

    def give_up(self) -> None:
        """Free the slots that `take` has reserved."""
        self._taken = self._taken[:0]
        self._mark()

    def become(self, current: NDArray[np.int64]) -> None:
        """Record that the model's chunks are now in the slots `current`. Slots that are no longer used become free."""
        self.current = current
        self.give_up()

    def targets(self, numbers: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
        """Return the slots (k,) to write the chunks `numbers` (k,) to. Enough slots must be free (`needed`)."""
        slots: NDArray[np.int64] = self.current[numbers]
        moving = ~self.in_place(numbers)
        slots[moving] = np.flatnonzero(~self._used)[: np.count_nonzero(moving)]
        return slots

    def written(self, numbers: NDArray[np.integer[Any]], slots: NDArray[np.int64]) -> None:
        """Record that the chunks `numbers` (k,) have been written to `slots` (k,)."""
        self.current[numbers], self._used[slots] = slots, True


def _end(marks: NDArray[np.bool_]) -> int:
    """Return one more than the last index that is True; 0 if none is."""
    return int(np.flatnonzero(marks)[-1]) + 1 if marks.any() else 0

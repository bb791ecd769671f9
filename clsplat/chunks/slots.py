# SPDX-License-Identifier: Apache-2.0
"""Which slots of a scratch file have the chunks of a model and of its kept checkpoints, and which are free."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

NO_SLOT = -1
"""Slot of a chunk that has not been written: all its elements are zero."""
MAX_TENTHS = 22
"""Most slots of a file, in tenths of the chunks. Two copies of each chunk are always within it: one that the latest
checkpoint names, and one for the steps since."""
_GROWTH_SHARE = 16
"""A file grows by one in this many of the chunks, and at least by what is needed."""


class SlotTable:
    """Slots of the chunks of a model in a file of `size` slots.

    current: (chunks,) int64, the slot of each chunk.

    A slot that a kept checkpoint names (`hold`) is not written again: its chunk goes to a free slot when it is next
    written. The lowest free slots are taken first, so that the file grows only when none is free.
    """

    def __init__(self, current: NDArray[np.int64], size: int) -> None:
        self.current, self.size = current, size
        self._taken = np.zeros(0, np.int64)
        self.hold(())

    @property
    def most(self) -> int:
        """Most slots that the file is to have."""
        return max(MAX_TENTHS * len(self.current) // 10, 1)

    @property
    def free(self) -> int:
        """Number of free slots."""
        return int(np.count_nonzero(~self._used))

    @property
    def end(self) -> int:
        """One more than the last slot that is not free; 0 if all are."""
        return _end(self._used)

    def hold(self, kept: Sequence[NDArray[np.int64]]) -> None:
        """Keep the slots of these checkpoints, and no longer those of others."""
        self._held = np.zeros(self.size, np.bool_)
        for slots in kept:
            self._held[slots[(slots >= 0) & (slots < self.size)]] = True
        self._mark()

    def _mark(self) -> None:
        self._used = self._held.copy()
        self._used[self.current[self.current != NO_SLOT]] = True
        self._used[self._taken] = True

    @property
    def end_of_held(self) -> int:
        """One more than the last slot that a checkpoint names; 0 if none is named."""
        return _end(self._held)

    def in_place(self, numbers: NDArray[np.integer[Any]]) -> NDArray[np.bool_]:
        """True for each chunk whose slot may be written again."""
        slots: NDArray[np.int64] = self.current[numbers]
        writable: NDArray[np.bool_] = slots != NO_SLOT
        writable[writable] = ~self._held[slots[writable]]
        return writable

    def needed(self, numbers: NDArray[np.integer[Any]]) -> int:
        """Number of free slots that it takes to write these chunks."""
        return int(np.count_nonzero(~self.in_place(numbers)))

    def growth(self, lacking: int) -> int:
        """Slots by which the file is to grow if so many are lacking; 0 if it would be larger than it may be."""
        if self.size + lacking > self.most:
            return 0
        return min(max(lacking, len(self.current) // _GROWTH_SHARE), self.most - self.size)

    def grow(self, slots: int) -> None:
        """Note that the file has so many more slots."""
        self.size += slots
        self._held, self._used = (np.append(marks, np.zeros(slots, np.bool_)) for marks in (self._held, self._used))

    def cut(self, size: int) -> None:
        """Note that the file has only so many slots left, of which `end` is not behind the last."""
        self.size, self._held, self._used = size, self._held[:size], self._used[:size]

    def take(self, count: int) -> NDArray[np.int64]:
        """Slots for chunks that are not yet of the model. They are not free until `become` or `give_up`."""
        slots = np.flatnonzero(~self._used)[:count]
        self._taken = np.append(self._taken, slots)
        self._used[slots] = True
        return slots

    def give_up(self) -> None:
        """Let the slots that were taken be free again."""
        self._taken = self._taken[:0]
        self._mark()

    def become(self, current: NDArray[np.int64]) -> None:
        """Let the model have other chunks, in these slots. The others that were taken are free."""
        self.current = current
        self.give_up()

    def targets(self, numbers: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
        """The slots to write these chunks to. None may be lacking."""
        slots: NDArray[np.int64] = self.current[numbers]
        moving = ~self.in_place(numbers)
        slots[moving] = np.flatnonzero(~self._used)[: np.count_nonzero(moving)]
        return slots

    def written(self, numbers: NDArray[np.integer[Any]], slots: NDArray[np.int64]) -> None:
        """Note that these chunks have been written to these slots."""
        self.current[numbers], self._used[slots] = slots, True


def _end(marks: NDArray[np.bool_]) -> int:
    """One more than the last place that is marked; 0 if none is."""
    return int(np.flatnonzero(marks)[-1]) + 1 if marks.any() else 0

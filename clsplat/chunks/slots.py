# SPDX-License-Identifier: Apache-2.0
"""Slots of a scratch file: which of them hold chunks of the model or of kept checkpoints, and which are free."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

NO_SLOT = -1
"""Slot number of a chunk that has not been written. Each field of such a chunk has one value in all elements."""
MAX_TENTHS = 22
"""Maximum number of slots of a file, in tenths of the number of chunks. It has room for two copies of each chunk: one
of the latest checkpoint, and one that later steps change."""
_GROWTH_SHARE = 16
"""A file grows by the number of chunks divided by this, or by more if more slots are needed."""


class SlotTable:
    """Table of the slots of a model's chunks in a file of `size` slots.

    A slot that a kept checkpoint names (`hold`) is not overwritten: when its chunk is written next, the chunk goes to a
    free slot. The lowest free slots are taken first. The file grows only when no slot is free.

    current: (chunks,) int64, the slot of each chunk of the model.
    """

    def __init__(self, current: NDArray[np.int64], size: int) -> None:
        self.current, self.size = current, size
        self._taken = np.zeros(0, np.int64)
        self.hold(())

    @property
    def most(self) -> int:
        """Maximum number of slots, beyond which old checkpoints are removed first."""
        return max(MAX_TENTHS * len(self.current) // 10, 1)

    @property
    def free(self) -> int:
        """Number of free slots."""
        return int(np.count_nonzero(~self._used))

    @property
    def end(self) -> int:
        """One more than the last slot that is in use; 0 if all slots are free."""
        return _end(self._used)

    def hold(self, kept: Sequence[NDArray[np.int64]]) -> None:
        """Protect the slots that these checkpoints name from being overwritten, and no other slots."""
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
        """One more than the last slot that a kept checkpoint names; 0 if none names one."""
        return max(_end(self._held), self._named_end)

    def name_current(self) -> None:
        """Count the present slots in `end_of_held`, as a checkpoint is about to name them. `hold` ends that."""
        self._named_end = int(self.current.max(initial=NO_SLOT)) + 1

    def in_place(self, numbers: NDArray[np.integer[Any]]) -> NDArray[np.bool_]:
        """Return True for each chunk whose own slot may be overwritten."""
        slots: NDArray[np.int64] = self.current[numbers]
        writable: NDArray[np.bool_] = slots != NO_SLOT
        writable[writable] = ~self._held[slots[writable]]
        return writable

    def needed(self, numbers: NDArray[np.integer[Any]]) -> int:
        """Return the number of free slots that are needed to write these chunks."""
        return int(np.count_nonzero(~self.in_place(numbers)))

    def growth(self, lacking: int) -> int:
        """Return by how many slots the file should grow if `lacking` are missing; 0 if it would exceed `most`."""
        if self.size + lacking > self.most:
            return 0
        return min(self.least_growth(lacking), self.most - self.size)

    def least_growth(self, lacking: int) -> int:
        """Return by how many slots the file grows at least at a time, so that it seldom grows."""
        return max(lacking, len(self.current) // _GROWTH_SHARE)

    def grow(self, slots: int) -> None:
        """Record that the file has `slots` more slots."""
        self.size += slots
        self._held, self._used = (np.append(marks, np.zeros(slots, np.bool_)) for marks in (self._held, self._used))

    def cut(self, size: int) -> None:
        """Record that the file was cut to `size` slots, at least `end`."""
        self.size, self._held, self._used = size, self._held[:size], self._used[:size]

    def take(self, count: int) -> NDArray[np.int64]:
        """Reserve free slots for new chunks, until `become` or `give_up`."""
        slots = np.flatnonzero(~self._used)[:count]
        self._taken = np.append(self._taken, slots)
        self._used[slots] = True
        return slots

    def give_up(self) -> None:
        """Free the slots that `take` has reserved."""
        self._taken = self._taken[:0]
        self._mark()

    def become(self, current: NDArray[np.int64]) -> None:
        """Replace the model's chunks by those in these slots. Slots that are no longer used become free."""
        self.current = current
        self.give_up()

    def targets(self, numbers: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
        """Return the slots to write these chunks to. There must be enough free slots (`needed`)."""
        slots: NDArray[np.int64] = self.current[numbers]
        moving = ~self.in_place(numbers)
        slots[moving] = np.flatnonzero(~self._used)[: np.count_nonzero(moving)]
        return slots

    def written(self, numbers: NDArray[np.integer[Any]], slots: NDArray[np.int64]) -> None:
        """Record that these chunks have been written to these slots."""
        self.current[numbers], self._used[slots] = slots, True


def _end(marks: NDArray[np.bool_]) -> int:
    """Return one more than the last index that is True; 0 if none is."""
    return int(np.flatnonzero(marks)[-1]) + 1 if marks.any() else 0

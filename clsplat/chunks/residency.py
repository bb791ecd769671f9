# SPDX-License-Identifier: Apache-2.0
"""Which chunks of a model are on the device: the latest that steps have used."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CROSSING_SHARE = 8
"""One in this many slots, and at least one, may cross the bus at once: memory for as many records is set aside."""
_NOTHING = -1
"""Number of the chunk in a free slot, and slot of a chunk that is not on the device."""


@dataclass(frozen=True, eq=False)
class Moves:
    """Moves that a step waits for, so that it can use some chunks.

    slots: (k,) uint32, the slot of each of these chunks.
    fetched, fetched_to: the chunks among them that are not on the device yet, and their slots.
    evicted, evicted_from: the chunks that have been in these slots, and their slots.
    """

    slots: NDArray[np.uint32]
    fetched: NDArray[np.int64]
    fetched_to: NDArray[np.uint32]
    evicted: NDArray[np.int64]
    evicted_from: NDArray[np.uint32]


class Residency:
    """The chunks that are in `slots` slots on the device, of a model of `chunks` chunks.

    What is where has no influence on any result, only on what moves.
    """

    def __init__(self, slots: int, chunks: int) -> None:
        self.slots = slots
        self._slot_of = np.full(chunks, _NOTHING, np.int64)
        self._chunk_in = np.full(slots, _NOTHING, np.int64)
        self._used = np.full(slots, -1, np.int64)
        """By slot, the number of the use at which it was last wanted."""
        self._uses = 0

    def place(self, numbers: NDArray[np.integer[Any]]) -> Moves:
        """Give each of these chunks a slot; those that have not been used for longest make room.

        Raises ValueError for more chunks than slots.
        """
        if len(numbers) > self.slots:
            raise ValueError(f"numbers: {len(numbers)} chunks, expected at most {self.slots}")
        self._uses += 1
        held = self._slot_of[numbers]
        self._used[held[held != _NOTHING]] = self._uses
        fetched = np.asarray(numbers, np.int64)[held == _NOTHING]
        to = np.sort(np.argsort(self._used, kind="stable")[: len(fetched)])
        leaving = to[self._chunk_in[to] != _NOTHING]
        evicted = self._chunk_in[leaving]
        self._slot_of[evicted] = _NOTHING
        self._slot_of[fetched], self._chunk_in[to], self._used[to] = to, fetched, self._uses
        slots = self._slot_of[numbers].astype(np.uint32)
        return Moves(slots, fetched, to.astype(np.uint32), evicted, leaving.astype(np.uint32))

    def held(self) -> tuple[NDArray[np.int64], NDArray[np.uint32]]:
        """The chunks on the device, in rising order, and their slots."""
        numbers = np.flatnonzero(self._slot_of != _NOTHING)
        return numbers, self._slot_of[numbers].astype(np.uint32)

    def slots_of(self, numbers: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
        """The slot of each chunk, -1 if it is not on the device."""
        slots: NDArray[np.int64] = self._slot_of[numbers]
        return slots

    def clear(self) -> None:
        """Forget all chunks."""
        self._slot_of[:] = self._chunk_in[:] = _NOTHING
        self._used[:] = -1

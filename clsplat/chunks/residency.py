# SPDX-License-Identifier: Apache-2.0
"""Which chunks of a model are on the device: those that were used last."""

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

    slots: (k,) uint32, the slot that each of these chunks has or gets.
    fetched, fetched_to: the chunks among them that are not on the device yet, and the slots that they get.
    evicted, evicted_from: the chunks that are in these slots until then, and their slots.
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
        self._used = np.zeros(slots, np.int64)
        """By slot, the number of its last use; 0 if it has had no chunk."""
        self._uses = 0

    def plan(self, numbers: NDArray[np.integer[Any]]) -> Moves:
        """Plan moves for these chunks; those that have not been used for longest make room.

        Nothing changes until `evict` and `use`, so that after a move that fails it is still known what is where.
        Raises ValueError for more chunks than slots.
        """
        if len(numbers) > self.slots:
            raise ValueError(f"numbers: {len(numbers)} chunks, expected at most {self.slots}")
        slots, used = self._slot_of[numbers], self._used.copy()
        missing = slots == _NOTHING
        used[slots[~missing]] = self._uses + 1  # none of these makes room
        to = np.sort(np.argsort(used, kind="stable")[: np.count_nonzero(missing)])
        slots[missing] = to
        leaving = to[self._chunk_in[to] != _NOTHING]
        fetched = np.asarray(numbers, np.int64)[missing]
        by_slot = [each.astype(np.uint32) for each in (slots, to, leaving)]
        return Moves(by_slot[0], fetched, by_slot[1], self._chunk_in[leaving], by_slot[2])

    def evict(self, moves: Moves) -> None:
        """Note that the evicted chunks have left: their slots are free."""
        self._slot_of[moves.evicted] = self._chunk_in[moves.evicted_from] = _NOTHING

    def use(self, moves: Moves) -> None:
        """Note that the fetched chunks have come, and that all chunks of the plan are used."""
        self._uses += 1
        self._slot_of[moves.fetched], self._chunk_in[moves.fetched_to] = moves.fetched_to, moves.fetched
        self._used[moves.slots] = self._uses

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
        self._used[:] = 0

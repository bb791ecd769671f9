# SPDX-License-Identifier: Apache-2.0
"""Cache policy of a streamed model: which chunks are on the device. The least recently used chunks leave it first."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CROSSING_SHARE = 8
"""The number of slots divided by this, at least 1, is the number of chunks that are copied to or from the device at a
time. The device has memory for their records in addition to the slots."""
_NOTHING = -1
"""Stands for the chunk in a free slot, and for the slot of a chunk that is not on the device."""


@dataclass(frozen=True, eq=False)
class Moves:
    """Copies between store and device that bring the chunks of a step to the device.

    slots: (k,) uint32, the slot that each chunk of the step has after the copies.
    fetched, fetched_to: numbers of the chunks to copy to the device, and the slots that they get.
    evicted, evicted_from: numbers of the chunks that leave the device to make room, and the slots that they had.
    """

    slots: NDArray[np.uint32]
    fetched: NDArray[np.int64]
    fetched_to: NDArray[np.uint32]
    evicted: NDArray[np.int64]
    evicted_from: NDArray[np.uint32]


class Residency:
    """Record of which chunks of a model are in which slots on the device.

    Results do not depend on the slots; only the number of copies does.

    slots, chunks: number of slots on the device, and of chunks of the model.
    """

    def __init__(self, slots: int, chunks: int) -> None:
        self.slots = slots
        self._slot_of = np.full(chunks, _NOTHING, np.int64)
        self._chunk_in = np.full(slots, _NOTHING, np.int64)
        self._used = np.zeros(slots, np.int64)
        """By slot, the number of its last use; 0 if it has had no chunk."""
        self.uses = 0
        """Number of calls of `use`."""

    def plan(self, numbers: NDArray[np.integer[Any]]) -> Moves:
        """Plan the copies that bring the chunks `numbers` (k,) to the device, in place of the least recently used.

        Only `evict` and `use` change the record, so that it stays right if a copy fails. Raises ValueError for more
        chunks than slots.
        """
        if len(numbers) > self.slots:
            raise ValueError(f"numbers: {len(numbers)} chunks, expected at most {self.slots}, the number of slots")
        return self._plan(np.asarray(numbers, np.int64))

    def plan_ahead(self, numbers: NDArray[np.integer[Any]], before: int) -> Moves:
        """Plan as `plan` does, but only in place of chunks that were last used at `uses` = `before` or earlier.

        If these are too few, the plan leaves out the last of the chunks that are not on the device.
        """
        numbers = np.asarray(numbers, np.int64)
        there = self._slot_of[numbers] != _NOTHING
        old = self._used <= before
        old[self._slot_of[numbers[there]]] = False
        return self._plan(numbers[there | (np.cumsum(~there) <= np.count_nonzero(old))])

    def _plan(self, numbers: NDArray[np.int64]) -> Moves:
        slots = self._slot_of[numbers]
        missing = slots == _NOTHING
        to = np.zeros(0, np.int64)
        if lacking := int(np.count_nonzero(missing)):
            used = self._used.copy()
            used[slots[~missing]] = self.uses + 1  # chunks of this step count as used last, and are not evicted
            age = used * self.slots + np.arange(self.slots)  # of slots that were last used together, the first ones
            to = np.sort(np.argpartition(age, lacking - 1)[:lacking])
            slots[missing] = to
        leaving = to[self._chunk_in[to] != _NOTHING]
        fetched = numbers[missing]
        by_slot = [each.astype(np.uint32) for each in (slots, to, leaving)]
        return Moves(by_slot[0], fetched, by_slot[1], self._chunk_in[leaving], by_slot[2])

    def evict(self, moves: Moves) -> None:
        """Record that the evicted chunks of a plan have left the device, so that their slots are free."""
        self._slot_of[moves.evicted] = self._chunk_in[moves.evicted_from] = _NOTHING

    def use(self, moves: Moves) -> None:
        """Record that the fetched chunks of a plan are on the device, and that all chunks of the plan are used now."""
        self.uses += 1
        self._slot_of[moves.fetched], self._chunk_in[moves.fetched_to] = moves.fetched_to, moves.fetched
        self._used[moves.slots] = self.uses

    def held(self) -> tuple[NDArray[np.int64], NDArray[np.uint32]]:
        """Return the numbers of the chunks on the device, in rising order, and their slots."""
        numbers = np.flatnonzero(self._slot_of != _NOTHING)
        return numbers, self._slot_of[numbers].astype(np.uint32)

    def slots_of(self, numbers: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
        """Return the slots of the chunks `numbers`; -1 for a chunk that is not on the device."""
        slots: NDArray[np.int64] = self._slot_of[numbers]
        return slots

    def clear(self) -> None:
        """Record that no chunk is on the device."""
        self._slot_of[:] = self._chunk_in[:] = _NOTHING
        self._used[:] = 0

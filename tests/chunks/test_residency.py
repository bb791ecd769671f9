# SPDX-License-Identifier: Apache-2.0
"""Which chunks are on the device, against a model of a few lines, over random calls."""

from __future__ import annotations

import numpy as np
import pytest
from calls import refuses

from clsplat.chunks.residency import Moves, Residency


class Plain:
    """Chunks by slot, and the number of each slot's last use."""

    def __init__(self, slots: int) -> None:
        self.chunks: list[int | None] = [None] * slots
        self.used = [0] * slots
        self.uses = 0

    def place(self, numbers: list[int]) -> tuple[list[int], set[int]]:
        """The slot of each chunk, and the chunks that leave."""
        self.uses += 1
        kept = [slot for slot, chunk in enumerate(self.chunks) if chunk in numbers]
        others = sorted(
            (slot for slot in range(len(self.chunks)) if slot not in kept), key=lambda slot: self.used[slot]
        )
        fetched = [number for number in numbers if number not in self.chunks]
        taken = sorted(others[: len(fetched)])
        left = {chunk for slot in taken if (chunk := self.chunks[slot]) is not None}
        for slot, number in zip(taken, fetched, strict=True):
            self.chunks[slot] = number
        slots = [self.chunks.index(number) for number in numbers]
        for slot in slots:
            self.used[slot] = self.uses
        return slots, left


def place(residency: Residency, numbers: list[int]) -> Moves:
    moves = residency.plan(np.array(numbers, np.int64))
    residency.evict(moves)
    residency.use(moves)
    return moves


@pytest.mark.parametrize("slots", [1, 2, 5, 8])
def test_the_chunks_used_last_stay(slots: int) -> None:
    rng, chunks = np.random.default_rng(slots), 8
    residency, plain = Residency(slots, chunks), Plain(slots)
    for call in range(400):
        if call % 97 == 96:
            residency.clear()
            plain = Plain(slots)
        numbers = np.sort(rng.permutation(chunks)[: rng.integers(slots + 1)]).tolist()
        before = dict(zip(*(each.tolist() for each in residency.held()), strict=True))
        moves = place(residency, numbers)
        wanted, left = plain.place(numbers)
        assert moves.slots.tolist() == wanted
        assert set(moves.evicted.tolist()) == left
        assert not left & set(numbers), "a chunk that the call wants leaves"
        assert moves.fetched.tolist() == [number for number in numbers if number not in before]
        assert moves.fetched_to.tolist() == [wanted[numbers.index(number)] for number in moves.fetched]
        assert [before[chunk] for chunk in moves.evicted.tolist()] == moves.evicted_from.tolist()
        assert set(moves.evicted_from.tolist()) <= set(moves.fetched_to.tolist())
        held, of_held = residency.held()
        assert held.tolist() == sorted(chunk for chunk in plain.chunks if chunk is not None)
        assert [plain.chunks[slot] for slot in of_held] == held.tolist()
        assert len(held) <= slots
        assert residency.slots_of(np.arange(chunks)).tolist() == [
            plain.chunks.index(chunk) if chunk in plain.chunks else -1 for chunk in range(chunks)
        ]


def test_a_plan_changes_nothing() -> None:
    """And where the fetch fails after the eviction, the slots are free."""
    residency = Residency(2, 5)
    place(residency, [0, 3])
    moves = residency.plan(np.array([3, 4]))
    assert (moves.evicted.tolist(), moves.fetched.tolist()) == ([0], [4])
    assert residency.held()[0].tolist() == [0, 3]
    residency.evict(moves)
    assert residency.held()[0].tolist() == [3]
    assert residency.plan(np.array([1])).evicted.tolist() == []


def test_more_chunks_than_slots() -> None:
    refuses("numbers: 3 chunks, expected at most 2", Residency(2, 5).plan, np.arange(3), error=ValueError)


@pytest.mark.parametrize("slots", [1, 2, 5, 8])
def test_what_was_used_since_stays(slots: int) -> None:
    """Chunks that come ahead take the slots of others, as many as there are."""
    rng, chunks = np.random.default_rng(slots), 8
    residency = Residency(slots, chunks)
    for _ in range(200):
        before, lately = residency.uses, set()
        for _ in range(rng.integers(3)):
            numbers = np.sort(rng.permutation(chunks)[: rng.integers(slots + 1)])
            place(residency, numbers.tolist())
            lately |= set(numbers.tolist())
        held = dict(zip(*(each.tolist() for each in residency.held()), strict=True))
        used = {held[number] for number in lately if number in held}
        expected = np.sort(rng.permutation(chunks)[: rng.integers(slots + 1)])
        moves = residency.plan_ahead(expected, before)
        missing = [number for number in expected.tolist() if number not in held]
        others = set(range(slots)) - used - {held[number] for number in expected.tolist() if number in held}
        assert moves.fetched.tolist() == missing[: len(others)]
        assert set(moves.fetched_to.tolist()) <= others
        residency.evict(moves)
        residency.use(moves)
        assert (residency.slots_of(moves.fetched) == moves.fetched_to).all()

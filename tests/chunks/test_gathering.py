# SPDX-License-Identifier: Apache-2.0
"""Rows of a store that move, in lists and records; and the rows at single places of a store."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import peak_of
from wide import full

from clsplat.chunks import gathering
from clsplat.chunks.division import NEW, Division, chunks_of
from clsplat.chunks.gathering import NewValues, OldChunks, SourceList, gathered, in_source_order, row_entries
from clsplat.chunks.order import beside_parents
from clsplat.chunks.slot_file import SlotFile
from clsplat.chunks.store import ChunkStore
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.optimisation.density_rules import FRESH

ROWS = 5 * CHUNK_ROWS + 77
FIELDS: dict[str, tuple[int, ...]] = {
    "parameters/a": (3,),
    "parameters/sh": (2, 3),
    "first/a": (),
    "second/none": (0, 3),
}


@pytest.fixture(params=["memory", "file"])
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path | None:
    return tmp_path / "x.chunks" if request.param == "file" else None


def filled(path: Path | None, count: int = ROWS, *, wide: bool = False) -> tuple[ChunkStore, dict[str, np.ndarray]]:
    """A store of numbers that are all different, and these. wide: with room for more coefficients."""
    widest = {**FIELDS, "parameters/sh": (5, 3), "second/none": (2, 3)} if wide else None
    made, rng = ChunkStore(count, FIELDS, path, widest=widest), np.random.default_rng(0)
    host = {name: rng.normal(size=(count, *shape)).astype(np.float32) for name, shape in FIELDS.items()}
    for name, values in host.items():
        made.set_rows(name, 0, values)
    return made, host


def kinds(count: int, seed: int = 1) -> list[np.ndarray]:
    """For each Gaussian whether it remains, is cloned, and is split. A clone's source need not remain."""
    rng = np.random.default_rng(seed)
    split = rng.random(count) < 0.2
    cloned = ~split & (rng.random(count) < 0.3)
    return [~split & (rng.random(count) < 0.8), cloned, split]


def by_kind(marks: list[np.ndarray], first: int = 0) -> np.ndarray:
    """The list that density control makes of the Gaussians from row `first` on."""
    stay, cloned, split = (np.flatnonzero(each).astype(np.uint32) + np.uint32(first) for each in marks)
    return np.concatenate([stay, cloned | FRESH, split | FRESH, split | FRESH])


@pytest.mark.parametrize("piece", [1, 7, 256, 10_000])
def test_lists_of_pieces_are_the_list_in_the_models_order(piece: int) -> None:
    marks = kinds(1000)
    whole = by_kind(marks)
    order = beside_parents(whole & ~FRESH)
    begins = range(0, 1000, piece)
    made = in_source_order(by_kind([each[begin : begin + piece] for each in marks], begin) for begin in begins)
    np.testing.assert_array_equal(made.rows, whole[order])
    assert (made.count, made.halves) == (len(whole), 2 * np.count_nonzero(marks[2]))
    np.testing.assert_array_equal(made.by_kind(), np.argsort(order))
    np.testing.assert_array_equal(made.entries(), whole)
    seconds = np.argsort(order)[len(whole) - made.halves // 2 :]
    np.testing.assert_array_equal(made.seconds, seconds)
    np.testing.assert_array_equal(made.rows[made.seconds - 1], made.rows[made.seconds])


def test_a_list_takes_eight_bytes_a_row_while_it_is_joined() -> None:
    count, piece = 1 << 20, 1 << 14
    parts = [by_kind(kinds(piece, seed), piece * seed) for seed in range(count // piece)]
    rows = sum(map(len, parts))
    assert peak_of(lambda: in_source_order(iter(parts))) < 9 * rows  # both copies of the rows, and halves: 4, 4, 0.6


def test_fresh_rows() -> None:
    rows, fresh = np.array([3, 1, 1], np.uint32), np.array([False, False, True])
    assert row_entries(rows, fresh).tolist() == [3, 1, 1 | int(FRESH)]
    assert row_entries(rows, None).tolist() == [3, 1, 1]


def moved(host: dict[str, np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    """Rows after a move."""
    after = {name: values[rows & ~FRESH] for name, values in host.items()}
    for name, values in after.items():
        values[(rows >= FRESH) & (not name.startswith("parameters/"))] = 0
    return after


def assert_has(made: ChunkStore, host: dict[str, np.ndarray]) -> None:
    for name, values in host.items():
        np.testing.assert_array_equal(made.get_rows(name, 0, made.count), values, err_msg=name)


@pytest.mark.parametrize("most", [1, 2, 64])
def test_rows_move(path: Path | None, monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """Again and again. Places, ranges, chunks and consecutive records have the rows that they should."""
    monkeypatch.setattr(gathering, "BLOCK_CHUNKS", most)
    made, host = filled(path)
    for seed in range(3):
        rows = in_source_order([by_kind(kinds(len(host["first/a"]), seed))]).rows
        changed: list[int] = []
        made.move(rows, NewValues(), lambda changed=changed: changed.append(1))
        assert changed == [1]
        host = moved(host, rows)
        assert_has(made, host)
        assert made.count == len(rows)
        lengths = made.lengths(np.arange(made.chunks))
        assert lengths.max() <= CHUNK_ROWS
        assert made.chunks == chunks_of(len(rows)), "where all chunks change they are as full as can be"
        places = np.random.default_rng(seed).integers(0, len(rows), 50)
        host["first/a"][places] += 1
        made.set_at("first/a", places, host["first/a"][places])
        np.testing.assert_array_equal(made.get_at("parameters/sh", places), host["parameters/sh"][places])
        middle = len(rows) // 2
        host["parameters/a"][middle : middle + 1500] *= 2
        made.set_rows("parameters/a", middle, host["parameters/a"][middle : middle + 1500])
        last = made.rows_of(np.array([0, made.chunks - 1]), ("first",), ("a",))["first"]["a"]
        ends = host["first/a"][: lengths[0]], host["first/a"][len(rows) - lengths[-1] :]
        np.testing.assert_array_equal(last, np.concatenate(ends))
        assert_has(made, host)


@pytest.mark.parametrize("dropped", [0, 5])
def test_consecutive_records(path: Path | None, dropped: int) -> None:
    """Of chunks that are full, and of others. What is written to them changes no other row."""
    made, host = filled(path)
    rows = np.arange(dropped, ROWS, dtype=np.uint32)
    made.move(rows, NewValues(), lambda: None)
    host = moved(host, rows)
    for start, stop in ((0, 2 * CHUNK_ROWS), (CHUNK_ROWS, CHUNK_ROWS + 7), (3 * CHUNK_ROWS, made.count)):
        records = made.get_records(start, stop)
        assert len(records) == chunks_of(stop - start)
        for name in ("parameters/a", "first/a"):
            flat = records[name].reshape(-1, *FIELDS[name])[: stop - start]
            np.testing.assert_array_equal(flat, host[name][start:stop])
            records[name] *= -1
            host[name][start:stop] *= -1
        made.set_records(start, stop, records)
        assert_has(made, host)


def test_chunks_that_stay_are_neither_read_nor_written(
    path: Path | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a statistic begins anew. The move costs about two new chunks, and what a checkpoint names stays."""
    fields = {**FIELDS, "statistics/seen": ()}
    made, rng = ChunkStore(40 * CHUNK_ROWS, fields, path), np.random.default_rng(0)
    host = {name: rng.normal(size=(made.count, *shape)).astype(np.float32) for name, shape in fields.items()}
    for name, values in host.items():
        made.set_rows(name, 0, values)
    kept = None
    if path is not None:
        kept = made.manifest()
        made.hold([kept.slots])
    passed: list[int] = []
    monkeypatch.setattr(made, "read", noted_numbers(made.read, passed))
    rows = np.arange(made.count, dtype=np.uint32)
    rows = np.concatenate([rows[: 7 * CHUNK_ROWS + 3], [rows[7 * CHUNK_ROWS + 2] | FRESH], rows[7 * CHUNK_ROWS + 3 :]])
    moves: list[int] = []
    if path is not None:
        made.file.moved = lambda nbytes, _: moves.append(nbytes)
    made.move(rows, NewValues(anew=frozenset({"statistics/seen"})), lambda: None)
    assert passed == [7]
    assert sum(moves) == (3 * made.record.itemsize if path else 0), "one is read, two are written"
    host = moved(host, rows)
    host["statistics/seen"][:] = 0
    assert_has(made, host)
    if kept is not None:
        before = ChunkStore.opened(kept, writable=False)
        before.verify()
        before.close()


def noted_numbers(read: Any, numbers: list[int]) -> Any:
    return lambda some: (numbers.extend(some.tolist()), read(some))[1]


@pytest.mark.parametrize("where", ["write", "last"])
def test_a_move_that_fails_in_a_file_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """And the room that it took is free again, for the next attempt."""
    monkeypatch.setattr(gathering, "BLOCK_CHUNKS", 1)
    made, host = filled(tmp_path / "x.chunks")
    rows = in_source_order([by_kind(kinds(ROWS))]).rows
    left = [3]

    def full_after(*arguments: Any) -> None:
        left[0] -= 1
        if left[0] == 0:
            full()
        write(*arguments)

    write, before, sizes = SlotFile.write, made.chunks, []
    for _ in range(2):
        left[0] = 3
        with monkeypatch.context() as patch, pytest.raises(OSError, match="space"):
            patch.setattr(SlotFile, "write", full_after if where == "write" else write)
            made.move(rows, NewValues(), full if where == "last" else lambda: None)
        assert made.chunks == before
        assert_has(made, host)
        assert made.slots.size - made.slots.free == before
        sizes.append(made.slots.size)
    assert sizes[0] == sizes[1] > before
    made.move(rows, NewValues(), lambda: None)
    assert_has(made, moved(host, rows))


def test_more_coefficients_in_the_same_store(path: Path | None) -> None:
    made, host = filled(None) if path is None else filled(path, wide=True)
    wide = {**FIELDS, "parameters/sh": (5, 3), "second/none": (2, 3)}
    made.move(None, NewValues(), lambda: None, wide)
    got = made.get_rows("parameters/sh", 0, ROWS)
    np.testing.assert_array_equal(got[:, :2], host["parameters/sh"])
    assert not got[:, 2:].any()
    assert not made.get_rows("second/none", 0, ROWS).any()
    np.testing.assert_array_equal(made.get_rows("first/a", 0, ROWS), host["first/a"])
    if path is not None:
        again = ChunkStore.opened(made.manifest(), writable=False)
        again.verify()
        again.close()


def test_rows_in_any_order_with_more_coefficients(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gathering, "BLOCK_CHUNKS", 2)
    made, host = filled(None)
    rows = np.random.default_rng(3).integers(0, ROWS, ROWS + 2000).astype(np.uint32)
    to = ChunkStore(len(rows), {**FIELDS, "parameters/sh": (5, 3), "second/none": (2, 3)})
    everything = Division(to.starts, np.full(to.chunks, NEW))
    for numbers, records in gathered(rows, OldChunks(made.starts, made.read), everything, to.record):
        to.write(numbers, records)
    sh = to.get_rows("parameters/sh", 0, len(rows))
    np.testing.assert_array_equal(sh[:, :2], host["parameters/sh"][rows])
    assert not sh[:, 2:].any()
    assert not to.get_rows("second/none", 0, len(rows)).any()
    np.testing.assert_array_equal(to.get_rows("first/a", 0, len(rows)), host["first/a"][rows])


def test_chunks_in_main_memory_have_no_room_behind_their_rows() -> None:
    made, host = filled(None)
    rows = np.arange(ROWS, dtype=np.uint32)
    rows = np.insert(rows, [5, CHUNK_ROWS * 3 + 5], [4 | int(FRESH), (CHUNK_ROWS * 3 + 4) | int(FRESH)]).astype(
        np.uint32
    )
    made.move(rows, NewValues(), lambda: None)
    assert made.chunks == 8
    assert_has(made, moved(host, rows))
    assert sum(len(held) for held in made._memory if held is not None) == made.nbytes == len(rows) * 4 * (3 + 6 + 1)


def test_chunks_are_given_back_as_they_are_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a store of 60 chunks in main memory a second copy has room for a few."""
    monkeypatch.setattr(gathering, "BLOCK_CHUNKS", 2)
    count = 60 * CHUNK_ROWS
    rows = np.arange(count, dtype=np.uint32) | FRESH
    state = ChunkStore(1, FIELDS).record.itemsize * 60
    tracemalloc.start()
    try:
        made, _ = filled(None, count)
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        made.move(rows, NewValues(), lambda: None)
        after, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 0.1 * state
    assert most - before < 0.3 * state, "2 chunks at a time: read, copied, written, their fields"


def test_single_places(path: Path | None, monkeypatch: pytest.MonkeyPatch) -> None:
    made, host = filled(path)
    written: list[int] = []
    real = made._set_field

    def set_field(number: int, *rest: Any) -> None:
        written.append(number)
        real(number, *rest)

    monkeypatch.setattr(made, "_set_field", set_field)
    places = np.array([ROWS - 1, 3, 2 * CHUNK_ROWS, 2 * CHUNK_ROWS - 1, 4], np.uint32)
    np.testing.assert_array_equal(made.get_at("parameters/sh", places), host["parameters/sh"][places])
    host["parameters/sh"][places] *= 2
    made.set_at("parameters/sh", places, host["parameters/sh"][places])
    np.testing.assert_array_equal(made.get_rows("parameters/sh", 0, ROWS), host["parameters/sh"])
    assert sorted(written) == [0, 1, 2, 5]
    assert made.get_at("second/none", places).shape == (5, 0, 3)
    made.set_at("second/none", places, np.zeros((5, 0, 3), np.float32))
    assert made.get_at("first/a", places[:0]).shape == (0,)


def test_a_change_of_all_rows_writes_the_chunks_that_it_changes(
    path: Path | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, host = filled(path)
    host["first/a"][: 2 * CHUNK_ROWS] = -1
    made.set_rows("first/a", 0, host["first/a"])
    written: list[int] = []
    real = made._set_field
    monkeypatch.setattr(made, "_set_field", lambda number, *rest: (written.append(number), real(number, *rest)))
    seen: list[int] = []

    def lowered(values: np.ndarray) -> np.ndarray:
        seen.append(len(values))
        return np.minimum(values, np.float32(0))

    made.change("first/a", lowered)
    np.testing.assert_array_equal(made.get_rows("first/a", 0, ROWS), np.minimum(host["first/a"], 0))
    assert sum(seen) == ROWS, "no row behind the last one"
    assert written == [2, 3, 4, 5]


def test_a_list_without_halves() -> None:
    listed = SourceList(np.array([0, 2, 2 | int(FRESH)], np.uint32), np.zeros(0, np.uint32))
    assert listed.by_kind().tolist() == [0, 1, 2]
    assert (listed.count, listed.halves) == (3, 0)

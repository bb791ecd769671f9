# SPDX-License-Identifier: Apache-2.0
"""The store of chunks: the rows that were written or an error, and slots that a checkpoint names stay as they are."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from calls import raising
from numpy.typing import NDArray
from wide import flip, full

from clsplat.chunks.manifest import Manifest, manifest_of
from clsplat.chunks.slot_file import ScratchError, SlotFile, runs
from clsplat.chunks.slots import MAX_TENTHS, NO_SLOT, SlotTable
from clsplat.chunks.store import ChunkStore
from clsplat.errors import WriteError
from clsplat.layouts.columns import CHUNK_ROWS

FIELDS: dict[str, tuple[int, ...]] = {"a": (3,), "b": (), "none": (0, 3)}
COUNT = 20 * CHUNK_ROWS - 5
ALL = np.arange(20)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[ChunkStore]:
    made = ChunkStore(COUNT, FIELDS, tmp_path / "scratch" / "x.chunks")
    yield made
    made.close()


def records_of(store: ChunkStore, numbers: NDArray[Any], value: float = 0.0) -> NDArray[Any]:
    """Records whose elements differ by chunk, row and field."""
    records = np.zeros(len(numbers), store.record)
    for place, number in enumerate(numbers):
        rows = value + CHUNK_ROWS * number + np.arange(CHUNK_ROWS)
        records["a"][place], records["b"][place] = rows[:, None] * [1, 2, 3], -rows
    return records


def written(store: ChunkStore, value: float = 0.0, numbers: NDArray[Any] = ALL) -> NDArray[Any]:
    records = records_of(store, numbers, value)
    store.write(numbers, records)
    return records


def size_of(store: ChunkStore) -> int:
    assert store.path is not None
    return store.path.stat().st_size


@pytest.mark.parametrize("in_file", [False, True])
def test_rows_come_back(tmp_path: Path, in_file: bool) -> None:
    store = ChunkStore(COUNT, FIELDS, tmp_path / "x.chunks" if in_file else None)
    assert not any(store.read(ALL)[name].any() for name in ("a", "b"))
    numbers = np.array([3, 4, 9, 1])
    records = written(store, 7.0, numbers)
    assert store.read(np.array([9, 0, 1, 3]))[[0, 2, 3]].tobytes() == records[[2, 3, 0]].tobytes()
    assert not store.read(np.array([9, 0, 1]))["a"][1].any()
    store.set_rows("b", 4 * CHUNK_ROWS - 2, np.arange(5, dtype=np.float32))
    got = store.get_rows("b", 4 * CHUNK_ROWS - 3, 4 * CHUNK_ROWS + 4)
    np.testing.assert_array_equal(got[1:6], np.arange(5))
    np.testing.assert_array_equal(got[[0, 6]], [records["b"][0, -3], records["b"][1, 3]])
    store.change("a", lambda rows: np.full_like(rows, 2.0))
    assert (store.get_rows("a", 0, COUNT) == 2).all()
    assert store.get_rows("none", 0, 5).shape == (5, 0, 3)
    store.close()
    assert not list(tmp_path.iterdir()), "the file is removed, as no checkpoint names it"


Asked = list[tuple[int, int]]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    """Offsets and lengths that the system is asked to read."""
    found: Asked = []
    monkeypatch.setattr(os, "POSIX_FADV_WILLNEED", 3, raising=False)
    monkeypatch.setattr(os, "posix_fadvise", lambda *of: found.append(of[1:3]), raising=False)
    return found


def test_the_system_is_asked_for_what_is_read_next(store: ChunkStore, asked: Asked) -> None:
    written(store, numbers=np.array([3, 4, 9]))
    store.read_ahead(np.array([2, 3, 4, 9]))  # number 2 has never been written
    assert store.file.request is not None
    store.file.request.result()
    size, slots = store.file.slot_bytes, store.slots.current
    wanted = [(first * size, length * size) for _, first, length in runs(slots[[3, 4, 9]])]
    assert asked == wanted


def test_nothing_more_is_asked_before_an_answer(
    store: ChunkStore, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(store)
    may_go_on = Event()
    monkeypatch.setattr(os, "posix_fadvise", lambda *_: may_go_on.wait())
    store.read_ahead(ALL[:3])
    first = store.file.request
    store.read_ahead(ALL[3:])
    assert store.file.request is first
    may_go_on.set()
    assert first is not None
    first.result()


def test_a_store_that_cannot_be_read_ahead(store: ChunkStore, asked: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    """One in main memory, one whose disk refuses, one that is closed, and a system that cannot."""
    in_memory = ChunkStore(COUNT, FIELDS)
    written(in_memory)
    in_memory.read_ahead(ALL)
    written(store)
    monkeypatch.setattr(os, "posix_fadvise", full)
    store.read_ahead(ALL)
    assert store.file.request is not None
    assert store.file.request.result() is None
    store.close()
    store.read_ahead(ALL)
    assert store.file.request.result() is None
    monkeypatch.delattr(os, "posix_fadvise")
    before = store.file.request
    store.read_ahead(ALL)
    assert store.file.request is before


def test_rows_of_some_chunks(tmp_path: Path) -> None:
    """Without those behind the model's last one."""
    store = ChunkStore(COUNT, {"first/a": (3,), "first/none": (0, 3)}, tmp_path / "x.chunks")
    values = np.arange(3 * COUNT, dtype=np.float32).reshape(COUNT, 3)
    store.set_rows("first/a", 0, values)
    found = store.rows_of(np.array([4, 19]), ("first",), ("a", "none"))["first"]
    np.testing.assert_array_equal(found["a"], np.concatenate([values[4096:5120], values[19 * CHUNK_ROWS :]]))
    assert found["none"].shape == (2 * CHUNK_ROWS - 5, 0, 3)
    store.close()


@pytest.mark.parametrize("value", [0.0, np.inf])
@pytest.mark.parametrize("in_file", [False, True])
def test_a_constant_is_noted_and_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_file: bool, value: float
) -> None:
    """Also where a checkpoint names the chunks. A later change of some rows keeps it in the others."""
    made = ChunkStore(COUNT, FIELDS, tmp_path / "x.chunks" if in_file else None)
    records = written(made)
    if in_file:
        made.slots.hold([made.manifest().slots])
    with monkeypatch.context() as patch:
        patch.setattr(made, "_in_memory", raising(AssertionError("in memory")))
        for name in ("read_at", "write_at"):
            patch.setattr(SlotFile, name, raising(AssertionError(name)))
        made.fill("b", value)
        made.fill("none", value)
    got = made.read(ALL)
    assert (got["b"] == value).all()
    np.testing.assert_array_equal(got["a"].reshape(-1, 3)[:COUNT], records["a"].reshape(-1, 3)[:COUNT])
    made.set_at("b", np.array([5]), np.ones(1, np.float32))
    assert made.get_rows("b", 4, 7).tolist() == [value, 1, value]
    made.write(np.array([3]), records[3:4])
    assert made.read(np.array([3, 4]))["b"].tolist() == [records["b"][3].tolist(), [value] * CHUNK_ROWS]
    if in_file:
        again = ChunkStore.opened(made.manifest(), writable=False)
        again.verify()
        assert again.read(ALL).tobytes() == made.read(ALL).tobytes()
        again.close()
    made.fill("b", 3.0)
    assert (made.get_rows("b", 0, COUNT) == 3).all()
    made.close()


@pytest.mark.parametrize("in_file", [False, True])
def test_fields_may_change_their_names(tmp_path: Path, in_file: bool) -> None:
    made = ChunkStore(COUNT, {"now": (), "then": ()}, tmp_path / "x.chunks" if in_file else None)
    now, then = np.arange(COUNT, dtype=np.float32), -np.arange(COUNT, dtype=np.float32)
    made.set_rows("now", 0, now)
    made.set_rows("then", 0, then)
    made.rename({"now": "then", "then": "now"})
    made.set_rows("now", 7, np.full(1, 0.5, np.float32))
    then[7] = 0.5
    stores = [made, ChunkStore.opened(made.manifest(), writable=False)] if in_file else [made]
    for each in stores:
        np.testing.assert_array_equal(each.get_rows("now", 0, COUNT), then)
        np.testing.assert_array_equal(each.get_rows("then", 0, COUNT), now)
        each.close()


def test_what_a_checkpoint_names_is_not_overwritten(store: ChunkStore) -> None:
    before = written(store)
    manifest = store.manifest()
    store.slots.hold([manifest.slots])
    written(store, 100.0, np.array([2, 5]))
    store.set_rows("b", 7 * CHUNK_ROWS, np.ones(1, np.float32))
    store.change("b", lambda rows: np.full_like(rows, 3.0))
    saved = ChunkStore.opened(manifest, writable=False)
    assert saved.read(ALL).tobytes() == before.tobytes()
    saved.close()
    assert store.path is not None
    assert store.path.exists(), "a file that is only read is never removed"
    assert (store.get_rows("b", 0, COUNT) == 3).all()


def test_chunks_that_no_checkpoint_names_are_written_in_place(store: ChunkStore) -> None:
    written(store)
    size, slots = size_of(store), store.slots.current.copy()
    written(store, 1.0)
    store.change("b", lambda rows: np.full_like(rows, 3.0))
    assert size_of(store) == size == store.nbytes
    np.testing.assert_array_equal(store.slots.current, slots)


@pytest.mark.parametrize("share", [1.0, 0.3, 0.04])
def test_the_file_is_at_most_2_2_times_the_state(store: ChunkStore, share: float) -> None:
    """Also where every chunk changes between checkpoints. One checkpoint stays intact at any moment."""
    kept: list[Manifest] = []
    rng = np.random.default_rng(1)

    def release() -> list[NDArray[np.int64]] | None:
        if len(kept) < 2:
            return None
        del kept[0]
        return [manifest.slots for manifest in kept]

    store.release = release
    records = written(store)
    saved = {}
    for number in range(12):
        for _ in range(3):
            numbers = np.sort(rng.choice(20, max(int(20 * share), 1), replace=False))
            records[numbers] = written(store, float(rng.integers(1000)), numbers)
            assert size_of(store) * 10 <= MAX_TENTHS * store.nbytes
            for manifest in kept:
                reader = ChunkStore.opened(manifest, writable=False)
                assert reader.read(ALL).tobytes() == saved[id(manifest)]
                reader.close()
        kept = [*kept, store.manifest()][-2:]
        saved[id(kept[-1])] = records.tobytes()
        store.slots.hold([manifest.slots for manifest in kept])
        assert number == 0 or len(kept) == 2
        assert store.read(ALL).tobytes() == records.tobytes()
    assert (len(kept) == 2) and size_of(store) > store.nbytes


def test_a_store_goes_on_in_the_file_of_a_checkpoint(store: ChunkStore) -> None:
    records = written(store)
    manifest = store.manifest()
    store.slots.hold([manifest.slots])
    written(store, 50.0, np.array([0, 1, 2]))
    again = ChunkStore.opened(manifest, writable=True)
    again.slots.hold([manifest.slots])
    again.verify()
    records[5:7] = written(again, 70.0, np.array([5, 6]))
    assert again.read(ALL).tobytes() == records.tobytes()
    again.close()
    assert size_of(store) == store.nbytes, "slots behind the last that is kept are given back"


DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "cut": (lambda path: os.truncate(path, path.stat().st_size - 1), "has been cut"),
    "empty": (lambda path: path.write_bytes(b""), "has been cut"),
    "missing": (lambda path: path.unlink(), "cannot be opened: there is no such file"),
    "changed": (lambda path: flip(path, 5000), "chunk 0 of the model has changed"),
    "the last byte": (lambda path: flip(path, path.stat().st_size - 1), "chunk 19 of the model has changed"),
    "other": (lambda path: path.write_bytes(bytes(path.stat().st_size)), "chunk 0 of the model has changed"),
    "a folder": (lambda path: (path.unlink(), path.mkdir()), "cannot be opened"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_file_gives_no_rows(store: ChunkStore, name: str) -> None:
    written(store)
    manifest = store.manifest()
    damage, message = DAMAGE[name]
    damage(manifest.path)
    with pytest.raises(ScratchError, match=message):
        ChunkStore.opened(manifest, writable=True).verify()


@pytest.mark.parametrize("name", ["cut", "changed", "the last byte", "other"])
def test_a_file_that_is_damaged_while_it_is_used(store: ChunkStore, name: str) -> None:
    written(store)
    assert store.path is not None
    damage, message = DAMAGE[name]
    damage(store.path)
    with pytest.raises(ScratchError, match=message):
        store.read(ALL)
    with pytest.raises(ScratchError, match=message):
        _ = [store.get_rows(field, 0, COUNT) for field in ("a", "b")]


def test_a_full_disk_is_known_before_anything_is_written(
    store: ChunkStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    records = written(store)
    manifest = store.manifest()
    store.slots.hold([manifest.slots])
    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    with pytest.raises(WriteError, match=r"x\.chunks: cannot be written: the disk is full"):
        written(store, 1.0)
    assert store.read(ALL).tobytes() == records.tobytes()
    with pytest.raises(WriteError, match="the disk is full"):
        ChunkStore(COUNT, FIELDS, tmp_path / "scratch" / "y.chunks")
    assert [path.name for path in (tmp_path / "scratch").iterdir()] == ["x.chunks"]


def test_a_checkpoint_that_is_being_written_keeps_its_slots(store: ChunkStore) -> None:
    """A training may end, as by Ctrl-C, after a checkpoint was written and before its slots are protected."""
    store.has_checkpoints = True
    records, manifest = written(store), store.manifest()
    store.close()
    again = ChunkStore.opened(manifest, writable=False)
    assert again.read(ALL).tobytes() == records.tobytes()
    again.close()


def test_without_checkpoints_a_manifest_keeps_no_file(store: ChunkStore) -> None:
    written(store)
    path = store.manifest().path
    store.close()
    assert not path.exists()


def nearly_full(monkeypatch: pytest.MonkeyPatch, room: int) -> None:
    """Let the disk have room for `room` bytes at a time."""

    def allocate(_: int, __: int, nbytes: int) -> None:
        if nbytes > room:
            full()

    monkeypatch.setattr(os, "posix_fallocate", allocate, raising=False)


def test_a_nearly_full_disk_has_room_for_what_is_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file grows by a sixteenth of its chunks, but two slots are enough for two chunks."""
    many = 64
    store = ChunkStore(many * CHUNK_ROWS, FIELDS, tmp_path / "x.chunks")
    written(store, numbers=np.arange(many))
    store.slots.hold([store.manifest().slots])
    nearly_full(monkeypatch, 2 * store.file.slot_bytes)
    assert store.slots.growth(2) > 2
    records = written(store, 1.0, np.array([3, 5]))
    assert store.read(np.array([3, 5])).tobytes() == records.tobytes()
    assert store.slots.size == many + 2
    store.close()


def test_on_a_full_disk_an_old_checkpoint_gives_up_its_slots(
    store: ChunkStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    written(store)
    first = store.manifest().slots
    store.slots.hold([first])
    written(store, 1.0, np.array([0, 1]))
    second = store.manifest().slots
    store.slots.hold([first, second])
    nearly_full(monkeypatch, 0)
    answers = iter([[second], None])
    store.release = lambda: next(answers)
    records = written(store, 2.0, np.array([7, 8]))
    assert store.read(np.array([7, 8])).tobytes() == records.tobytes()
    assert next(answers) is None, "one checkpoint was asked to give up its slots"


def test_a_write_that_fails_gives_no_wrong_row(store: ChunkStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a slot of its own the chunk stays what it was; in place half of it is new, and reading says so."""
    records = written(store)
    store.slots.hold([store.manifest().slots[:10]])
    real = SlotFile.write_at

    def half(self: SlotFile, slot: int, offset: int, values: NDArray[Any]) -> None:
        real(self, slot, offset, np.ascontiguousarray(values).view(np.uint8).reshape(-1)[:10_000])
        full()

    with monkeypatch.context() as patch:
        patch.setattr(SlotFile, "write_at", half)
        for number in (3, 15):
            with pytest.raises(OSError, match="space"):
                written(store, 1.0, np.array([number]))
    assert store.read(ALL[:10]).tobytes() == records[:10].tobytes()
    with pytest.raises(ScratchError, match="chunk 15 of the model has changed"):
        store.read(ALL)


def test_a_folder_in_which_nothing_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(WriteError, match=r"x\.chunks: cannot be written"):
        ChunkStore(COUNT, FIELDS, tmp_path / "file" / "x.chunks")


def test_a_manifest_comes_back_from_a_checkpoint(store: ChunkStore) -> None:
    written(store)
    manifest = store.manifest()
    again = manifest_of(manifest.arrays(), {"step": 1, **manifest.state()})
    assert again is not None
    assert (again.path, again.slot_bytes, dict(again.fields)) == (manifest.path, manifest.slot_bytes, FIELDS)
    for name, array in manifest.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], array)
    assert manifest_of({}, {}) is None


WRONG: dict[str, Callable[[Manifest], Manifest]] = {
    "two chunks in a slot": lambda m: replace(m, slots=np.where(m.slots == 3, 2, m.slots)),
    "fewer slots": lambda m: replace(m, slots=m.slots[:-1]),
    "negative slots": lambda m: replace(m, slots=m.slots - 5),
    "another type": lambda m: replace(m, slots=m.slots.astype(np.int32)),  # type: ignore[arg-type]
    "more lengths": lambda m: replace(m, lengths=np.append(m.lengths, 1)),
    "an empty chunk": lambda m: replace(m, lengths=m.lengths * (m.slots != 3)),
    "a chunk that is too long": lambda m: replace(m, lengths=m.lengths + 1),
    "no chunks": lambda m: replace(m, **{name.split("/")[1]: array[:0] for name, array in m.arrays().items()}),
    "a single length": lambda m: replace(m, lengths=m.lengths[0]),
    "slots that are too small": lambda m: replace(m, slot_bytes=m.slot_bytes - 1),
    "huge slots": lambda m: replace(m, slot_bytes=1 << 60),
    "fewer constants": lambda m: replace(m, constants=m.constants[:-1]),
    "an unknown constant": lambda m: replace(m, constants=m.constants + np.uint8(3)),
    "a chunk that is nowhere": lambda m: replace(m, slots=np.where(m.slots == 3, -1, m.slots)),
    "fewer checksums": lambda m: replace(m, checksums=m.checksums[:, :1]),
    "a huge field": lambda m: replace(m, fields={**m.fields, "b": (1 << 40,)}),
    "many fields": lambda m: replace(m, fields={str(k): () for k in range(99)}),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_manifest_that_was_never_written_is_refused(store: ChunkStore, name: str) -> None:
    written(store)
    wrong = WRONG[name](store.manifest())
    with pytest.raises(ValueError, match=r"its list of chunks|its chunks"):
        manifest_of(wrong.arrays(), wrong.state())


def test_slots_far_behind_the_end_are_refused(store: ChunkStore) -> None:
    written(store)
    with pytest.raises(ScratchError, match="has been cut to 20 slots"):
        ChunkStore.opened(replace(store.manifest(), slots=store.slots.current + (1 << 60)), writable=False)


def test_low_slots_are_taken_first() -> None:
    table = SlotTable(np.array([0, 1, 2, NO_SLOT]), 4)
    table.hold([np.array([0, 1, NO_SLOT, NO_SLOT])])
    assert table.targets(np.array([2])) == [2], "no checkpoint names it"
    assert table.targets(np.array([1])) == [3]
    assert table.needed(np.array([0, 1, 3])) - table.free == 2
    assert table.end_of_held == 2
    table.grow(table.growth(2))
    np.testing.assert_array_equal(table.targets(np.array([3, 0])), [3, 4])


def test_a_file_gives_back_what_it_has_beyond_its_bound(store: ChunkStore) -> None:
    """Once nothing at its end is used any longer."""
    kept = []
    for step in range(3):
        records = written(store, float(step))
        kept.append(store.manifest().slots)
        store.hold(kept)
        assert size_of(store) == (step + 1) * store.nbytes, "nothing is free at its end"
    store.hold(kept[2:])
    assert size_of(store) == 3 * store.nbytes, "what is used is there"
    records = written(store, 5.0)
    assert store.slots.current.max() < 20, "the lowest slots are free"
    store.hold([store.manifest().slots])
    assert size_of(store) * 10 == MAX_TENTHS * store.nbytes
    assert store.read(ALL).tobytes() == records.tobytes()


def test_runs() -> None:
    assert list(runs(np.array([4, 5, 2, NO_SLOT, 0, 1, NO_SLOT]))) == [(0, 4, 2), (2, 2, 1), (4, 0, 2)]
    assert list(runs(np.array([], np.int64))) == []

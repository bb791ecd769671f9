# SPDX-License-Identifier: Apache-2.0
"""The pool of a streamed model: what is on the device, what comes back, and what an error leaves."""

from __future__ import annotations

from copy import copy
from pathlib import Path
from threading import Timer

import numpy as np
import pyopencl as cl
import pytest
from calls import noted, raising, refuses
from compare import assert_same_bits
from numpy.typing import NDArray

from clsplat.chunks.gathering import NewValues
from clsplat.chunks.slot_file import ScratchError
from clsplat.chunks.store import ChunkStore
from clsplat.device.buffers import upload
from clsplat.device.context import Device
from clsplat.errors import WriteError
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.optimisation.density_rules import FRESH
from clsplat.stages.chunk_pool import INVISIBLE_LOGIT, ChunkPool, StoredArray

FIELDS: dict[str, tuple[int, ...]] = {
    "parameters/means": (3,),
    "parameters/opacity_logits": (),
    "parameters/sh_rest": (0, 3),
    "second/means": (3,),
}
COUNT = 5 * CHUNK_ROWS + 77
CHUNKS = 6
LAST = CHUNKS - 1
SLOTS = 3

Model = dict[str, NDArray[np.float32]]


def model_of(count: int = COUNT) -> Model:
    rng = np.random.default_rng(count)
    return {name: rng.standard_normal((count, *shape)).astype(np.float32) for name, shape in FIELDS.items()}


def pool_of(device: Device, model: Model, path: Path | None, slots: int = SLOTS) -> ChunkPool:
    store = ChunkStore(len(model["parameters/means"]), FIELDS, path)
    for name, values in model.items():
        store.set_rows(name, 0, values)
    return ChunkPool(device, store, CHUNK_ROWS * slots)


@pytest.fixture(params=["the host's memory", "memory of its own"])
def either(request: pytest.FixtureRequest, device: Device) -> Device:
    """A device that shares the host's memory, or one that has memory of its own."""
    one = copy(device)
    one.shares_memory, one.under_way = request.param == "the host's memory", []
    return one


@pytest.fixture(params=["memory", "file"])
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path | None:
    """Where the store's records are."""
    return None if request.param == "memory" else tmp_path / "model.chunks"


def rows_of(chunk: int, count: int = COUNT) -> slice:
    return slice(CHUNK_ROWS * chunk, min(CHUNK_ROWS * (chunk + 1), count))


def in_slot(pool: ChunkPool, name: str, slot: int) -> NDArray[np.float32]:
    rows: NDArray[np.float32] = pool.arrays[name].get()[CHUNK_ROWS * slot : CHUNK_ROWS * (slot + 1)]
    return rows


def change(pool: ChunkPool, model: Model, chunk: int, slot: int, by: float) -> None:
    """What a step does: it adds to rows of the model that are on the device."""
    rows = rows_of(chunk, len(model["parameters/means"]))
    for name, values in model.items():
        if values.size:
            values[rows] += np.float32(by)
            pool.arrays[name].set_rows(CHUNK_ROWS * slot, values[rows])


def check(pool: ChunkPool, model: Model) -> None:
    """Every chunk on the device, and the whole model as a StoredArray has it."""
    chunks = np.arange(pool.store.chunks)
    for chunk, slot in zip(chunks.tolist(), pool.slots_of(chunks).tolist(), strict=True):
        for name, values in model.items() if slot >= 0 else ():
            wanted = values[rows_of(chunk, len(values))]
            assert_same_bits(in_slot(pool, name, slot)[: len(wanted)], wanted, f"chunk {chunk} of {name}")
    for name, values in model.items():
        assert_same_bits(StoredArray(pool, name).get(), values, name)


def change_rows(pool: ChunkPool, model: Model, start: int, by: float) -> None:
    """Change as many rows as there is room for, from any row on."""
    stop = min(start + pool.rows, COUNT)
    pool.place_rows(start, stop)
    assert (pool.slots_of(np.arange(CHUNKS)) < 0).all()
    for name in model:
        array = pool.arrays[name].rows(0, stop - start)
        assert_same_bits(array.get(), model[name][start:stop], name)
        model[name][start:stop] += np.float32(by)
        array.set(model[name][start:stop])
    pool.keep_rows(start, stop)


@pytest.mark.parametrize("slots", [1, SLOTS, CHUNKS])
def test_steps_over_some_chunks(either: Device, path: Path | None, slots: int) -> None:
    """Random chunks come, are changed, and come back; now and then consecutive rows come, or all leave."""
    rng, model = np.random.default_rng(slots), model_of()
    pool = pool_of(either, model, path, slots)
    expected = np.arange(1)
    for call in range(24):
        numbers, changes = expected, bool(rng.random() < 0.6)
        expected = np.sort(rng.permutation(CHUNKS)[: rng.integers(1, slots + 1)])
        if call % 6 == 5:
            change_rows(pool, model, int(rng.integers(COUNT - 1)), call)
            continue
        placed = pool.place(numbers, changes=changes)
        assert len(set(placed.tolist())) == len(numbers)
        for chunk, slot in zip(numbers.tolist(), placed.tolist(), strict=True) if changes else ():
            change(pool, model, chunk, slot, 1 + call)
        if call % 5 != 3:
            pool.expected = expected
            pool.fetch_ahead()
        if call % 9 == 8:
            pool.release()
            assert (pool.slots_of(np.arange(CHUNKS)) < 0).all()
        if call % 4 == 3:
            check(pool, model)
    check(pool, model)
    pool.close()
    assert path is None or not path.exists()


def test_several_chunks_cross_at_once(either: Device, path: Path | None) -> None:
    """An eighth of the slots: 5 of 40 chunks, whose last one is not full."""
    count = 39 * CHUNK_ROWS + 1
    model = model_of(count)
    pool = pool_of(either, model, path, slots=40)
    slots = pool.place(np.arange(40), changes=True)
    for chunk in (0, 7, 38, 39):
        change(pool, model, chunk, int(slots[chunk]), 1.0)
    check(pool, model)


def test_only_what_has_changed_is_written(device: Device) -> None:
    pool = pool_of(device, model_of(), None)
    record = pool.store.record.itemsize
    moved = []
    for numbers, changes in (([0, 1], False), ([1], True), ([0, 1, 2], False), ([3, 4, 5], False), ([3, 5], False)):
        pool.place(np.array(numbers), changes=changes)
        moved.append(pool.moved_bytes // record)
    assert moved == [2, 2, 3, 7, 7], "fetched: 2, 0, 1, 3, 0; written: chunk 1 as it leaves"
    pool.place(np.array([5]), changes=True)  # in another slot than chunk 1 was in
    for _ in range(2):
        pool.write_back()
        assert pool.moved_bytes == 8 * record, "once written, it is as in the store"
    assert (pool.slots_of(np.array([3, 4, 5])) >= 0).all(), "what is written back stays"


def test_what_the_store_gets_is_fetched(device: Device, path: Path | None) -> None:
    """After `set_rows`, `set` and `fill`, with changes on the device before."""
    model = model_of()
    pool = pool_of(device, model, path)
    arrays = {name: StoredArray(pool, name) for name in FIELDS}
    for step, name in enumerate(("parameters/means", "second/means", "parameters/opacity_logits")):
        slots = pool.place(np.array([0, 4, LAST]), changes=True)
        for chunk, slot in zip((0, 4, LAST), slots.tolist(), strict=True):
            change(pool, model, chunk, slot, 1.0 + step)
        some = np.full((CHUNK_ROWS + 9, *FIELDS[name]), -3.0, np.float32)
        arrays[name].set_rows(COUNT - len(some), some)
        model[name][COUNT - len(some) :] = some
        pool.place(np.array([1, 4, LAST]), changes=False)
        check(pool, model)
        if step == 0:
            arrays[name].set(2 * model[name])
            model[name] *= 2
        elif step == 1:
            arrays[name].fill(0.25)
            model[name][...] = 0.25
        pool.place(np.array([4, LAST]), changes=False)
        check(pool, model)


@pytest.mark.parametrize("name", ["parameters/means", "parameters/opacity_logits", "parameters/sh_rest"])
def test_a_stored_array_is_used_as_one_on_the_device(device: Device, path: Path | None, name: str) -> None:
    model = model_of()
    stored, on_device = StoredArray(pool_of(device, model, path), name), upload(device, model[name])
    new = -model[name][: CHUNK_ROWS + 5]
    for array in (stored, on_device):
        array.set_rows(2 * CHUNK_ROWS - 3, new)
    assert stored.shape == on_device.shape
    for start, stop in ((0, COUNT), (CHUNK_ROWS - 1, CHUNK_ROWS + 1), (COUNT - 1, COUNT), (5, 5)):
        assert_same_bits(stored.get_rows(start, stop), on_device.get_rows(start, stop), f"{name} {start}")
    places = np.array([CHUNK_ROWS + 7, 0, COUNT - 1])
    assert_same_bits(stored.get_at(places), on_device.get()[places])
    for array in (stored, on_device):
        array.set(np.ascontiguousarray(model[name][::-1]))
    stored.set_at(places, new[:3])
    for place, row in zip(places.tolist(), new, strict=False):
        on_device.set_rows(place, row[None])
    copied = stored.get()
    assert_same_bits(copied, on_device.get())
    copied[...] = 7
    assert_same_bits(stored.get(), on_device.get(), "a copy is not the store")
    stored.change(np.negative)
    assert_same_bits(stored.get(), -on_device.get())
    stored.fill(2.5)
    assert (stored.get() == 2.5).all()


def test_rows_behind_the_last_one(device: Device, path: Path | None) -> None:
    """They are copies of it, whose opacity is 0 and whose moments are 0; in the model they do not exist."""
    model = model_of()
    pool = pool_of(device, model, path)
    for _ in range(2):
        (slot,) = pool.place(np.array([LAST]), changes=True)
        logits, means = in_slot(pool, "parameters/opacity_logits", slot), in_slot(pool, "parameters/means", slot)
        assert (logits[77:] == np.float32(INVISIBLE_LOGIT)).all()
        assert (means[77:] == means[76]).all()
        assert not in_slot(pool, "second/means", slot)[77:].any()
        # whatever stands there afterwards, the chunk comes back without it
        pool.arrays["parameters/opacity_logits"].set_rows(CHUNK_ROWS * int(slot) + 77, np.full(9, 5.0, np.float32))
        pool.release()
    check(pool, model)


def test_rows_behind_each_chunks_last_one(device: Device, path: Path | None) -> None:
    """Of chunks that have lost rows, or were split."""
    model = model_of()
    pool = pool_of(device, model, path)
    rows = np.arange(COUNT, dtype=np.uint32)
    rows = np.delete(np.insert(rows, CHUNK_ROWS + 3, CHUNK_ROWS + 2 | FRESH), slice(3 * CHUNK_ROWS + 9, 4 * CHUNK_ROWS))
    pool.release()
    pool.store.move(rows, NewValues(), lambda: None)
    pool = ChunkPool(device, pool.store, CHUNK_ROWS * (CHUNKS + 1))
    numbers = np.arange(pool.store.chunks)
    lengths = pool.store.lengths(numbers).tolist()
    assert lengths == [1024, 512, 513, 1024, 9, 1024, 77]
    for number, slot in enumerate(pool.place(numbers, changes=False).tolist()):
        first, length = int(pool.store.starts[number]), lengths[number]
        means = in_slot(pool, "parameters/means", slot)
        wanted = model["parameters/means"][rows[first : first + length] & ~FRESH]
        assert_same_bits(means[:length], wanted)
        assert (means[length:] == wanted[-1]).all()
        assert (in_slot(pool, "parameters/opacity_logits", slot)[length:] == np.float32(INVISIBLE_LOGIT)).all()
        assert not in_slot(pool, "second/means", slot)[length:].any()


def test_the_last_chunk_may_be_full(device: Device) -> None:
    model = model_of(2 * CHUNK_ROWS)
    pool = pool_of(device, model, None)
    pool.place(np.array([0, 1]), changes=False)
    check(pool, model)


def test_the_last_caught_up_step_goes_with_a_chunk(either: Device) -> None:
    pool = pool_of(either, model_of(), None)
    rng, wanted = np.random.default_rng(0), np.zeros(CHUNKS, np.uint32)
    for step in range(1, 30):
        numbers = np.sort(rng.permutation(CHUNKS)[: rng.integers(1, SLOTS + 1)])
        slots = pool.place(numbers, changes=True)
        caught = pool.caught.get()
        assert caught[slots].tolist() == wanted[numbers].tolist()
        caught[slots] = wanted[numbers] = step
        pool.caught.set(caught)
        if step % 7 == 6:
            pool.release()


@pytest.mark.parametrize(
    ("fails", "error"), [("read", ScratchError("gone")), ("write", WriteError(28, "is full", "model.chunks"))]
)
def test_an_error_leaves_no_wrong_row(
    device: Device, fails: str, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkpoint may be made after it."""
    model = model_of()
    pool = pool_of(device, model, None)
    for chunk, slot in zip((0, 1, 2), pool.place(np.arange(3), changes=True).tolist(), strict=True):
        change(pool, model, chunk, slot, 1.0)
    with monkeypatch.context() as patch:
        patch.setattr(pool.store, fails, raising(error))
        refuses("gone|is full", pool.place, np.array([1, 4, 5]), changes=True, error=type(error))
    assert (pool.slots_of(np.array([4, 5])) < 0).all()
    check(pool, model)
    pool.place(np.array([1, 4, 5]), changes=False)
    check(pool, model)


def test_more_chunks_than_slots(device: Device) -> None:
    pool = pool_of(device, model_of(), None)
    refuses("numbers: 4 chunks, expected at most 3", pool.place, np.arange(4), changes=False, error=ValueError)


def test_no_more_slots_than_chunks(device: Device) -> None:
    pool = pool_of(device, model_of(), None, slots=40)
    assert (pool.slots, pool.rows) == (CHUNKS, CHUNKS * CHUNK_ROWS)


def test_chunks_come_while_the_device_computes(device: Device, path: Path | None) -> None:
    """Those that the next step may use take the slots that this step does not use, as many as there are."""
    device, model = copy(device), model_of()
    device.shares_memory, device.under_way = False, []
    pool = pool_of(device, model, path)
    record = pool.store.record.itemsize
    steps = [([0, 1], [2, 3]), ([2, 3], [0, 1]), ([0, 1], [4, LAST]), ([4, LAST], [0, 4]), ([0, 4], [])]
    ahead, missing = [], []
    for number, (numbers, expected) in enumerate(steps):
        before = pool.moved_bytes
        slots = pool.place(np.array(numbers), changes=True)
        missing.append((pool.moved_bytes - before) // record)
        for chunk, slot in zip(numbers, slots.tolist(), strict=True):
            change(pool, model, chunk, slot, 1.0 + number)
        pool.expected, before = np.array(expected, np.int64), pool.moved_bytes
        pool.fetch_ahead()
        ahead.append((pool.moved_bytes - before) // record)
        assert_same_bits(slots, pool._residency.slots_of(np.array(numbers)).astype(np.uint32), "the step's slots stay")
    # With three slots, a step of two chunks leaves one free. In it is a chunk that has changed, but for the first step.
    assert ahead == [1, 0, 2, 2, 0] and missing == [2, 2, 2, 2, 0]
    check(pool, model)
    pool.close()


def test_an_error_ahead_is_raised_at_the_next_step(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    device, model = copy(device), model_of()
    device.shares_memory, device.under_way = False, []
    pool = pool_of(device, model, None)
    pool.place(np.array([0]), changes=False)
    with monkeypatch.context() as patch:
        patch.setattr(pool.store, "read", raising(ScratchError("gone")))
        pool.expected = np.array([1, 2])
        pool.fetch_ahead()
        refuses("gone", pool.place, np.array([1, 2]), changes=False, error=ScratchError)
    check(pool, model)
    pool.place(np.array([1, 2]), changes=False)
    check(pool, model)


def test_the_system_reads_what_has_no_slot_yet(
    default_device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pool = pool_of(default_device, model_of(), tmp_path / "model.chunks")
    asked: list[list[int]] = []
    noted(monkeypatch, ChunkStore, "read_ahead", lambda _, numbers: asked.append(numbers.tolist()))
    pool.place(np.array([1, 2, 3]), changes=False)
    pool.expected = np.array([2, 4, LAST])
    pool.fetch_ahead()
    assert asked == [[4, LAST]] and (pool.slots_of(np.array([4, LAST])) < 0).all()
    pool.close()


class Held:
    """A pool on a device with memory of its own, and a change of a chunk that the device makes only after `release`."""

    def __init__(self, device: Device, slots: int) -> None:
        self.device = copy(device)
        self.device.shares_memory, self.device.under_way = False, []
        self.pool = pool_of(self.device, model_of(), None, slots)
        self.event = cl.UserEvent(self.device.context)
        self.timer = Timer(0.3, self.release)
        self.new = np.full((CHUNK_ROWS, 3), 7.0, np.float32)

    def change(self, slot: int, *, released: bool = True) -> None:
        """Put a change of the chunk in a slot on the queue. released: True to make it 0.3 seconds later."""
        means, nbytes = self.pool.arrays["parameters/means"], self.new.nbytes
        wait = {"is_blocking": False, "wait_for": [self.event]}
        self.kept = cl.enqueue_copy(self.device.queue, means.buffer, self.new, dst_offset=slot * nbytes, **wait)
        self.device.queue.flush()
        if released:
            self.timer.start()

    def release(self) -> None:
        if self.event.command_execution_status > 0:
            self.event.set_status(cl.command_execution_status.COMPLETE)

    def stored(self, chunk: int) -> NDArray[np.float32]:
        """Means of a chunk in the store, without those that the device has."""
        return self.pool.store.get_rows("parameters/means", CHUNK_ROWS * chunk, CHUNK_ROWS * (chunk + 1))


def test_chunks_that_come_ahead_do_not_wait_for_the_step(default_device: Device) -> None:
    held = Held(default_device, SLOTS)
    (slot,) = held.pool.place(np.array([0]), changes=True)
    held.change(int(slot), released=False)
    held.pool.expected = np.array([1, 2])
    late = Timer(30, held.release)
    late.start()
    held.pool.fetch_ahead()
    late.cancel()
    assert held.event.command_execution_status > 0, "the step is still under way"
    assert (held.pool._residency.slots_of(np.array([1, 2])) >= 0).all()
    held.release()
    check(held.pool, model_of() | {"parameters/means": changed_means(0)})


def changed_means(chunk: int) -> NDArray[np.float32]:
    """Means of the model after the change of `Held`."""
    means = model_of()["parameters/means"]
    means[rows_of(chunk)] = 7.0
    return means


@pytest.mark.parametrize("how", ["ahead", "place", "write back", "release", "filled within the step"])
def test_a_chunk_leaves_after_what_changes_it(default_device: Device, how: str) -> None:
    """The last launch that changes it is still to run when its copy to the store begins."""
    held = Held(default_device, 1 if how == "place" else SLOTS)
    pool = held.pool
    (slot,) = pool.place(np.array([0]), changes=True)
    if how == "filled within the step":
        pool.place(np.array([1]), changes=True)
        pool.fill("second/means", 0.0)
        pool.place(np.array([1]), changes=True)
    held.change(int(slot))
    if how == "ahead":
        pool.fetch_ahead()
        pool.place(np.array([1]), changes=True)
        pool.expected = np.array([2, 3])
        pool.fetch_ahead()
        assert pool.slots_of(np.array([0]))[0] < 0, "it has left"
    elif how == "place":
        pool.place(np.array([1]), changes=True)
    elif how == "write back":
        pool.write_back()
    elif how == "release":
        pool.release()
    else:
        pool.expected = np.array([2, 3])
        pool.fetch_ahead()
        pool.write_back()
    held.timer.join()
    assert_same_bits(held.stored(0), held.new)

# SPDX-License-Identifier: Apache-2.0
"""Pool of a streamed model's chunks on the device, which are fetched from a store and written back."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.chunks.division import chunks_of
from clsplat.chunks.residency import CROSSING_SHARE, Moves, Residency
from clsplat.chunks.store import ChunkStore
from clsplat.device.buffers import DeviceArray, allocate
from clsplat.device.context import Device
from clsplat.errors import CapacityError, ClsplatError
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.stages.chunk_records import RecordCopies

INVISIBLE_LOGIT = -1e9
"""Opacity logit of padding rows, which no view shows. Its square is finite, because `adam` refuses other values."""
_MAX_CROSSING = 32
"""Maximum number of records that cross the bus at a time. More are not faster."""

Cull = Callable[[Camera], NDArray[np.integer[Any]]]
"""Function that returns the chunks that a camera may show."""


class ChunkPool:
    """The chunks of a streamed model that are on the device, with parameters, moments and statistics.

    rows: number of Gaussians that the pool has memory for.
    store: records of all chunks. Until `write_back`, chunks on the device may be newer than their records.
    arrays: arrays on the device by field, with CHUNK_ROWS rows for each slot.
    caught: (slots,) uint32, the last step up to which the chunk in each slot has been caught up (`stages.catch_up`).
    cull: function that returns the chunks that a camera may show; None if no such function is available.
    before_view: function that is called before a step with two numbers of chunks: the most that a view of the step
        shows, and those that all its views show. It may resize the pool.
    expected: numbers of the chunks that the next step's views may show (`fetch_ahead`).
    """

    def __init__(self, device: Device, store: ChunkStore, rows: int, cull: Cull | None = None) -> None:
        self._device, self.store = device, store
        self._caught = np.zeros(store.chunks, np.uint32)
        """(chunks,), the value of `caught` of each chunk when it was last written back."""
        self.cull = cull
        self.before_view: Callable[[int, int], None] = lambda _chunks, _of_step: None
        self.expected: NDArray[np.integer[Any]] = np.zeros(0, np.int64)
        self.moved_bytes = 0
        """Bytes of all records that have crossed the bus so far, in both directions."""
        self._allocate(rows)

    def _allocate(self, rows: int) -> None:
        self.slots = min(max(rows // CHUNK_ROWS, 1), self.store.chunks)
        self.arrays = {
            name: allocate(self._device, (CHUNK_ROWS * self.slots, *shape), np.float32)
            for name, shape in self.store.fields.items()
        }
        self.caught = allocate(self._device, (self.slots,), np.uint32)
        self.caught.fill(0)
        self._residency = Residency(self.slots, self.store.chunks)
        self._changed = np.zeros(self.slots, np.bool_)
        self._most = min(max(self.slots // CROSSING_SHARE, 1), _MAX_CROSSING)
        self._copies = RecordCopies(self._device, self._most)
        self._mark: tuple[Any, int] | None = None
        """Event of a marker on the device's queue, and `Residency.uses` at that time. Later launches have used only the
        slots of chunks that were placed since. None if other slots may have been used."""
        self._placed = False
        """True if chunks were placed since the last `fetch_ahead`. Launches of this step may still use their slots."""

    def resize(self, rows: int) -> None:
        """Replace the slots by empty slots for `rows` Gaussians, after writing changed chunks back. Raises WriteError.

        If the driver cannot allocate them, although they are within the memory plan, a single slot is allocated.
        """
        self.release()
        self.free()
        try:
            self._allocate(rows)
        except CapacityError:
            self.free()
            self._allocate(CHUNK_ROWS)

    def free(self) -> None:
        """Free the device's memory. The pool is unusable afterwards."""
        self._copies.free()
        self.arrays.clear()

    def close(self) -> None:
        """Free the device's memory, and close the store."""
        self.free()
        self.store.close()

    @property
    def rows(self) -> int:
        """Number of rows of all slots."""
        return CHUNK_ROWS * self.slots

    def place(self, numbers: NDArray[np.integer[Any]], *, changes: bool) -> NDArray[np.uint32]:
        """Bring the chunks `numbers` (k,) to the device, unless they are there already. Returns their slots (k,).

        changes: True if the device will change the chunks.

        Raises WriteError and ScratchError, and ValueError for more chunks than slots. After an error no change is lost:
        the latest state of each chunk is on the device or in the store.
        """
        moves = self._residency.plan(numbers)
        if self._mark is None and not self._placed:
            self._mark = self._device.mark(), self._residency.uses
        self._placed = True
        if len(moves.fetched):
            self._move(moves, self._device.mark())
        self._copies.join()
        self._residency.use(moves)
        if changes:
            self._changed[moves.slots] = True
        return moves.slots

    @property
    def looks_ahead(self) -> bool:
        """True if `fetch_ahead` uses `expected`."""
        return self._copies.overlaps or self.store.path is not None

    def fetch_ahead(self) -> None:
        """Bring the `expected` chunks to the device, while it computes the step just launched.

        Only slots that this step does not use become free for them. If these are too few, or an error occurs, `place`
        brings the rest before the next step, and raises the error. The system is asked to read all of them from a
        scratch file already.
        """
        expected, self.expected = self.expected, self.expected[:0]
        missing = expected[self._residency.slots_of(expected) < 0]
        if len(missing):
            self.store.read_ahead(missing)
        if self._mark is not None and self._copies.overlaps and len(expected) <= self.slots:
            mark, uses = self._mark
            moves = self._residency.plan_ahead(expected, uses)
            with suppress(ClsplatError):
                if len(moves.fetched):
                    self._move(moves, mark)
                self._residency.use(moves)
        self._mark, self._placed = (self._device.mark(), self._residency.uses), False

    def _move(self, moves: Moves, mark: Any) -> None:
        """Carry out a plan's copies, after an event of the device's queue. Raises WriteError and ScratchError."""
        self._copies.begin(mark)
        try:
            changed = self._changed[moves.evicted_from]
            self._write(moves.evicted[changed], moves.evicted_from[changed])
            self._changed[moves.fetched_to] = False
            self._residency.evict(moves)
            self._fetch(moves.fetched, moves.fetched_to)
        finally:
            self._copies.end()

    def place_rows(self, start: int, stop: int) -> None:
        """Copy the rows [start, stop) of the model to the first rows of the pool. They need not be whole chunks.

        The pool does not record which chunks these rows belong to, so only `keep_rows` can write their changes back.
        Raises WriteError and ScratchError.
        """
        self.release()
        for begin, end, slots in self._row_groups(start, stop):
            rows = self.store.get_records(begin, end)
            self._to_slots(slots, partial(_copy, rows), np.zeros(len(slots), np.uint32))
        self._copies.end()
        self._copies.join()

    def keep_rows(self, start: int, stop: int) -> None:
        """Write the rows [start, stop), which `place_rows` has copied to the pool, back to the store.

        Raises WriteError and ScratchError.
        """
        self._settle()
        for begin, end, slots in self._row_groups(start, stop):
            self.store.set_records(begin, end, self._from_slots(slots)[0])

    def _row_groups(self, start: int, stop: int) -> Iterator[tuple[int, int, NDArray[np.uint32]]]:
        """Split the rows [start, stop) into parts that cross the bus one after the other. Yields the first row of a
        part, the end of its rows, and its slots in the pool."""
        slots = np.arange(chunks_of(stop - start), dtype=np.uint32)
        for some in self._groups(len(slots)):
            begin = start + CHUNK_ROWS * some.start
            yield begin, min(begin + CHUNK_ROWS * len(slots[some]), stop), slots[some]

    def write_back(self) -> None:
        """Write the chunks that have changed on the device to the store. Raises WriteError."""
        self._settle()
        numbers, slots = self._residency.held()
        changed = self._changed[slots]
        self._write(numbers[changed], slots[changed])
        self._changed[:] = False

    def _settle(self) -> None:
        """Let copies wait for all launches, and later launches for all copies so far."""
        self._copies.join()
        self._copies.begin(self._device.mark())
        self._mark = None

    def release(self) -> None:
        """Write changed chunks back, and empty all slots. Call it before the store changes."""
        self.write_back()
        self._residency.clear()

    def fill(self, field: str, value: float) -> None:
        """Set all elements of a field to `value`, in the slots and in the store."""
        self._settle()
        self.arrays[field].fill(value)
        self.store.fill(field, value)

    def rename(self, names: Mapping[str, str]) -> None:
        """Rename fields, in the slots and in the store. names: new names by old names."""
        self.arrays = {names.get(name, name): array for name, array in self.arrays.items()}
        self.store.rename(names)

    def slots_of(self, numbers: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
        """Return the slots of the chunks `numbers`; -1 for a chunk that is not on the device."""
        self._settle()  # the caller may launch kernels that use these slots
        return self._residency.slots_of(numbers)

    def _fetch(self, numbers: NDArray[np.int64], slots: NDArray[np.uint32]) -> None:
        for some in self._groups(len(numbers)):
            self._to_slots(slots[some], partial(self._read, numbers[some]), self._caught[numbers[some]])

    def _read(self, numbers: NDArray[np.int64], records: NDArray[Any]) -> None:
        self.store.read(numbers, records)
        self._pad(numbers, records)

    def _pad(self, numbers: NDArray[np.int64], records: NDArray[Any]) -> None:
        """Pad the records of the chunks `numbers` to CHUNK_ROWS rows, by copies of each chunk's last row. The copies'
        opacity is so low that no view shows them, and their moments are 0, so that no step moves them."""
        lengths = self.store.lengths(numbers)
        for place in np.flatnonzero(lengths < CHUNK_ROWS).tolist():
            rows = int(lengths[place])
            for name in self.store.record.names or ():
                values = records[name][place]
                values[rows:] = values[rows - 1] if name.startswith("parameters/") else 0.0
            records["parameters/opacity_logits"][place, rows:] = INVISIBLE_LOGIT

    def _write(self, numbers: NDArray[np.int64], slots: NDArray[np.uint32]) -> None:
        for some in self._groups(len(numbers)):
            records, caught = self._from_slots(slots[some])
            self.store.write(numbers[some], records)
            self._caught[numbers[some]] = caught

    def _to_slots(
        self, slots: NDArray[np.uint32], read: Callable[[NDArray[Any]], None], caught: NDArray[np.uint32]
    ) -> None:
        self._copies.to_slots(self.store.record, slots, read, caught, self.arrays, self.caught)
        self.moved_bytes += len(slots) * self.store.record.itemsize

    def _from_slots(self, slots: NDArray[np.uint32]) -> tuple[NDArray[Any], NDArray[np.uint32]]:
        self.moved_bytes += len(slots) * self.store.record.itemsize
        return self._copies.from_slots(self.store.record, slots, self.arrays, self.caught)

    def _groups(self, count: int) -> list[slice]:
        """Divide `count` chunks into slices that cross the bus one after the other (`residency.CROSSING_SHARE`)."""
        return [slice(begin, begin + self._most) for begin in range(0, count, self._most)]


def _copy(rows: NDArray[Any], records: NDArray[Any]) -> None:
    records[...] = rows


@dataclass(frozen=True, eq=False)
class StoredArray:
    """An array of a streamed model, such as "parameters/means", with the interface of a DeviceArray."""

    pool: ChunkPool
    field: str

    @property
    def shape(self) -> tuple[int, ...]:
        return self.pool.store.count, *self.pool.store.fields[self.field]

    @property
    def in_pool(self) -> DeviceArray:
        """The array of the pool, with CHUNK_ROWS rows for each slot."""
        return self.pool.arrays[self.field]

    def get(self) -> NDArray[np.float32]:
        """Return a copy of all rows of the array."""
        return self.get_rows(0, self.pool.store.count)

    def set(self, values: NDArray[np.float32]) -> None:
        """Replace all rows of the array by `values`."""
        self.set_rows(0, values)

    def get_rows(self, start: int, stop: int) -> NDArray[np.float32]:
        """Return a copy of the rows [start, stop)."""
        self.pool.write_back()
        return self.pool.store.get_rows(self.field, start, stop)

    def set_rows(self, start: int, values: NDArray[np.float32]) -> None:
        """Replace the rows from `start` on with `values`."""
        self.pool.release()
        self.pool.store.set_rows(self.field, start, values)

    def get_at(self, places: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
        """Return a copy (k, ...) of the rows with the indices `places` (k,)."""
        self.pool.write_back()
        return self.pool.store.get_at(self.field, places)

    def set_at(self, places: NDArray[np.integer[Any]], values: NDArray[np.float32]) -> None:
        """Replace the rows with the indices `places` (k,) by `values` (k, ...)."""
        self.pool.release()
        self.pool.store.set_at(self.field, places, values)

    def change(self, change: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> None:
        """Replace the rows of each chunk by the array that the function `change` returns for these rows."""
        self.pool.release()
        self.pool.store.change(self.field, change)

    def fill(self, value: float) -> None:
        """Set all elements to `value`."""
        self.pool.fill(self.field, value)

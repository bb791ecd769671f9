# SPDX-License-Identifier: Apache-2.0
"""Store of a streamed model's chunks, in main memory or in a scratch file.

A record has all fields of CHUNK_ROWS rows, one field after the other, so that a chunk moves by one read or write. In a
file each field has a checksum, so that a file that was cut or changed never gives a wrong row. A slot that a kept
checkpoint names is not overwritten; its chunk goes to another slot (docs/decisions/0052-a-store-of-chunks.md). If a
field has the same value in all elements of a chunk, only a code for this value is stored (`manifest.CONSTANTS`).
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.chunks.division import NEW, Division, chunk_of, chunks_of, divided, even_starts
from clsplat.chunks.gathering import BLOCK_CHUNKS, NewValues, OldChunks, gathered
from clsplat.chunks.manifest import CONSTANTS, WRITTEN, ZERO, Manifest
from clsplat.chunks.slot_file import ScratchError, SlotFile
from clsplat.chunks.slots import NO_SLOT, SlotTable
from clsplat.errors import WriteError
from clsplat.files.atomic import remove
from clsplat.layouts.columns import CHUNK_ROWS

KeptSlots = Sequence[NDArray[np.int64]]
"""For each kept checkpoint, the slots (chunks,) of its chunks."""


def record_type(fields: Mapping[str, tuple[int, ...]]) -> np.dtype[Any]:
    """Return the structured NumPy type of a record. fields: shape of a row of each float32 field, by its name."""
    return np.dtype([(name, np.float32, (CHUNK_ROWS, *shape)) for name, shape in fields.items() if prod(shape)])


class ChunkStore:
    """Records of the chunks of a model of `count` Gaussians, all zero at first.

    fields: shape of a row of each field, by names such as "first/means". Records lack fields without elements.
    path: scratch file for the records, which is created; None keeps the records in main memory.
    widest: the largest shapes that the fields will have, by name. Slots of the file have room for them.
    starts: (chunks + 1,) int64, the chunks' first rows, then the number of rows. By default all but the last are full.
    opened: the existing scratch file and the manifest of a checkpoint, to continue from.
    release: function that is called before the file becomes larger than `SlotTable.most`. It removes the oldest
        checkpoint and returns the slots of the other checkpoints, or None if all have to stay.
    has_checkpoints: True if manifests go into checkpoints, so that `close` keeps the slots of the latest one.
    file: the open scratch file; missing if records are kept in main memory.
    Raises WriteError if the file cannot be created, or the disk has too little room.
    """

    def __init__(
        self,
        count: int,
        fields: Mapping[str, tuple[int, ...]],
        path: Path | None = None,
        *,
        widest: Mapping[str, tuple[int, ...]] | None = None,
        starts: NDArray[np.int64] | None = None,
        opened: tuple[SlotFile, Manifest] | None = None,
    ) -> None:
        self.path, self.starts = path, even_starts(count) if starts is None else starts
        if opened is not None:
            self.starts = np.append(0, np.cumsum(opened[1].lengths))
        self._set_fields(fields)
        self.release: Callable[[], KeptSlots | None] = lambda: None
        self._memory: list[NDArray[np.uint8] | None] = [None] * self.chunks if path is None else []
        """The rows of each chunk in main memory, as bytes, one field after the other; None before they are written."""
        self._given_back, self.has_checkpoints = 0, False
        self._constants = np.full((self.chunks, len(self._names)), ZERO)
        """(chunks, fields), WRITTEN if the record has the field; ZERO or INFINITE if all elements have this value."""
        if path is None:
            return
        if opened is not None:
            self.file, manifest = opened
            self._checksums, self._constants = manifest.checksums.copy(), manifest.constants.copy()
            current, size = manifest.slots.copy(), self.file.slots
        else:
            size = self.chunks
            self.file = SlotFile.new(path, record_type(widest or fields).itemsize, size)
            self._checksums = np.zeros((self.chunks, len(self._names)), np.uint32)
            current = np.full(self.chunks, NO_SLOT, np.int64)
        if (most := int(current.max(initial=NO_SLOT))) >= size:
            self.file.close()
            raise ScratchError(f"{path}: has been cut to {size} slots, expected at least {most + 1}")
        self.slots = SlotTable(current, size)

    @classmethod
    def opened(cls, manifest: Manifest, *, writable: bool) -> ChunkStore:
        """Open the store of a checkpoint. Raises ScratchError if its scratch file is missing or too short."""
        file = SlotFile.opened(manifest.path, manifest.slot_bytes, writable=writable)
        return cls(int(manifest.lengths.sum()), manifest.fields, manifest.path, opened=(file, manifest))

    def manifest(self) -> Manifest:
        """Flush the scratch file to the disk, and return its manifest for a checkpoint. Raises WriteError."""
        assert self.path is not None
        self.file.sync()
        if self.has_checkpoints:
            self.slots.name_current()
        arrays = np.diff(self.starts), self.slots.current.copy(), self._checksums.copy(), self._constants.copy()
        return Manifest(self.path, self.file.slot_bytes, self.fields, *arrays)

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return int(self.starts[-1])

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return len(self.starts) - 1

    def lengths(self, numbers: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
        """Return the number of rows (k,) of the chunks `numbers` (k,)."""
        return np.asarray(self.starts[numbers + 1] - self.starts[numbers])

    def verify(self) -> None:
        """Read all chunks. Raises ScratchError if a chunk differs from what was written."""
        for numbers in self.blocks():
            self.read(numbers)

    @property
    def nbytes(self) -> int:
        """Size in bytes of the records of all rows in main memory, or of a slot for each chunk in a scratch file."""
        if self.path is None:
            return self.count * self.record.itemsize // CHUNK_ROWS
        return self.chunks * self.file.slot_bytes

    def close(self) -> None:
        """Free the memory, and close the file. A writable file is removed unless a checkpoint names slots of it."""
        self._memory.clear()
        if self.path is None or self.file.closed:
            return
        kept, writable = self.slots.end_of_held, self.file.writable
        if writable and kept:
            self.file.cut(kept)
        self.file.close()
        with suppress(OSError):
            if writable and not kept:
                remove(self.path)

    def read(self, numbers: NDArray[np.integer[Any]], into: NDArray[Any] | None = None) -> NDArray[Any]:
        """Read the records (k,) of the chunks `numbers` (k,). Rows past the end of a chunk are undefined.

        into: (k,), the array for the records; None makes a new one. Raises ScratchError if the file cannot be read, or
        differs from what was written.
        """
        records = np.empty(len(numbers), self.record) if into is None else into
        if self.path is None:
            for place, (number, length) in enumerate(zip(numbers, self.lengths(numbers).tolist(), strict=True)):
                if (held := self._memory[number]) is not None:
                    _unpack(held, length, records[place : place + 1])
        else:
            self.file.read(self.slots.current[numbers], records)
            for place, number in enumerate(numbers):
                self._check(int(number), self._names, records[place])
        constants = self._constants[numbers]
        for index in np.flatnonzero(constants.any(axis=0)):
            for constant, value in CONSTANTS.items():
                records[self._names[index]][constants[:, index] == constant] = value
        return records

    def read_ahead(self, numbers: NDArray[np.integer[Any]]) -> None:
        """Ask the system to read the records of the chunks `numbers` from the scratch file, and do not wait."""
        if self.path is not None:
            self.file.read_ahead(self.slots.current[numbers])

    def write(self, numbers: NDArray[np.integer[Any]], records: NDArray[Any]) -> None:
        """Replace the records of the chunks `numbers` by `records`. Raises WriteError if they cannot be written."""
        if self.path is None:
            for place, (number, length) in enumerate(zip(numbers, self.lengths(numbers).tolist(), strict=True)):
                self._memory[number] = _packed(records[place : place + 1], length)
            self._constants[numbers] = WRITTEN
            return
        self._make_room(partial(self.slots.needed, numbers))
        slots = self.slots.targets(numbers)
        self.file.write(slots, records)
        self.slots.written(numbers, slots)
        self._checksums[numbers], self._constants[numbers] = _checksums(records), WRITTEN

    def move(
        self,
        rows: NDArray[np.uint32] | None,
        values: NewValues,
        changes: Callable[[], None],
        fields: Mapping[str, tuple[int, ...]] | None = None,
    ) -> None:
        """Rearrange the model's rows. Chunks that do not change are neither read nor written.

        rows: the old row that each row becomes a copy of, in rising order, with the bit FRESH set for new rows. None
            leaves all rows in place.
        values: values that rows get in place of copies.
        changes: function that is called before the first row changes. With a scratch file, all new chunks have then
            been written to free slots, so that an error changes nothing.
        fields: new shapes of the fields, for more SH coefficients. Then all rows stay, and all chunks are written.
        Raises WriteError and ScratchError.
        """
        as_it_is = Division(self.starts, np.full(self.chunks, NEW))
        to, record = as_it_is if rows is None else divided(rows, self.starts), record_type(fields or self.fields)
        made = gathered(rows, OldChunks(self.starts, self.read), to, record, self._give_back, values)
        by_field = len(to.kept), len(record.names or ())
        constants = _carried(self._constants, to, by_field)
        if self.path is None:
            changes()
            self._memory, self._given_back = self._moved_in_memory(to, made), 0
        else:
            checksums = _carried(self._checksums, to, by_field)
            self._move_in_file(to, made, checksums, changes)
            self._checksums = checksums
        self._set_fields(fields or self.fields)
        self.starts, self._constants = to.starts, constants
        for field in values.anew:
            self.fill(field, values.initial.get(field, 0.0))

    def _moved_in_memory(
        self, to: Division, made: Iterator[tuple[NDArray[np.int64], NDArray[Any]]]
    ) -> list[NDArray[np.uint8] | None]:
        memory = [None if old == NEW else self._memory[old] for old in to.kept.tolist()]
        for numbers, records in made:
            lengths = to.starts[numbers + 1] - to.starts[numbers]
            for place, (number, length) in enumerate(zip(numbers.tolist(), lengths.tolist(), strict=True)):
                memory[number] = _packed(records[place : place + 1], length)
        return memory

    def _move_in_file(
        self,
        to: Division,
        made: Iterator[tuple[NDArray[np.int64], NDArray[Any]]],
        checksums: NDArray[np.uint32],
        changes: Callable[[], None],
    ) -> None:
        slots = np.where(to.kept == NEW, NO_SLOT, self.slots.current[to.kept])
        try:
            for numbers, records in made:
                self._make_room(partial(len, numbers))
                slots[numbers] = self.slots.take(len(numbers))
                self.file.write(slots[numbers], records)
                checksums[numbers] = _checksums(records)
            changes()
        except BaseException:
            self.slots.give_up()
            raise
        self.slots.become(slots)

    def get_records(self, start: int, stop: int) -> NDArray[Any]:
        """Read the rows [start, stop) into records of CHUNK_ROWS rows each, wherever chunks begin and end.

        Rows past `stop` are undefined. Raises ScratchError.
        """
        numbers, mine, evenly = self._covering(start, stop)
        records = self.read(numbers)
        if evenly:
            return records
        rows = np.zeros(chunks_of(stop - start), self.record)
        for name in self._names:
            rows[name][_filled(rows, stop - start)] = records[name][mine]
        return rows

    def set_records(self, start: int, stop: int, rows: NDArray[Any]) -> None:
        """Replace the rows [start, stop). rows: records as from `get_records`. Raises WriteError and ScratchError."""
        numbers, mine, evenly = self._covering(start, stop)
        records = rows
        if not evenly:
            records, partly = np.zeros(len(numbers), self.record), mine.sum(axis=1) < self.lengths(numbers)
            records[partly] = self.read(numbers[partly])
            for name in self._names:
                records[name][mine] = rows[name][_filled(rows, stop - start)]
        self.write(numbers, records)

    def _covering(self, start: int, stop: int) -> tuple[NDArray[np.int64], NDArray[np.bool_], bool]:
        """Find the chunks that have the rows [start, stop).

        Returns their numbers (k,), a mask (k, CHUNK_ROWS) of these rows in the chunks, and True if the chunks have no
        other rows and all but the last are full.
        """
        first, last = chunk_of(self.starts, np.array([start, stop - 1])).tolist()
        numbers = np.arange(first, last + 1)
        places, lengths = np.arange(CHUNK_ROWS), self.lengths(numbers)
        rows = self.starts[numbers][:, None] + places
        mine = (places < lengths[:, None]) & (rows >= start) & (rows < stop)
        whole = int(self.starts[first]) == start and int(self.starts[last + 1]) == stop
        return numbers, mine, whole and bool((lengths[:-1] == CHUNK_ROWS).all())

    def hold(self, kept: KeptSlots) -> None:
        """Protect the slots of the checkpoints `kept`, and no other slots, from being overwritten.

        A file with more slots than `SlotTable.most` is cut after its last used slot.
        """
        self.slots.hold(kept)
        if self.slots.most < self.slots.size > self.slots.end:
            self.slots.cut(max(self.slots.end, self.slots.most))
            self.file.cut(self.slots.size)

    def get_rows(self, field: str, start: int, stop: int) -> NDArray[np.float32]:
        """Read the rows [start, stop) of a field. Raises ScratchError if the file is damaged."""
        rows = np.empty((stop - start, *self.fields[field]), np.float32)
        if rows.size == 0:
            return rows
        for number, mine, theirs in self._pieces(start, stop):
            rows[mine] = self._field(number, field)[theirs]
        return rows

    def set_rows(self, field: str, start: int, values: NDArray[np.float32]) -> None:
        """Replace the rows of a field from `start` on with `values`. Raises WriteError and ScratchError."""
        if values.size == 0:
            return
        for number, mine, theirs in self._pieces(start, start + len(values)):
            rows = self._field(number, field)
            rows[theirs] = values[mine]
            self._set_field(number, field, rows)

    def get_at(self, field: str, places: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
        """Read the rows with indices `places` (k,) of a field. Raises ScratchError if the file is damaged."""
        rows = np.empty((len(places), *self.fields[field]), np.float32)
        for number, mine in self._by_chunk(places) if rows.size else ():
            rows[mine] = self._field(number, field)[places[mine] - self.starts[number]]
        return rows

    def set_at(self, field: str, places: NDArray[np.integer[Any]], values: NDArray[np.float32]) -> None:
        """Replace the rows with indices `places` (k,) of a field by `values`. Raises WriteError and ScratchError."""
        for number, mine in self._by_chunk(places) if values.size else ():
            rows = self._field(number, field)
            rows[places[mine] - self.starts[number]] = values[mine]
            self._set_field(number, field, rows)

    def rows_of(
        self, numbers: NDArray[np.integer[Any]], kinds: Sequence[str], names: Iterable[str]
    ) -> dict[str, dict[str, NDArray[np.float32]]]:
        """Read all rows of the chunks `numbers`, of the fields named kind/name. Returns {kind: {name: rows}}."""
        records, mine = self.read(numbers), np.arange(CHUNK_ROWS) < self.lengths(numbers)[:, None]

        def rows(field: str) -> NDArray[np.float32]:
            if field in self._names:
                return np.asarray(records[field][mine])
            return np.zeros((np.count_nonzero(mine), *self.fields[field]), np.float32)

        return {kind: {name: rows(f"{kind}/{name}") for name in names} for kind in kinds}

    def blocks(self) -> Iterator[NDArray[np.int64]]:
        """Yield the numbers of all chunks in rising order, BLOCK_CHUNKS at a time."""
        for begin in range(0, self.chunks, BLOCK_CHUNKS):
            yield np.arange(begin, min(begin + BLOCK_CHUNKS, self.chunks))

    def change(self, field: str, change: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> None:
        """Replace the rows of a field by change(rows), chunk by chunk. Chunks that do not change are not written.

        Raises WriteError and ScratchError.
        """
        for number in range(self.chunks) if prod(self.fields[field]) else ():
            rows = self._field(number, field)
            own = rows[: self.starts[number + 1] - self.starts[number]]
            changed = change(own)
            if changed.tobytes() != own.tobytes():
                own[:] = changed
                self._set_field(number, field, rows)

    def fill(self, field: str, value: float) -> None:
        """Set all elements of a field to `value`. If this is a value of CONSTANTS, no chunk is read or written."""
        constant = next((each for each, known in CONSTANTS.items() if known == value), None)
        if constant is None:
            self.change(field, lambda rows: np.full_like(rows, value))
        elif field in self._names:
            self._constants[:, self._names.index(field)] = constant

    def rename(self, names: Mapping[str, str]) -> None:
        """Rename fields. names: new names by old names."""
        self._set_fields({names.get(name, name): shape for name, shape in self.fields.items()})

    def _set_fields(self, fields: Mapping[str, tuple[int, ...]]) -> None:
        self.fields, self.record = dict(fields), record_type(fields)
        self._names = tuple(self.record.names or ())

    def _give_back(self, before: int) -> None:
        """Free the memory of the chunks before number `before`, which are not read again."""
        for number in range(self._given_back, before) if self.path is None else ():
            self._memory[number] = None
        self._given_back = before

    def _pieces(self, start: int, stop: int) -> Iterator[tuple[int, slice, slice]]:
        """Split the rows [start, stop) by chunk. Yields a chunk's number, and two slices for its rows: relative to
        `start`, and to the chunk's first row."""
        number = int(chunk_of(self.starts, np.array(start)))
        while number < self.chunks and (first := int(self.starts[number])) < stop:
            begin, end = max(start, first), min(stop, int(self.starts[number + 1]))
            yield number, slice(begin - start, end - start), slice(begin - first, end - first)
            number += 1

    def _by_chunk(self, places: NDArray[np.integer[Any]]) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Group row indices `places` (k,) by chunk. Yields a chunk's number, and where in `places` its rows are."""
        chunks = chunk_of(self.starts, places)
        order = np.argsort(chunks, kind="stable")
        ends = np.flatnonzero(np.diff(chunks[order])) + 1
        for mine in np.split(order, ends) if len(places) else ():
            yield int(chunks[mine[0]]), mine

    def _in_memory(self, number: int) -> NDArray[np.uint8]:
        """Return the bytes of a chunk's record in main memory; zeros if it has not been written."""
        held = self._memory[number]
        if held is None:
            rows = int(self.starts[number + 1] - self.starts[number])
            held = self._memory[number] = np.zeros(rows * self.record.itemsize // CHUNK_ROWS, np.uint8)
        return held

    def _field(self, number: int, field: str) -> NDArray[np.float32]:
        """Return a field of a chunk: from a file a copy (CHUNK_ROWS, ...), from main memory a view (rows, ...)."""
        kind, offset = self.record.fields[field][:2]  # type: ignore[index]  # it has fields
        of_field = number, self._names.index(field)
        constant = int(self._constants[of_field])
        if self.path is None:
            length = int(self.starts[number + 1] - self.starts[number])
            begin, nbytes = (size * length // CHUNK_ROWS for size in (offset, kind.itemsize))
            held = self._in_memory(number)[begin : begin + nbytes]
            rows = held.view(np.float32).reshape(length, *kind.shape[1:])
            self._constants[of_field] = WRITTEN
        else:
            rows = np.empty(kind.shape, np.float32)
        if constant != WRITTEN:
            rows[:] = CONSTANTS[constant]
        elif self.path is not None:
            self.file.read_at(int(self.slots.current[number]), offset, rows)
            self._check(number, (field,), {field: rows})
        return rows

    def _set_field(self, number: int, field: str, rows: NDArray[np.float32]) -> None:
        """Replace a field of a chunk in the file by `rows`. In main memory do nothing: `rows` is the field itself."""
        if self.path is None:
            return
        numbers = np.array([number])
        if not self.slots.in_place(numbers)[0]:
            record = self.read(numbers)
            record[field][0] = rows
            self.write(numbers, record)
            return
        slot, of_field = int(self.slots.current[number]), (number, self._names.index(field))
        self.file.write_at(slot, self.record.fields[field][1], rows)  # type: ignore[index]
        self._checksums[of_field], self._constants[of_field] = zlib.crc32(rows.data), WRITTEN

    def _make_room(self, needed: Callable[[], int]) -> None:
        """Grow the file, or remove old checkpoints, until `needed()` slots are free. Raises WriteError."""
        assert self.path is not None
        while (lacking := needed() - self.slots.free) > 0:
            more = self.slots.growth(lacking)
            if not more and (kept := self.release()) is not None:
                self.slots.hold(kept)
                continue
            try:
                self.slots.grow(self.file.grow(self.slots.size, more or self.slots.least_growth(lacking), lacking))
            except WriteError:  # if the disk is full, remove an old checkpoint to free slots
                if (kept := self.release()) is None:
                    raise
                self.slots.hold(kept)

    def _check(self, number: int, names: Sequence[str], record: Any) -> None:
        """Raise ScratchError if a field of the chunk's record has another checksum than when it was written."""
        for name in names:
            of_field = number, self._names.index(name)
            if self._constants[of_field] == WRITTEN and zlib.crc32(record[name]) != self._checksums[of_field]:
                raise ScratchError(f"{self.path}: chunk {number} of the model has changed since it was written")


def _filled(records: NDArray[Any], rows: int) -> NDArray[np.bool_]:
    """Return a mask (k, CHUNK_ROWS) of k records: True for the first `rows` rows, counted through all records."""
    return np.arange(len(records) * CHUNK_ROWS).reshape(-1, CHUNK_ROWS) < rows


def _checksums(records: NDArray[Any]) -> NDArray[np.uint32]:
    """Return the crc32 (k, fields) of each field of records (k,)."""
    names = records.dtype.names or ()
    return np.array([[zlib.crc32(record[name]) for name in names] for record in records], np.uint32)


def _carried(values: NDArray[Any], to: Division, shape: tuple[int, int]) -> NDArray[Any]:
    """Return an array of this shape: the row of `values` for each chunk that `to` keeps, zeros for other chunks."""
    carried, stays = np.zeros(shape, values.dtype), to.kept != NEW
    if stays.any():
        carried[stays] = values[to.kept[stays]]
    return carried


def _packed(record: NDArray[Any], rows: int) -> NDArray[np.uint8]:
    """Return the bytes of the first `rows` rows of a record (1,), one field after the other."""
    if rows == CHUNK_ROWS:
        return np.array(record).view(np.uint8)
    return np.concatenate([record[name][0, :rows].reshape(-1) for name in record.dtype.names or ()]).view(np.uint8)


def _unpack(packed: NDArray[np.uint8], rows: int, record: NDArray[Any]) -> None:
    """Copy `packed`, the bytes of `rows` rows of each field, one field after the other, to a record (1,)."""
    if rows == CHUNK_ROWS:
        record.view(np.uint8)[:] = packed
        return
    begin, values = 0, packed.view(np.float32)
    for name in record.dtype.names or ():
        field = record[name][0, :rows]
        field[:] = values[begin : begin + field.size].reshape(field.shape)
        begin += field.size

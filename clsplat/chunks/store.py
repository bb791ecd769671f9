# SPDX-License-Identifier: Apache-2.0
"""Records of a model's chunks, in main memory or in a scratch file.

A record has all fields of CHUNK_ROWS rows, one field after the other, so that a chunk moves by one read or write. In a
file each field of a record has a checksum, so that a file that was cut or changed never gives a wrong row. A chunk that
a kept checkpoint names is not overwritten, but written to another slot (docs/decisions/0052-a-store-of-chunks.md). A
field that was filled with a constant is only noted as such.
"""

from __future__ import annotations

import os
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from io import FileIO
from itertools import pairwise
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.chunks.manifest import CONSTANTS, WRITTEN, ZERO, Manifest, chunks_of
from clsplat.chunks.slots import NO_SLOT, SlotTable
from clsplat.errors import InputError, WriteError, reason_of
from clsplat.files.atomic import remove, require_room, sync_folder, write_error
from clsplat.layouts.columns import CHUNK_ROWS

BLOCK_CHUNKS = 16
"""Chunks that are read or written at once where all of them are."""


class ScratchError(InputError):
    """A scratch file that cannot be used any longer. No row of it has been used that is not as it was written."""


KeptSlots = Sequence[NDArray[np.int64]]
"""Slots of the chunks of each kept checkpoint."""


def record_type(fields: Mapping[str, tuple[int, ...]]) -> np.dtype[Any]:
    """The structured type of a record. fields: shape of a row of each field, float32, by name."""
    return np.dtype([(name, np.float32, (CHUNK_ROWS, *shape)) for name, shape in fields.items() if prod(shape)])


class ChunkStore:
    """Records of the chunks of a model of `count` Gaussians, all zero at first.

    fields: shape of a row of each field, by name. A field without elements takes no place in the records.
    path: scratch file that holds the records, which is made anew; None holds them in main memory.
    opened: that file as it is, and a checkpoint's manifest of it.
    release: function that is called where the file would become larger than `SlotTable.most`. It removes the oldest
        checkpoint and returns the slots of those that are left, or None if all have to stay.
    moved: function that is called with the bytes of each read or write, and its seconds.
    Raises WriteError for a file that cannot be made, or a disk without room for it.
    """

    def __init__(
        self,
        count: int,
        fields: Mapping[str, tuple[int, ...]],
        path: Path | None = None,
        *,
        opened: tuple[FileIO, Manifest] | None = None,
    ) -> None:
        self.count, self.fields, self.path = count, dict(fields), path
        self.chunks, self.record = chunks_of(count), record_type(fields)
        self.release: Callable[[], KeptSlots | None] = lambda: None
        self.moved: Callable[[int, float], object] = lambda _nbytes, _seconds: None
        self._memory: list[NDArray[np.uint8] | None] = [None] * self.chunks if path is None else []
        """The bytes of each chunk in main memory, None before it is written: an array each, to be given back alone."""
        self._given_back = 0
        self._names = tuple(self.record.names or ())
        self._constants = np.full((self.chunks, len(self._names)), ZERO)
        """By chunk and field, ZERO or INFINITE if all elements are that, whatever the record has; else WRITTEN."""
        if path is None:
            return
        if opened is not None:
            self._file, manifest = opened
            size = os.fstat(self._file.fileno()).st_size // self.record.itemsize
            self._checksums, self._constants = manifest.checksums.copy(), manifest.constants.copy()
            current = manifest.slots.copy()
        else:
            self._file, size = _new_file(path, self.nbytes), self.chunks
            self._checksums = np.zeros((self.chunks, len(self._names)), np.uint32)
            current = np.full(self.chunks, NO_SLOT, np.int64)
        if (most := int(current.max(initial=NO_SLOT))) >= size:
            self._file.close()
            raise ScratchError(f"{path}: has been cut: it has room for {size} chunks, expected at least {most + 1}")
        self.slots = SlotTable(current, size)

    @classmethod
    def opened(cls, manifest: Manifest, *, writable: bool) -> ChunkStore:
        """The records that a checkpoint names. Raises ScratchError for a file that is missing or too short."""
        try:
            file = FileIO(manifest.path, "r+" if writable else "r")
        except OSError as error:
            raise ScratchError(f"{manifest.path} cannot be opened: {reason_of(error)}") from None
        return cls(manifest.count, manifest.fields, manifest.path, opened=(file, manifest))

    def manifest(self) -> Manifest:
        """List of the chunks for a checkpoint. All that was written is on the disk then. Raises WriteError."""
        assert self.path is not None
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise write_error(str(self.path), error) from None
        sync_folder(self.path.parent)
        arrays = self.slots.current.copy(), self._checksums.copy(), self._constants.copy()
        return Manifest(self.path, self.count, self.fields, *arrays)

    @property
    def is_lost(self) -> bool:
        """True if the scratch file has been removed, or another is in its place. What it has can still be read."""
        assert self.path is not None
        try:
            return not os.path.samestat(os.fstat(self._file.fileno()), self.path.stat())
        except OSError:
            return True

    def verify(self) -> None:
        """Read all chunks. Raises ScratchError if one is not as it was written."""
        for numbers in self.blocks():
            self.read(numbers)

    @property
    def nbytes(self) -> int:
        """Bytes of all records."""
        return self.chunks * self.record.itemsize

    def close(self) -> None:
        """Give back the memory, or remove the file unless a checkpoint names slots of it. The store cannot be used any
        longer."""
        self._memory.clear()
        if self.path is None or self._file.closed:
            return
        kept, writable = self.slots.end_of_held, self._file.writable()
        with suppress(OSError):
            if writable and kept:
                self._file.truncate(kept * self.record.itemsize)
        self._file.close()
        with suppress(OSError):
            if writable and not kept:
                remove(self.path)

    def read(self, numbers: NDArray[np.integer[Any]]) -> NDArray[Any]:
        """Records (k,) of these chunks. Rows behind the model's last one are undefined.

        Raises ScratchError if the file has not what was written.
        """
        records = np.empty(len(numbers), self.record)
        if self.path is None:
            for row, number in zip(_rows_of(records), numbers, strict=True):
                if (held := self._memory[number]) is not None:
                    row[:] = held
        else:
            for begin, first, length in runs(self.slots.current[numbers]):
                self._read_at(first * self.record.itemsize, records[begin : begin + length])
            for place, number in enumerate(numbers):
                self._check(int(number), self._names, records[place])
        constants = self._constants[numbers]
        for index in np.flatnonzero(constants.any(axis=0)):
            for constant, value in CONSTANTS.items():
                records[self._names[index]][constants[:, index] == constant] = value
        return records

    def write(self, numbers: NDArray[np.integer[Any]], records: NDArray[Any]) -> None:
        """Replace the records of these chunks. Raises WriteError if they cannot be written."""
        if self.path is None:
            for row, number in zip(_rows_of(records), numbers, strict=True):
                self._in_memory(int(number))[:] = row
            self._constants[numbers] = WRITTEN
            return
        self._make_room(numbers)
        slots = self.slots.targets(numbers)
        for begin, first, length in runs(slots):
            self._write_at(first * self.record.itemsize, records[begin : begin + length])
        self.slots.written(numbers, slots)
        for place, number in enumerate(numbers):
            self._checksums[number] = [zlib.crc32(records[place][name]) for name in self._names]
        self._constants[numbers] = WRITTEN

    def get_rows(self, field: str, start: int, stop: int) -> NDArray[np.float32]:
        """A copy of the rows [start, stop) of a field. Raises ScratchError as `read`."""
        rows = np.empty((stop - start, *self.fields[field]), np.float32)
        if rows.size == 0:
            return rows
        for number, mine, theirs in _pieces(start, stop):
            rows[mine] = self._field(number, field)[theirs]
        return rows

    def set_rows(self, field: str, start: int, values: NDArray[np.float32]) -> None:
        """Replace the rows of a field that begin at `start`. Raises WriteError and ScratchError."""
        if values.size == 0:
            return
        for number, mine, theirs in _pieces(start, start + len(values)):
            rows = self._field(number, field)
            rows[theirs] = values[mine]
            self._set_field(number, field, rows)

    def get_at(self, field: str, places: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
        """A copy of the rows (k,) of a field at these places. Raises ScratchError as `read`."""
        rows = np.empty((len(places), *self.fields[field]), np.float32)
        for number, mine in _by_chunk(places) if rows.size else ():
            rows[mine] = self._field(number, field)[places[mine] % CHUNK_ROWS]
        return rows

    def set_at(self, field: str, places: NDArray[np.integer[Any]], values: NDArray[np.float32]) -> None:
        """Replace the rows (k,) of a field at these places. Raises WriteError and ScratchError."""
        for number, mine in _by_chunk(places) if values.size else ():
            rows = self._field(number, field)
            rows[places[mine] % CHUNK_ROWS] = values[mine]
            self._set_field(number, field, rows)

    def rows_of(
        self, numbers: NDArray[np.integer[Any]], kinds: Sequence[str], names: Iterable[str]
    ) -> dict[str, dict[str, NDArray[np.float32]]]:
        """Rows of the model in these chunks, in rising order: fields `kind`/`name` by kind and name."""
        records = self.read(numbers)
        rows = CHUNK_ROWS * len(numbers)
        if len(numbers) and numbers[-1] == self.chunks - 1:
            rows -= -self.count % CHUNK_ROWS
        return {kind: {name: self._rows(records, f"{kind}/{name}")[:rows] for name in names} for kind in kinds}

    def _rows(self, records: NDArray[Any], field: str) -> NDArray[np.float32]:
        shape = (len(records) * CHUNK_ROWS, *self.fields[field])
        return records[field].reshape(shape) if field in self._names else np.zeros(shape, np.float32)

    def blocks(self) -> Iterator[NDArray[np.int64]]:
        """Numbers of all chunks, some at a time, in rising order."""
        for begin in range(0, self.chunks, BLOCK_CHUNKS):
            yield np.arange(begin, min(begin + BLOCK_CHUNKS, self.chunks))

    def change(self, field: str, change: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> None:
        """Replace the rows of a field with what a function makes of them, chunk by chunk. Chunks that it leaves as they
        are, are not written. Raises WriteError and ScratchError."""
        for number in range(self.chunks) if prod(self.fields[field]) else ():
            rows = self._field(number, field)
            own = rows[: self.count - CHUNK_ROWS * number]
            changed = change(own)
            if changed.tobytes() != own.tobytes():
                own[:] = changed
                self._set_field(number, field, rows)

    def fill(self, field: str, value: float) -> None:
        """Set every element of a field. If the value is one of CONSTANTS, no chunk is read or written."""
        constant = next((each for each, known in CONSTANTS.items() if known == value), None)
        if constant is None:
            self.change(field, lambda rows: np.full_like(rows, value))
        elif field in self._names:
            self._constants[:, self._names.index(field)] = constant

    def rename(self, names: Mapping[str, str]) -> None:
        """Give fields other names. names: the new names by the old ones."""
        self.fields = {names.get(name, name): shape for name, shape in self.fields.items()}
        self.record = record_type(self.fields)
        self._names = tuple(self.record.names or ())

    def give_back(self, before: int) -> None:
        """Give back the memory of the chunks below number `before`, which nobody reads again."""
        for number in range(self._given_back, before) if self.path is None else ():
            self._memory[number] = None
        self._given_back = before

    def _in_memory(self, number: int) -> NDArray[np.uint8]:
        """The bytes of a chunk in main memory."""
        held = self._memory[number]
        if held is None:
            held = self._memory[number] = np.zeros(self.record.itemsize, np.uint8)
        return held

    def _field(self, number: int, field: str) -> NDArray[np.float32]:
        """A field (CHUNK_ROWS, ...) of a chunk's record. In main memory it is the field itself."""
        kind, offset = self.record.fields[field][:2]  # type: ignore[index]  # it has fields
        of_field = number, self._names.index(field)
        constant = int(self._constants[of_field])
        if self.path is None:
            held = self._in_memory(number)[offset : offset + kind.itemsize]
            rows = held.view(np.float32).reshape(kind.shape)
            self._constants[of_field] = WRITTEN
        else:
            rows = np.empty(kind.shape, np.float32)
        if constant != WRITTEN:
            rows[:] = CONSTANTS[constant]
        elif self.path is not None:
            self._read_at(int(self.slots.current[number]) * self.record.itemsize + offset, rows)
            self._check(number, (field,), {field: rows})
        return rows

    def _set_field(self, number: int, field: str, rows: NDArray[np.float32]) -> None:
        """Write a field that `_field` returned, and that has changed since."""
        if self.path is None:
            return
        numbers = np.array([number])
        if not self.slots.in_place(numbers)[0]:
            record = self.read(numbers)
            record[field][0] = rows
            self.write(numbers, record)
            return
        slot, of_field = int(self.slots.current[number]), (number, self._names.index(field))
        self._write_at(slot * self.record.itemsize + self.record.fields[field][1], rows)  # type: ignore[index]
        self._checksums[of_field], self._constants[of_field] = zlib.crc32(rows.data), WRITTEN

    def _make_room(self, numbers: NDArray[np.integer[Any]]) -> None:
        """Let the file have free slots for these chunks. Raises WriteError."""
        assert self.path is not None
        while (lacking := self.slots.lacking(numbers)) > 0:
            more = self.slots.growth(lacking)
            if not more and (kept := self.release()) is not None:
                self.slots.hold(kept)
                continue
            more = more or lacking
            _reserve(self._file, self.path, self.slots.size * self.record.itemsize, more * self.record.itemsize)
            self.slots.grow(more)

    def _check(self, number: int, names: Sequence[str], record: Any) -> None:
        """Raise ScratchError if fields of a record differ from what was written."""
        for name in names:
            of_field = number, self._names.index(name)
            if self._constants[of_field] == WRITTEN and zlib.crc32(record[name]) != self._checksums[of_field]:
                raise ScratchError(f"{self.path}: chunk {number} of the model has changed since it was written")

    def _read_at(self, offset: int, into: NDArray[Any]) -> None:
        left, start = into.view(np.uint8).reshape(-1).data, time.perf_counter()
        try:
            self._file.seek(offset)
            while left and (count := self._file.readinto(left)):
                left = left[count:]
        except OSError as error:
            raise ScratchError(f"{self.path} cannot be read ({reason_of(error)})") from None
        if left:
            raise ScratchError(f"{self.path}: has been cut: {len(left):,} bytes at {offset:,} are missing")
        self.moved(into.nbytes, time.perf_counter() - start)

    def _write_at(self, offset: int, values: NDArray[Any]) -> None:
        left, start = np.ascontiguousarray(values).view(np.uint8).reshape(-1).data, time.perf_counter()
        try:
            self._file.seek(offset)
            while left:
                left = left[self._file.write(left) :]
        except OSError as error:
            raise write_error(str(self.path), error, needs=self.nbytes) from None
        self.moved(values.nbytes, time.perf_counter() - start)


def runs(slots: NDArray[np.int64]) -> Iterator[tuple[int, int, int]]:
    """Yield (place, slot, length) of each run of slots that follow each other. NO_SLOT is left out."""
    ends = np.flatnonzero((np.diff(slots) != 1) | (slots[:-1] == NO_SLOT)) + 1
    for begin, end in pairwise([0, *ends.tolist(), len(slots)]):
        if begin < end and slots[begin] != NO_SLOT:
            yield begin, int(slots[begin]), end - begin


def _pieces(start: int, stop: int) -> Iterator[tuple[int, slice, slice]]:
    """Yield, for each chunk that has some of the rows [start, stop), its number, these rows among them, and in it."""
    for number in range(start // CHUNK_ROWS, chunks_of(stop)):
        first = CHUNK_ROWS * number
        begin, end = max(start, first), min(stop, first + CHUNK_ROWS)
        yield number, slice(begin - start, end - start), slice(begin - first, end - first)


def _by_chunk(places: NDArray[np.integer[Any]]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield, for each chunk that has some of the rows at these places, its number, and which of them it has."""
    chunks = places // CHUNK_ROWS
    order = np.argsort(chunks, kind="stable")
    ends = np.flatnonzero(np.diff(chunks[order])) + 1
    for mine in np.split(order, ends) if len(places) else ():
        yield int(chunks[mine[0]]), mine


def _rows_of(records: NDArray[Any]) -> NDArray[np.uint8]:
    """The bytes (k, itemsize) of records (k,)."""
    return np.ascontiguousarray(records).view(np.uint8).reshape(len(records), records.dtype.itemsize)


def _new_file(path: Path, nbytes: int) -> FileIO:
    """A new file of that size. Raises WriteError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = FileIO(path, "x+")
    except OSError as error:
        raise write_error(path, error, needs=nbytes) from None
    try:
        _reserve(file, path, 0, nbytes)
    except BaseException:
        file.close()
        with suppress(OSError):
            remove(path)
        raise
    return file


def _reserve(file: FileIO, path: Path, offset: int, nbytes: int) -> None:
    """Let a file grow by so many bytes at `offset`, so that a full disk is known before a row is written. Raises
    WriteError."""
    try:
        with require_room(path, nbytes):
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), offset, nbytes)
            else:
                file.truncate(offset + nbytes)
    except OSError as error:
        raise error if isinstance(error, WriteError) else write_error(path, error, needs=nbytes) from None

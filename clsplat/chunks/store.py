# SPDX-License-Identifier: Apache-2.0
"""Records of a model's chunks, in main memory or in a scratch file.

A record has all fields of CHUNK_ROWS rows, one field after the other, so that a chunk moves by one read or write. In a
file each field of a record has a checksum, so that a file that was cut or changed never gives a wrong row. The file is
read and not mapped, because a file that is cut while it is mapped would end the process
(docs/decisions/0045-photographs-by-the-slice.md). What it holds of main memory is the system's file cache, which gives
way to other needs.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from io import FileIO
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError, reason_of
from clsplat.files.atomic import remove, require_room, write_error
from clsplat.layouts.columns import CHUNK_ROWS

BLOCK_CHUNKS = 16
"""Chunks that are read or written at once where all of them are."""


class ScratchError(InputError):
    """A scratch file that cannot be used any longer. No row of it has been used that is not as it was written."""


def chunks_of(rows: int) -> int:
    """Number of chunks of a model of `rows` Gaussians."""
    return -(-rows // CHUNK_ROWS)


def record_type(fields: Mapping[str, tuple[int, ...]]) -> np.dtype[Any]:
    """The structured type of a record. fields: shape of a row of each field, float32, by name."""
    return np.dtype([(name, np.float32, (CHUNK_ROWS, *shape)) for name, shape in fields.items() if prod(shape)])


class ChunkStore:
    """Records of the chunks of a model of `count` Gaussians, all zero at first.

    fields: shape of a row of each field, by name. A field without elements takes no place in the records.
    path: scratch file that holds the records, which is made anew; None holds them in main memory.
    Raises WriteError for a file that cannot be made, or a disk without room for it.
    """

    def __init__(self, count: int, fields: Mapping[str, tuple[int, ...]], path: Path | None = None) -> None:
        self.count, self.fields, self.path = count, dict(fields), path
        self.chunks, self.record = chunks_of(count), record_type(fields)
        self._memory: list[NDArray[np.uint8] | None] = [None] * self.chunks if path is None else []
        """The bytes of each chunk in main memory, None for zeros: an array each, to be given back alone."""
        self._given_back = 0
        if path is None:
            return
        self._names = tuple(self.record.names or ())
        self._checksums = np.zeros((self.chunks, len(self._names)), np.uint32)
        self._written = np.zeros(self.chunks, np.bool_)
        """Chunks that are in the file; the others are zero."""
        self._file = _new_file(path, self.nbytes)

    @property
    def nbytes(self) -> int:
        """Bytes of all records."""
        return self.chunks * self.record.itemsize

    def close(self) -> None:
        """Remove the file, or give back the memory. The store cannot be used any longer."""
        self._memory.clear()
        if self.path is not None:
            self._file.close()
            with suppress(OSError):
                remove(self.path)

    def read(self, numbers: NDArray[np.integer[Any]]) -> NDArray[Any]:
        """Records (k,) of these chunks. Rows behind the model's last one are undefined.

        Raises ScratchError if the file has not what was written.
        """
        records = np.empty(len(numbers), self.record)
        if self.path is None:
            for row, number in zip(_rows_of(records), numbers, strict=True):
                held = self._memory[number]
                row[:] = 0 if held is None else held
            return records
        for begin, first, length in runs(numbers):
            self._read_at(first * self.record.itemsize, records[begin : begin + length])
        for place, number in enumerate(numbers):
            if self._written[number]:
                self._check(int(number), self._names, records[place])
            else:
                records[place] = np.zeros((), self.record)
        return records

    def write(self, numbers: NDArray[np.integer[Any]], records: NDArray[Any]) -> None:
        """Replace the records of these chunks. Raises WriteError if they cannot be written."""
        if self.path is None:
            for row, number in zip(_rows_of(records), numbers, strict=True):
                self._in_memory(int(number))[:] = row
            return
        for place, number in enumerate(numbers):
            self._checksums[number] = [zlib.crc32(records[place][name]) for name in self._names]
        for begin, first, length in runs(numbers):
            self._write_at(first * self.record.itemsize, records[begin : begin + length])
        self._written[numbers] = True

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
        if self.path is None:
            held = self._in_memory(number)[offset : offset + kind.itemsize]
            return held.view(np.float32).reshape(kind.shape)
        rows = np.zeros(kind.shape, np.float32)
        if self._written[number]:
            self._read_at(number * self.record.itemsize + offset, rows)
            self._check(number, (field,), {field: rows})
        return rows

    def _set_field(self, number: int, field: str, rows: NDArray[np.float32]) -> None:
        """Write a field that `_field` returned, and that has changed since."""
        if self.path is None:
            return
        if not self._written[number]:
            self.write(np.array([number]), np.zeros(1, self.record))
        self._checksums[number, self._names.index(field)] = zlib.crc32(rows.data)
        self._write_at(number * self.record.itemsize + self.record.fields[field][1], rows)  # type: ignore[index]

    def _check(self, number: int, names: Sequence[str], record: Any) -> None:
        """Raise ScratchError if fields of a record differ from what was written."""
        for name in names:
            if zlib.crc32(record[name]) != self._checksums[number, self._names.index(name)]:
                raise ScratchError(f"{self.path}: chunk {number} of the model has changed since it was written")

    def _read_at(self, offset: int, into: NDArray[Any]) -> None:
        """Read an array. What is behind the file's end is left as it is: its checksum tells."""
        left = into.view(np.uint8).reshape(-1).data
        try:
            self._file.seek(offset)
            while left and (count := self._file.readinto(left)):
                left = left[count:]
        except OSError as error:
            raise ScratchError(f"{self.path} cannot be read ({reason_of(error)})") from None

    def _write_at(self, offset: int, values: NDArray[Any]) -> None:
        left = np.ascontiguousarray(values).view(np.uint8).reshape(-1).data
        try:
            self._file.seek(offset)
            while left:
                left = left[self._file.write(left) :]
        except OSError as error:
            raise write_error(str(self.path), error, needs=self.nbytes) from None


def runs(numbers: NDArray[np.integer[Any]]) -> Iterator[tuple[int, int, int]]:
    """Yield (place, number, length) of each run of numbers that follow each other."""
    ends = np.flatnonzero(np.diff(numbers) != 1) + 1
    begins = [0, *ends.tolist()] if len(numbers) else []
    for begin, end in zip(begins, [*begins[1:], len(numbers)], strict=True):
        yield begin, int(numbers[begin]), end - begin


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
    """A new file of that size, so that a full disk is known before the first row is written. Raises WriteError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):
            remove(path)  # of a training that was killed
        with require_room(path, nbytes):
            file = FileIO(path, "x+")
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, nbytes)
    except OSError as error:
        with suppress(OSError):
            remove(path)
        raise write_error(path, error, needs=nbytes) from None
    return file

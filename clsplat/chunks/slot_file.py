# SPDX-License-Identifier: Apache-2.0
"""Reads and writes scratch files, whose slots hold the records of a model's chunks."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from io import FileIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.chunks.slots import NO_SLOT
from clsplat.errors import InputError, WriteError, reason_of
from clsplat.files.atomic import remove, require_room, sync_folder, write_error


class ScratchError(InputError):
    """Raised if a scratch file cannot be read, or differs from the data written. No wrong row has been used."""


class SlotFile:
    """A file of slots of `slot_bytes` bytes each. A chunk's record is at the beginning of its slot.

    moved: function that is called after each read or write with its number of bytes and its seconds.
    """

    def __init__(self, path: Path, slot_bytes: int, file: FileIO) -> None:
        self.path, self.slot_bytes, self._file = path, slot_bytes, file
        self.moved: Callable[[int, float], object] = lambda _nbytes, _seconds: None
        self.request: Future[None] | None = None
        """The latest request of `read_ahead`."""

    @classmethod
    def new(cls, path: Path, slot_bytes: int, slots: int) -> SlotFile:
        """Create a file with `slots` slots. Raises WriteError."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            made = cls(path, slot_bytes, FileIO(path, "x+"))
        except OSError as error:
            raise write_error(path, error, needs=slots * slot_bytes) from None
        try:
            made.grow(0, slots, slots)
        except BaseException:
            made.close()
            with suppress(OSError):
                remove(path)
            raise
        return made

    @classmethod
    def opened(cls, path: Path, slot_bytes: int, *, writable: bool) -> SlotFile:
        """Open an existing file. Raises ScratchError."""
        try:
            return cls(path, slot_bytes, FileIO(path, "r+" if writable else "r"))
        except OSError as error:
            raise ScratchError(f"{path}: cannot be opened: {reason_of(error)}") from None

    @property
    def slots(self) -> int:
        """Number of slots that the file has."""
        return os.fstat(self._file.fileno()).st_size // self.slot_bytes

    @property
    def closed(self) -> bool:
        """True after `close`."""
        return self._file.closed

    @property
    def writable(self) -> bool:
        """True if the file was created, or opened for writing."""
        return self._file.writable()

    @property
    def is_lost(self) -> bool:
        """True if the file's name has been removed, or names another file. The open file can still be read."""
        try:
            return not os.path.samestat(os.fstat(self._file.fileno()), self.path.stat())
        except OSError:
            return True

    def sync(self) -> None:
        """Flush all writes to the disk. Raises WriteError."""
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise write_error(str(self.path), error) from None
        sync_folder(self.path.parent)

    def grow(self, slots: int, more: int, least: int) -> int:
        """Add slots behind the first `slots` slots, and reserve disk space for them, so that later writes have room.

        more: number of slots to add.
        least: number of slots to add if the disk has too little room for `more`.
        Returns the number of added slots. Raises WriteError if there is too little room for `least` slots.
        """
        try:
            self._reserve(slots * self.slot_bytes, more * self.slot_bytes)
        except WriteError:
            if more <= least:
                raise
            more = least
            self._reserve(slots * self.slot_bytes, more * self.slot_bytes)
        return more

    def _reserve(self, offset: int, nbytes: int) -> None:
        try:
            with require_room(self.path, nbytes):
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(self._file.fileno(), offset, nbytes)
                else:
                    self._file.truncate(offset + nbytes)
        except OSError as error:
            raise error if isinstance(error, WriteError) else write_error(self.path, error, needs=nbytes) from None

    def cut(self, slots: int) -> None:
        """Cut the file after its first `slots` slots. If the system does not allow this, the file stays longer."""
        with suppress(OSError):
            self._file.truncate(slots * self.slot_bytes)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, slots: NDArray[np.int64], records: NDArray[Any]) -> None:
        """Read slots (k,) into `records` (k,). Records whose slot is NO_SLOT stay unchanged. Raises ScratchError."""
        for place, slot, length in self._runs(slots, records.itemsize):
            self.read_at(slot, 0, records[place : place + length])

    def write(self, slots: NDArray[np.int64], records: NDArray[Any]) -> None:
        """Write records (k,) to slots (k,). Raises WriteError."""
        for place, slot, length in self._runs(slots, records.itemsize):
            self.write_at(slot, 0, records[place : place + length])

    def read_ahead(self, slots: NDArray[np.int64]) -> None:
        """Ask the system to read slots from the disk while other work goes on.

        A thread makes the request, which may block until the disk has read the slots. Until then, further calls do
        nothing.
        """
        if hasattr(os, "posix_fadvise") and (self.request is None or self.request.done()):
            self.request = _reader().submit(self._request, list(runs(slots)))

    def _request(self, pieces: Sequence[tuple[int, int, int]]) -> None:
        size = self.slot_bytes
        with suppress(OSError, ValueError):  # the file is closed, or its disk cannot read ahead
            for _, slot, length in pieces:
                os.posix_fadvise(self._file.fileno(), slot * size, length * size, os.POSIX_FADV_WILLNEED)

    def read_at(self, slot: int, offset: int, into: NDArray[Any]) -> None:
        """Fill `into` with the bytes that begin `offset` bytes after the start of `slot`. Raises ScratchError."""
        left, start, begin = into.view(np.uint8).reshape(-1).data, time.perf_counter(), slot * self.slot_bytes + offset
        try:
            self._file.seek(begin)
            while left and (count := self._file.readinto(left)):
                left = left[count:]
        except OSError as error:
            raise ScratchError(f"{self.path}: cannot be read: {reason_of(error)}") from None
        if left:
            raise ScratchError(f"{self.path}: has been cut: {len(left):,} bytes at {begin:,} are missing")
        self.moved(into.nbytes, time.perf_counter() - start)

    def write_at(self, slot: int, offset: int, values: NDArray[Any]) -> None:
        """Write the bytes of `values` to the file, beginning `offset` bytes after the start of `slot`. Raises
        WriteError."""
        left, start = np.ascontiguousarray(values).view(np.uint8).reshape(-1).data, time.perf_counter()
        try:
            self._file.seek(slot * self.slot_bytes + offset)
            while left:
                left = left[self._file.write(left) :]
        except OSError as error:
            raise write_error(str(self.path), error, needs=values.nbytes) from None
        self.moved(values.nbytes, time.perf_counter() - start)

    def _runs(self, slots: NDArray[np.int64], nbytes: int) -> Iterator[tuple[int, int, int]]:
        """Yield (index, slot, length), as `runs` does, of each run of records that can be read or written at once.

        nbytes: size of a record. If it is smaller than a slot, the records are yielded one by one.
        """
        for place, slot, length in runs(slots):
            step = length if nbytes == self.slot_bytes else 1
            for begin in range(0, length, step):
                yield place + begin, slot + begin, step


@cache
def _reader() -> ThreadPoolExecutor:
    """Return the thread that makes the requests of `SlotFile.read_ahead`."""
    return ThreadPoolExecutor(1, "clsplat-read-ahead")


def runs(slots: NDArray[np.int64]) -> Iterator[tuple[int, int, int]]:
    """Yield (index, slot, length) of each run of consecutive slot numbers.

    index: position in `slots` at which the run begins.
    slot, length: first slot number of the run, and number of its slots. Entries that are NO_SLOT are left out.
    """
    ends = np.flatnonzero((np.diff(slots) != 1) | (slots[:-1] == NO_SLOT)) + 1
    for begin, end in pairwise([0, *ends.tolist(), len(slots)]):
        if begin < end and slots[begin] != NO_SLOT:
            yield begin, int(slots[begin]), end - begin

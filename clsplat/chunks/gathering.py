# SPDX-License-Identifier: Apache-2.0
"""Rows of a streamed model after density control: which rows are kept and copied, and the records of the new chunks.

New rows stand behind the rows that they are copied from. So a new record needs only a few old ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.chunks.division import NEW, Division, chunk_of
from clsplat.chunks.order import beside_parents
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.optimisation.density_rules import FRESH

BLOCK_CHUNKS = 16
"""Number of chunks that are read or written at a time in passes over many chunks."""
_KEPT, _CLONE, _FIRST_HALF, _SECOND_HALF = range(4)
"""Kinds of rows after density control. A row list sorted by kind has the rows in the order of these numbers."""


@dataclass(frozen=True, eq=False)
class SourceList:
    """The rows of a model after density control, on the host, in the order of their sources.

    rows: (m,) uint32, the source row of each row, with the bit FRESH set if the row is new.
    seconds: (k,) uint32, indices into `rows` of the second halves of split Gaussians. Each second half directly follows
        its first half.
    """

    rows: NDArray[np.uint32]
    seconds: NDArray[np.uint32]

    @property
    def count(self) -> int:
        """Number of rows."""
        return len(self.rows)

    @property
    def halves(self) -> int:
        """Number of rows that are halves of split Gaussians."""
        return 2 * len(self.seconds)

    def by_kind(self) -> NDArray[np.uint32]:
        """Return the order (m,) that sorts the rows by kind: remaining rows, clones, first halves, second halves."""
        kinds = np.where(self.rows < FRESH, np.uint8(_KEPT), np.uint8(_CLONE))
        kinds[self.seconds - 1], kinds[self.seconds] = _FIRST_HALF, _SECOND_HALF
        return np.argsort(kinds, kind="stable").astype(np.uint32)

    def entries(self) -> NDArray[np.uint32]:
        """Return the rows, sorted by kind."""
        return self.rows[self.by_kind()]


def row_entries(rows: NDArray[np.uint32], fresh: NDArray[np.bool_] | None) -> NDArray[np.uint32]:
    """Return source rows as entries of a row list: with the bit FRESH set where `fresh` is True."""
    return rows.astype(np.uint32) if fresh is None else np.where(fresh, rows | FRESH, rows).astype(np.uint32)


def in_source_order(parts: Iterable[NDArray[np.uint32]]) -> SourceList:
    """Merge row lists into one, in the order of their source rows.

    parts: a list for each range of old rows, sorted as by `SourceList.by_kind`.
    """
    rows, seconds, count = [], [], 0
    for part in parts:
        entries = part[beside_parents(part & ~FRESH)]
        twice = entries[1:] == entries[:-1]  # only a split Gaussian has two equal entries
        seconds.append((np.flatnonzero(twice) + (count + 1)).astype(np.uint32))
        rows.append(entries)
        count += len(entries)
    return SourceList(_joined(rows), _joined(seconds))


def _joined(parts: list[NDArray[np.uint32]]) -> NDArray[np.uint32]:
    """Concatenate the parts. The memory of each part is freed as soon as the part is copied."""
    whole = np.empty(sum(map(len, parts)), np.uint32)
    end = len(whole)
    while parts:
        part = parts.pop()
        whole[end - len(part) : end] = part
        end -= len(part)
    return whole


Reader = Callable[[NDArray[np.int64]], NDArray[Any]]
"""Function from numbers of chunks (k,) to their records (k,)."""


@dataclass(frozen=True, eq=False)
class NewValues:
    """Values of fields that are not copied from the source row.

    fresh: the value of a field in FRESH rows, by the field's kind, the part of its name before "/": for example "first"
        for first moments. Fields of kinds that are not listed are copied.
    initial: values of new fields, and of the fields `anew`; 0 if a field is not listed.
    anew: fields that get their initial value in every row.
    """

    fresh: Mapping[str, float] = field(default_factory=lambda: {"first": 0.0, "second": 0.0})
    initial: Mapping[str, float] = field(default_factory=dict)
    anew: frozenset[str] = frozenset()


_MOVED_AS_THEY_ARE = NewValues()


@dataclass(frozen=True, eq=False)
class OldChunks:
    """The chunks of a model before its rows move.

    starts: first rows of the chunks, as in `Division`.
    read: function that returns the records of some of these chunks.
    """

    starts: NDArray[np.int64]
    read: Reader


def gathered(
    rows: NDArray[np.uint32] | None,
    old: OldChunks,
    to: Division,
    record: np.dtype[Any],
    passed: Callable[[int], None] = lambda _: None,
    values: NewValues = _MOVED_AS_THEY_ARE,
) -> Iterator[tuple[NDArray[np.int64], NDArray[Any]]]:
    """Yield numbers and records of the new chunks, up to BLOCK_CHUNKS at a time.

    Row j of the model becomes a copy of the old row rows[j]; with None all rows stay. SH coefficients that the old
    records do not have are zero.

    record: type of the new records. Fields that it does not have are left out.
    passed: function that is called after each yield with the number of the first old chunk that may still be read. The
        number is valid only if the sources in `rows` rise.
    """
    new = np.flatnonzero(to.kept == NEW)
    for begin in range(0, len(new), BLOCK_CHUNKS):
        numbers = new[begin : begin + BLOCK_CHUNKS]
        entries, places = _entries(rows, to.starts, numbers)
        sources, records = (entries & ~FRESH).astype(np.int64), np.zeros(len(numbers), record)
        for name in values.initial.keys() & set(record.names or ()):
            records[name] = values.initial[name]
        chunks = chunk_of(old.starts, sources)
        wanted = np.unique(chunks)
        for start in range(0, len(wanted), BLOCK_CHUNKS):
            some = wanted[start : start + BLOCK_CHUNKS]
            mine = np.flatnonzero((chunks >= some[0]) & (chunks <= some[-1]))
            of_mine, old_records = chunks[mine], old.read(some)
            at = CHUNK_ROWS * np.searchsorted(some, of_mine) + sources[mine] - old.starts[of_mine]
            _copy(old_records, at, records, places[mine], entries[mine] >= FRESH, values)
            del old_records
        yield numbers, records
        passed(int(chunks[-1]))


def _entries(
    rows: NDArray[np.uint32] | None, starts: NDArray[np.int64], numbers: NDArray[np.int64]
) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Return the row list's entries of new chunks `numbers`, and their positions in the records of these chunks.

    rows: the row list; None for all old rows. starts: first row of each new chunk, and the end of the last one.
    """
    entries, places = [], []
    for place, number in enumerate(numbers.tolist()):
        begin, end = int(starts[number]), int(starts[number + 1])
        entries.append(np.arange(begin, end, dtype=np.uint32) if rows is None else rows[begin:end])
        places.append(np.arange(CHUNK_ROWS * place, CHUNK_ROWS * place + end - begin))
    return np.concatenate(entries), np.concatenate(places)


def _copy(
    old: NDArray[Any],
    at: NDArray[np.int64],
    records: NDArray[Any],
    places: NDArray[np.int64],
    fresh: NDArray[np.bool_],
    values: NewValues,
) -> None:
    """Copy rows at positions `at` of old records to positions `places` of new ones.

    Positions count on from record to record: row r of record k is at CHUNK_ROWS k + r.
    """
    parts, wanted = list(_by_chunk(places)), set(records.dtype.names or ()) - values.anew
    for name in (name for name in old.dtype.names or () if name in wanted):
        rows = old[name].reshape(-1, *old[name].shape[2:]).take(at, axis=0)
        if (value := values.fresh.get(name.split("/")[0])) is not None:
            rows[fresh] = value
        target = records[name]
        if target.shape[2:] != rows.shape[1:]:  # more SH coefficients
            target = target[:, :, : rows.shape[1]]
        for number, theirs, ours in parts:
            target[number, theirs] = rows[ours]


def _by_chunk(places: NDArray[np.int64]) -> Iterator[tuple[int, Any, slice]]:
    """Split rising positions (k,) by record. Yields a record's number, the rows in it, and their slice of `places`."""
    chunks = places // CHUNK_ROWS
    ends = np.flatnonzero(np.diff(chunks, append=-1)) + 1
    begin = 0
    for end in ends.tolist():
        rows = places[begin:end] % CHUNK_ROWS
        whole = int(rows[-1]) - int(rows[0]) == end - begin - 1
        yield int(chunks[begin]), slice(int(rows[0]), int(rows[-1]) + 1) if whole else rows, slice(begin, end)
        begin = end

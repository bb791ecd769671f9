# SPDX-License-Identifier: Apache-2.0
"""Rows of a streamed model after density control: which rows are kept and copied, and the records of the new chunks.

New rows stand behind the rows that they are copied from. So only a few old records are read for each new record.
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
"""Kinds of rows after density control, in the order of a row list that is sorted by kind."""


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
        """Return the indices (m,) that sort the rows by kind: remaining rows, clones, first halves, second halves."""
        kinds = np.where(self.rows < FRESH, np.uint8(_KEPT), np.uint8(_CLONE))
        kinds[self.seconds - 1], kinds[self.seconds] = _FIRST_HALF, _SECOND_HALF
        return np.argsort(kinds, kind="stable").astype(np.uint32)

    def entries(self) -> NDArray[np.uint32]:
        """Return `rows`, sorted by kind: remaining rows, clones, first halves, second halves."""
        return self.rows[self.by_kind()]


def row_entries(rows: NDArray[np.uint32], fresh: NDArray[np.bool_] | None) -> NDArray[np.uint32]:
    """Return source rows (m,) with the bit FRESH set where `fresh` is True. fresh: (m,); None if no row is new."""
    return rows.astype(np.uint32) if fresh is None else np.where(fresh, rows | FRESH, rows).astype(np.uint32)


def in_source_order(parts: Iterable[NDArray[np.uint32]]) -> SourceList:
    """Concatenate row lists, and sort them by source row.

    parts: a list for each range of old rows, in the order of the ranges. Each is sorted as by `SourceList.by_kind`.
    """
    rows, seconds, count = [], [], 0
    for part in parts:
        entries = part[beside_parents(part & ~FRESH)]
        twice = entries[1:] == entries[:-1]  # only the halves of a split Gaussian have equal entries
        seconds.append((np.flatnonzero(twice) + (count + 1)).astype(np.uint32))
        rows.append(entries)
        count += len(entries)
    return SourceList(_joined(rows), _joined(seconds))


def _joined(parts: list[NDArray[np.uint32]]) -> NDArray[np.uint32]:
    """Concatenate `parts`, and empty it: each part is freed as soon as it is copied."""
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
    """Values that rows get instead of a copy of their source row, for some fields of a record, such as "first/means".

    fresh: the value in FRESH rows by a field's kind, which is the part of its name before "/", such as "first" for
        first moments. Fields of other kinds are copied.
    initial: the values, by field, of new fields and of the fields in `anew`; 0 if a field is not listed.
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
    read: function that returns the records of chunks, given their numbers.
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

    rows: for each row of the new model, the old row that it copies, with the bit FRESH set if it is new. None if each
        row is its own source.
    to: division of the new rows into chunks. Records are made only for chunks that are NEW in `to.kept`.
    record: type of the new records. It may lack fields of the old records. SH coefficients that it adds are zero.
    passed: function that is called after each yield with the number of the first old chunk that may still be read. The
        number is valid only if the sources in `rows` rise.
    values: values that rows get in place of copies.
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
    """Return the sources (m,) of all rows of the new chunks `numbers` (k,), and the position (m,) of each row.

    A position is CHUNK_ROWS i + j for row j of chunk numbers[i].

    rows: source of each row of the new model; None if each row is its own source.
    starts: first rows of the new chunks, as in `Division`.
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
    """Copy the rows at positions `at` (m,) of the records `old` to positions `places` (m,) of `records`.

    Row r of record k has the position CHUNK_ROWS k + r.

    fresh: (m,), True for new rows.
    values: values that new rows, or all rows, get in place of copies.
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
    """Split `places` (m,), the rising positions of rows, by record. Yields a record's index, its rows at these
    positions, and the slice of `places` for the record."""
    chunks = places // CHUNK_ROWS
    ends = np.flatnonzero(np.diff(chunks, append=-1)) + 1
    begin = 0
    for end in ends.tolist():
        rows = places[begin:end] % CHUNK_ROWS
        whole = int(rows[-1]) - int(rows[0]) == end - begin - 1
        yield int(chunks[begin]), slice(int(rows[0]), int(rows[-1]) + 1) if whole else rows, slice(begin, end)
        begin = end

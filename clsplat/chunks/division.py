# SPDX-License-Identifier: Apache-2.0
"""Division of a streamed model's rows into chunks, and new chunks where density control has changed rows.

The size of a chunk: CHUNK_ROWS in `layouts/columns.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.optimisation.density_rules import FRESH

NEW = -1
"""Value of `Division.kept` for a chunk if no old chunk had exactly its rows."""
_COUNTED_ROWS = 1 << 14
"""Number of entries of the row list that are counted at a time. It limits the memory for copies of them."""


def chunks_of(rows: int) -> int:
    """Return the number of chunks for `rows` rows, if all chunks but the last are full."""
    return -(-rows // CHUNK_ROWS)


def listed_chunks(chunks: int) -> int:
    """Return the padded length of a list of `chunks` chunks: at least 1, and at most a quarter more than `chunks`. Few
    different lengths occur, so that device arrays can be reused."""
    wanted = max(chunks, 1)
    unit = 1 << max(wanted.bit_length() - 3, 0)
    return -(-wanted // unit) * unit


def even_starts(count: int) -> NDArray[np.int64]:
    """Return the first row of each chunk of `count` rows, then `count`, if all chunks but the last are full."""
    return np.append(np.arange(0, count, CHUNK_ROWS), count)


def chunk_of(starts: NDArray[np.int64], rows: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
    """Return, for each of `rows` (n,), the number of its chunk. starts: first rows of the chunks, as in `Division`."""
    return np.searchsorted(starts, rows, side="right") - 1


@dataclass(frozen=True, eq=False)
class Division:
    """The chunks of a model after rows have moved.

    starts: (chunks + 1,) int64, the first row of each chunk, then the number of all rows.
    kept: (chunks,) int64, for each chunk the number that it had before, or NEW if no old chunk had exactly its rows.
    """

    starts: NDArray[np.int64]
    kept: NDArray[np.int64]


def divided(entries: NDArray[np.uint32], starts: NDArray[np.int64]) -> Division:
    """Divide rows into chunks after density control.

    An old chunk is kept if all its rows stay and no row was added. The rows of consecutive other chunks are divided
    into as few new chunks as possible, of equal lengths. A chunk directly before or behind these is divided with them,
    although it could be kept, if its rows fit into the new chunks too.

    entries: source row of each row after density control, in rising order, with the bit FRESH set if the row is new.
    starts: first rows of the old chunks, as in `Division`.
    """
    counts, changed = _changes(entries, starts)
    edges = np.flatnonzero(np.diff(changed, prepend=False, append=False))
    lengths: list[NDArray[np.int64]] = []
    kept: list[NDArray[np.int64]] = []
    done = 0
    for first, last in edges.reshape(-1, 2).tolist():
        rows = int(counts[first:last].sum())
        parts = chunks_of(rows)
        before = first > done and rows + counts[first - 1] <= parts * CHUNK_ROWS
        rows += int(before * counts[first - 1])
        behind = last < len(counts) and rows + counts[last] <= parts * CHUNK_ROWS
        rows += int(counts[last]) if behind else 0
        lengths += [counts[done : first - before], _equal(rows, parts)]
        kept += [np.arange(done, first - before), np.full(parts, NEW)]
        done = last + behind
    lengths.append(counts[done:])
    kept.append(np.arange(done, len(counts)))
    return Division(np.append(0, np.cumsum(np.concatenate(lengths))), np.concatenate(kept))


def _changes(entries: NDArray[np.uint32], starts: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return two arrays with an element for each old chunk: the number of rows that come from the chunk, and True if
    they differ from the chunk's old rows. entries, starts: as in `divided`."""
    lengths = np.diff(starts)
    counts, stay, before = np.zeros_like(lengths), np.zeros_like(lengths), -1
    for begin in range(0, len(entries), _COUNTED_ROWS):
        some = entries[begin : begin + _COUNTED_ROWS]
        sources = (some & ~FRESH).astype(np.int64)
        chunks = chunk_of(starts, sources)
        first, last = int(chunks[0]), int(chunks[-1]) + 1
        stays = (some < FRESH) & (np.diff(sources, prepend=before) > 0)
        counts[first:last] += np.bincount(chunks - first, minlength=last - first)
        stay[first:last] += np.bincount(chunks[stays] - first, minlength=last - first)
        before = int(sources[-1])
    return counts, (counts != lengths) | (stay != lengths)


def _equal(rows: int, parts: int) -> NDArray[np.int64]:
    """Divide `rows` rows into parts whose lengths differ by at most one. Returns the lengths (parts,)."""
    return np.diff(np.arange(parts + 1) * rows // max(parts, 1))

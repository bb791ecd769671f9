# SPDX-License-Identifier: Apache-2.0
"""How the rows of a store are divided into chunks, and divided anew where density control has changed them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.optimisation.density_rules import FRESH

NEW = -1
"""In place of the old chunk that a new one is."""
_COUNTED_ROWS = 1 << 14
"""Entries of a list that are looked at together."""


def chunks_of(rows: int) -> int:
    """Number of chunks of `rows` rows, if all but the last are full."""
    return -(-rows // CHUNK_ROWS)


def listed_chunks(chunks: int) -> int:
    """Length of a list of up to so many chunks: one of few, at most a quarter more than needed, or 1."""
    wanted = max(chunks, 1)
    unit = 1 << max(wanted.bit_length() - 3, 0)
    return -(-wanted // unit) * unit


def even_starts(count: int) -> NDArray[np.int64]:
    """The first row of each chunk of `count` rows, and their end, if all chunks but the last are full."""
    return np.append(np.arange(0, count, CHUNK_ROWS), count)


def chunk_of(starts: NDArray[np.int64], rows: NDArray[np.integer[Any]]) -> NDArray[np.int64]:
    """The chunk of each row."""
    return np.searchsorted(starts, rows, side="right") - 1


@dataclass(frozen=True, eq=False)
class Division:
    """Chunks after rows have moved.

    starts: (chunks + 1,) int64, the first row of each, and the number of rows.
    kept: (chunks,) int64, the old chunk that each is without any change, or NEW.
    """

    starts: NDArray[np.int64]
    kept: NDArray[np.int64]


def divided(entries: NDArray[np.uint32], starts: NDArray[np.int64]) -> Division:
    """Chunks for a list of rows in the order of their sources, which `starts` divides into chunks.

    Chunks whose rows all stay, without new ones, are kept. Others that follow each other are divided anew, into as few
    chunks as have room for their rows, of equal lengths. A kept chunk beside them is taken in if it needs no more.
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
    """By old chunk, the number of rows that come from it, and whether they differ from those that it has."""
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
    """Lengths of so many parts of `rows` rows, which differ by at most one."""
    return np.diff(np.arange(parts + 1) * rows // max(parts, 1))

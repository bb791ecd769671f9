# SPDX-License-Identifier: Apache-2.0
"""Which chunks are divided anew where rows have moved, and which stay as they are."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from clsplat.chunks import division
from clsplat.chunks.division import NEW, Division, chunk_of, divided, even_starts
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.optimisation.density_rules import FRESH

CHUNKS = 9
STARTS = even_starts(CHUNKS * CHUNK_ROWS - 24)


def listed(dropped: NDArray[np.integer] | None = None, cloned: NDArray[np.integer] | None = None) -> NDArray[np.uint32]:
    """All rows in order, without some, and with a copy behind some."""
    rows = np.arange(STARTS[-1], dtype=np.uint32)
    rows = rows[~np.isin(rows, dropped if dropped is not None else [])]
    fresh = (np.zeros(0) if cloned is None else cloned).astype(np.uint32)
    order = np.argsort(np.concatenate([rows, fresh]), kind="stable")
    return np.concatenate([rows, fresh | FRESH])[order]


def lengths_of(found: Division) -> list[int]:
    return np.diff(found.starts).tolist()


def rows_in(*chunks: int, every: int = 1) -> NDArray[np.int64]:
    return np.concatenate([np.arange(CHUNK_ROWS * chunk, CHUNK_ROWS * (chunk + 1), every) for chunk in chunks])


@pytest.mark.parametrize("counted", [7, 1 << 16])
def test_rows_that_stay(monkeypatch: pytest.MonkeyPatch, counted: int) -> None:
    monkeypatch.setattr(division, "_COUNTED_ROWS", counted)
    found = divided(listed(), STARTS)
    np.testing.assert_array_equal(found.starts, STARTS)
    assert found.kept.tolist() == list(range(CHUNKS))


def test_a_chunk_that_grows_is_split_into_equal_parts() -> None:
    found = divided(listed(cloned=np.array([3 * CHUNK_ROWS + 5, 3 * CHUNK_ROWS + 9])), STARTS)
    assert lengths_of(found) == [1024] * 3 + [513, 513] + [1024] * 4 + [1000]
    assert found.kept.tolist() == [0, 1, 2, NEW, NEW, 4, 5, 6, 7, 8]


def test_neighbours_that_change_are_divided_together() -> None:
    """A third more rows in each of three chunks make four full ones."""
    found = divided(listed(cloned=rows_in(3, 4, 5, every=4)), STARTS)
    assert lengths_of(found) == [1024] * 3 + [960] * 4 + [1024] * 2 + [1000]


def test_what_is_left_of_a_chunk_is_joined_with_its_neighbours() -> None:
    """Where they have room in a chunk together."""
    dropped = np.concatenate([rows_in(4)[:1000], rows_in(8)[:900]])
    found = divided(listed(dropped), STARTS)
    assert lengths_of(found) == [1024] * 4 + [24] + [1024] * 3 + [100], "beside full ones it stays alone"
    starts = found.starts
    rows = np.arange(starts[-1], dtype=np.uint32)
    again = divided(np.delete(rows, [starts[4] + 3, starts[5] + 1]), starts)
    assert lengths_of(again) == [1024] * 4 + [523, 523] + [1024] * 2 + [100]
    assert again.kept.tolist() == [0, 1, 2, 3, NEW, NEW, 6, 7, 8]
    short = np.array([0, 300, 500, 1100, 1200])
    joined = divided(np.delete(np.arange(1200, dtype=np.uint32), [301]), short)
    assert (lengths_of(joined), joined.kept.tolist()) == ([499, 600, 100], [NEW, 2, 3])
    both = divided(np.delete(np.arange(1200, dtype=np.uint32), [501]), short)
    assert (lengths_of(both), both.kept.tolist()) == ([300, 899], [0, NEW])


def test_chunks_without_rows_vanish() -> None:
    found = divided(listed(rows_in(0, 4, 8)), STARTS)
    assert lengths_of(found) == [1024] * 6
    assert found.kept.tolist() == [1, 2, 3, 5, 6, 7]


@pytest.mark.parametrize("rows", ["swapped for a copy", "copied as it is"])
def test_as_many_other_rows_are_a_change(rows: str) -> None:
    entries = listed()
    entries[2 * CHUNK_ROWS + 7] = entries[2 * CHUNK_ROWS + 6] | (FRESH if rows == "swapped for a copy" else 0)
    found = divided(entries, STARTS)
    np.testing.assert_array_equal(found.starts, STARTS)
    assert found.kept.tolist() == [0, 1, NEW, 3, 4, 5, 6, 7, 8]


@pytest.mark.parametrize("seed", range(6))
def test_any_changes(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    """Again and again: chunks are never too long, and a kept one has the rows that it had."""
    monkeypatch.setattr(division, "_COUNTED_ROWS", 777)
    rng, starts = np.random.default_rng(seed), STARTS
    for _ in range(12):
        rows = np.arange(starts[-1], dtype=np.uint32)
        concerned = np.isin(chunk_of(starts, rows), rng.permutation(len(starts) - 1)[: rng.integers(1, 5)])
        stays = ~concerned | (rng.random(len(rows)) < rng.choice([0.02, 0.5, 0.9, 1.0]))
        cloned = concerned & (rng.random(len(rows)) < rng.choice([0.0, 0.02, 0.4]))
        entries = np.concatenate([rows[stays], rows[cloned] | FRESH])
        entries = entries[np.argsort(entries & ~FRESH, kind="stable")]
        found, lengths = divided(entries, starts), np.diff(starts)
        assert found.starts[-1] == len(entries)
        assert (np.diff(found.starts) >= 1).all()
        assert np.diff(found.starts).max() <= CHUNK_ROWS
        changed = chunk_of(starts, rows[~stays | cloned])
        kept = found.kept[found.kept != NEW]
        assert not np.isin(kept, changed).any()
        assert (np.diff(kept) > 0).all()
        for place in np.flatnonzero(found.kept != NEW):
            old = found.kept[place]
            np.testing.assert_array_equal(
                entries[found.starts[place] : found.starts[place + 1]], starts[old] + np.arange(lengths[old])
            )
        starts = found.starts

# SPDX-License-Identifier: Apache-2.0
"""The memory plan of steps over the chunks in view: slots, the rows of a view, which may be more, and pairs."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from clsplat.chunks.division import listed_chunks
from clsplat.chunks.residency import CROSSING_SHARE
from clsplat.config.checks import parse_bytes
from clsplat.errors import CapacityError
from clsplat.layouts.columns import CHUNK_ROWS
from clsplat.rendering.memory_plan import PAIRS_IN_VIEW, Need, Plan, plan_by_chunk

NEED = Need(
    gaussians=70_000,
    model=708,
    widest=180,
    row=129,
    banded=40,
    pair=76,
    most_pairs=2**31 // 36,
    planes=5_000_000,
    scratch=300_000,
    statistics=12,
    held=1,
)
"""A step of 70,000 Gaussians of SH degree 3 at 320x240."""
CHUNKS = 69
"""Chunks of all of them."""
BY_ROW = 129 - 12 - 1 + 40
"""Bytes of a row in view."""


def planned(limit: int, in_view: int, need: Need = NEED) -> Plan:
    """The plan for views of up to `in_view` chunks."""
    return plan_by_chunk(replace(need, in_view=in_view * CHUNK_ROWS), limit, 2**31)


def taken(slots: int, in_view: int, pairs: int) -> int:
    """Bytes of a step with so many slots and pairs, whose view shows so many chunks."""
    record = 708 + 12
    fixed = 5_000_000 + 300_000 + 70_000 + CHUNK_ROWS * record
    return fixed + CHUNK_ROWS * (slots * (record + record // CROSSING_SHARE) + in_view * BY_ROW) + pairs * 76


@pytest.mark.parametrize("in_view", [0, 1, 7, 9, 10, 33, CHUNKS])
def test_pool_and_view_and_pairs_fit(in_view: int) -> None:
    """As many slots as fit with the rows of any view, which may be a list of all slots, longer than needed, and with a
    pair for each row: a tile may contain all."""
    found = set()
    for limit in range(26 << 20, 90 << 20, 1 << 20):
        made = planned(limit, in_view)
        slots, rows = made.rows // CHUNK_ROWS, max(in_view, listed_chunks(made.rows // CHUNK_ROWS))
        found.add(slots)
        assert made.rows == CHUNK_ROWS * slots
        assert taken(slots, rows, made.pairs) <= limit
        assert made.pairs >= max(PAIRS_IN_VIEW * made.rows, CHUNK_ROWS * in_view)
        more = slots + 1
        pairs = CHUNK_ROWS * max(PAIRS_IN_VIEW * more, in_view)
        assert slots == CHUNKS or taken(more, max(in_view, listed_chunks(more)), pairs) > limit
    assert len(found) > 20


def test_views_of_no_more_chunks_than_slots_take_none() -> None:
    slots = planned(40 << 20, 0).rows // CHUNK_ROWS
    assert 1 < slots < CHUNKS
    assert planned(40 << 20, slots).rows == CHUNK_ROWS * slots
    assert planned(40 << 20, 2 * slots).rows < CHUNK_ROWS * slots


def least_of(limit: int, in_view: int) -> int:
    """The least that the refusal of a limit names."""
    with pytest.raises(CapacityError) as refused:
        planned(limit, in_view)
    named = re.search(r"at least about ([\d.,]+ \w+) of device memory", str(refused.value))
    assert named is not None, refused.value
    least = parse_bytes(re.sub("[ ,]", "", named[1]))
    assert least is not None
    return least


@pytest.mark.parametrize("in_view", [0, 1, 2, 3, 40, CHUNKS])
def test_the_least_is_enough(in_view: int) -> None:
    least = least_of(1 << 20, in_view)
    made = planned(least, in_view)
    assert made.rows == CHUNK_ROWS
    assert made.pairs >= CHUNK_ROWS * max(PAIRS_IN_VIEW, in_view)
    exact = taken(1, max(in_view, 1), CHUNK_ROWS * max(PAIRS_IN_VIEW, in_view))
    assert exact <= least < exact + 2**20 // 10 + 1, "rounded up to what a message says"


def test_fewer_pairs_than_rows_in_view_if_no_more_fit() -> None:
    """One slot is better than none, as few views have a tile that contains all their rows."""
    enough = taken(1, CHUNKS, CHUNK_ROWS * PAIRS_IN_VIEW)
    made = planned(enough, CHUNKS)
    assert made.rows == CHUNK_ROWS
    assert made.pairs == CHUNK_ROWS * PAIRS_IN_VIEW < CHUNK_ROWS * CHUNKS
    assert least_of(enough - 1, CHUNKS) > enough


def test_a_pool_that_main_memory_limits_leaves_the_rest_to_pairs() -> None:
    need = replace(NEED, pool=3 * CHUNK_ROWS * NEED.record)
    few, many = planned(60 << 20, 0, need), planned(60 << 20, CHUNKS, need)
    assert few.rows == many.rows == 3 * CHUNK_ROWS
    assert few.pairs - many.pairs == pytest.approx((CHUNKS - 3) * CHUNK_ROWS * BY_ROW / 76, abs=1)

# SPDX-License-Identifier: Apache-2.0
"""Compute how often the loops over a Gaussian's tiles and over a tile's list run, from boxes and lengths of lists."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from clsplat.stages.append import LOCAL_PAIRS

SMALL_BOX = 16
"""Tiles of the largest box that is listed whole, without a test of its rows: SMALL_BOX in tile.h."""
OWN_BOX = 32
"""Tiles of the largest box that an item processes alone: OWN_BOX in list_counts.h."""
AHEAD = 4
"""Pairs that an item loads at once: AHEAD in append.cl."""
SIDE = 8
"""Items that share a row of tiles of a wide box: SIDE in list_counts.h."""


@dataclass(frozen=True)
class Boxes:
    """Bounding boxes of Gaussians, in tiles.

    The rows of a box of more than SMALL_BOX tiles are tested. A box of more than OWN_BOX tiles is wide. A wave has 32
    neighbouring Gaussians; its numbers are means over all waves.

    refined: fraction of waves with a Gaussian for which `refine` runs.
    wave_rows, wave_tested: largest number of rows, and of tested rows, of a box in a wave, without wide boxes.
    wave_tiles: rounds of a wave over tiles, without wide boxes: in each row, those of the box with the most tiles.
    own_pairs: number of a wave's pairs, without wide boxes.
    all_tested, all_pairs: largest number of tested rows, and of pairs, of a box in a wave, with wide boxes.
    sorted_rows, sorted_tested, sorted_tiles: as wave_rows, wave_tested and wave_tiles, but with wide boxes, and for
        waves of Gaussians that are neighbours in depth.
    wide: number of wide boxes of a group.
    wide_rows, wide_columns: mean numbers of rows and columns of a wide box.
    """

    refined: float = 0
    wave_rows: float = 1
    wave_tested: float = 0
    wave_tiles: float = 1
    own_pairs: float = 32
    all_tested: float = 0
    all_pairs: float = 1
    sorted_rows: float = 1
    sorted_tested: float = 0
    sorted_tiles: float = 1
    wide: float = 0
    wide_rows: float = 0
    wide_columns: float = 0

    def shared_rows(self, items: int) -> float:
        """Rounds over the rows of a group's wide boxes, whose tiles the group's items share. items: their number."""
        return self.wide * max(self.wide_rows * SIDE / items, 1)

    def rows_at_once(self, items: int) -> float:
        """Rows of a wide box that a group of this many items processes in a round."""
        return min(self.wide_rows, items / SIDE)

    @property
    def columns_at_once(self) -> float:
        """Tiles of a wide box's row that are processed in a round."""
        return min(self.wide_columns, SIDE)

    @property
    def shared_columns(self) -> float:
        """Rounds over the tiles of a wide box's row."""
        return max(self.wide_columns / SIDE, 1)


def boxes_of(frame: Mapping[str, Any], items: int) -> Boxes:
    """The `Boxes` of a frame, for groups of `items` items."""
    found = {each.name: frame[each.name] for each in fields(Boxes)}
    return Boxes(**{**found, "wide": found["wide"] * items})


@dataclass(frozen=True)
class Sorting:
    """Mean numbers for the sort of a list. Lists of over LOCAL_PAIRS are sorted in parts, and merged in further stages.

    stages: number of stages.
    parts: number of parts in all stages.
    blocks, steps: rounds over sizes of blocks of Batcher's network in local memory, and over its steps, two at a time.
        Both are sums over all parts.
    far_steps: steps through global memory.
    ordered: number of times that an item orders four pairs in local memory, by two steps.
    ordered_far: comparisons of an item in global memory.
    fetched: number of times that an item copies AHEAD pairs to local memory.
    stored: pairs that an item copies back.
    listed: number of times that an item writes AHEAD pairs of the sorted list.
    """

    stages: float = 0
    parts: float = 0
    blocks: float = 0
    steps: float = 0
    far_steps: float = 0
    ordered: float = 0
    ordered_far: float = 0
    fetched: float = 0
    stored: float = 0
    listed: float = 0


def sorting_of(lists: Iterable[tuple[float, float]], items: int) -> Sorting:
    """The mean over lists. lists: from `lists_of`. items: number of items of a group."""
    each = [(number, _sorting(length, items)) for number, length in lists]
    whole = sum(number for number, _ in each)
    return Sorting(*(sum(number * getattr(one, of.name) for number, one in each) / whole for of in fields(Sorting)))


def _sorting(length: float, items: int) -> Sorting:
    merges = math.ceil(math.log2(max(length / LOCAL_PAIRS, 1)))
    parts = [min(length - first, LOCAL_PAIRS) for first in range(0, math.ceil(length), LOCAL_PAIRS)]
    doublings = [math.ceil(math.log2(max(part, 1))) for part in parts]
    # An entry for each size of the blocks of Batcher's network in each part: the part's length, and log2 of half the
    # block's length.
    blocks = [(part, block) for part, number in zip(parts, doublings, strict=True) for block in range(number)]
    blocks += [(part, LOCAL_PAIRS.bit_length() - 2) for part in parts] * merges
    steps = [(part, max(1 << (block - 2 * turn) >> 1, 1)) for part, block in blocks for turn in range(block // 2 + 1)]
    filled = [*(1 << number for number in doublings), *([LOCAL_PAIRS] * len(parts) * merges)]
    far_steps = merges * (merges + 1) / 2
    return Sorting(
        stages=1 + merges,
        parts=(1 + merges) * len(parts),
        blocks=len(blocks),
        steps=len(steps),
        far_steps=far_steps,
        ordered=sum(math.ceil(_fours(part, apart) / items) for part, apart in steps),
        ordered_far=far_steps * math.ceil(length / 2 / items),
        fetched=sum(math.ceil(whole / items / AHEAD) for whole in filled),
        stored=(1 + merges) * sum(math.ceil(part / items) for part in parts) if merges else 0,
        listed=math.ceil(length / items / AHEAD),
    )


def _fours(length: float, apart: int) -> float:
    """Number of groups of four pairs, `apart` places from each other, whose first pair is in a list of this length."""
    whole = length // (4 * apart)
    return whole * apart + min(length - 4 * apart * whole, apart)


def lists_of(frame: Mapping[str, Any]) -> list[tuple[float, float]]:
    """A frame's lists by ranges of lengths: for each range the number of lists, and their mean length."""
    lists = zip(frame["list_tiles"], frame["list_pairs"], strict=True)
    return [(tiles, pairs / tiles) for tiles, pairs in lists if tiles]

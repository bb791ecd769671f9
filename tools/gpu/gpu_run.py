# SPDX-License-Identifier: Apache-2.0
"""Numbers of a frame and of a launch on which the rounds of a kernel's loops depend."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from gpu_lists import Boxes, Sorting

from clsplat.layouts.columns import PLAIN_SLOTS

PER_ITEM = 16
"""Keys per item in a tile of the radix sort: RUN in sort_radix.cl."""
BLOCKS = 8
"""Blocks of 4 x 8 pixels in a tile: BLOCK_COLUMNS * BLOCK_ROWS in blocks.h."""
WARPS = (1, 2, 4, 8)
"""Warps of a tile for which gpu_frames.json has counts."""
BATCH_BACK = 64
"""Pairs in a batch of blending's gradient: BATCH in blend_grad.cl."""
VISITS = (
    *("visits", "dense", "sparse_reached", "sparse_taken"),
    *("turns_back", "whole_back", "others_reached", "others_taken", "rounds_back"),
)
"""Counts per walked pair. Those of blending are over the pairs of the batches that it fetches:

- visits, dense: warps that walk a pair, and those for which it is dense (blocks.h).
- sparse_reached, sparse_taken: in the other warps, blocks that the pair reaches, and blocks with a pixel that takes it
  or is finished by it.

Those of the gradient's walk (strips.h) are over all warps:

- turns_back, whole_back: pairs of a warp's strips, and those that reach all blocks of the strip.
- others_reached, others_taken: for the other pairs, blocks that it visits, and blocks with a pixel that takes the pair.
- rounds_back: rounds.
"""


def together(warps: int) -> int:
    """Pairs of a round of the gradient's walk, if this many warps share a tile: TOGETHER in strips.h."""
    return 32 // PLAIN_SLOTS.floats if warps <= 2 else 2


@dataclass(frozen=True)
class Run:
    """Numbers on which the rounds of a loop depend. `gpu_frames.py` counts those of walked pairs.

    items: work-items per group.
    wave: items that run in step.
    subgroup: items that exchange values.
    addends, shown: pairs per visible Gaussian, and the fraction of Gaussians that are visible.
    listed: pairs per tile.
    reached, taken: blocks of a pair's tile that its ellipse reaches, and those with a pixel that takes the pair.
    visits, dense: fractions of the tile's warps that walk a pair, and for which it is dense.
    sparse_reached, sparse_taken: as reached and taken, only in warps that walk the pair and for which it is not dense.
    turns_back, whole_back, rounds_back: in the gradient's walk, a warp's pairs, those of them that reach a whole strip,
        and rounds.
    others_reached, others_taken: in the gradient's walk, blocks of the tile that it visits for the other pairs, and
        those with a pixel that takes the pair.
    coefficients: SH coefficients per channel.
    groups, elements: number of groups of the launch, and of elements that they process.
    digits: digits of a pass of the radix sort.
    lists: number of the frame's tiles.
    boxes: of the Gaussians.
    sorting: numbers for the sort of lists by append.
    """

    items: int
    wave: int = 32
    subgroup: int = 1
    addends: float = 12.5
    shown: float = 1
    listed: float = math.inf
    reached: float = BLOCKS
    taken: float = BLOCKS
    visits: float = 1
    dense: float = 1
    sparse_reached: float = 0
    sparse_taken: float = 0
    turns_back: float = 1
    whole_back: float = 0
    others_reached: float = 0
    others_taken: float = 0
    rounds_back: float = 1
    coefficients: int = 16
    groups: int = 1
    elements: int = 1
    digits: int = 256
    lists: int = 1
    boxes: Boxes = field(default_factory=Boxes)
    sorting: Sorting = field(default_factory=Sorting)

    @property
    def waves(self) -> int:
        """Number of waves per group."""
        return max(self.items // self.wave, 1)

    @property
    def batch(self) -> int:
        """Pairs in a batch of blending: BATCH in blocks.h."""
        return max(self.items, 64)

    @property
    def batches(self) -> float:
        """Batches per pair. A tile's last batch is half full on average."""
        return 1 / self.batch + 0.5 / self.listed

    @property
    def fetches(self) -> float:
        """Rounds per pair in which an item fetches a splat."""
        return self.batches * self.batch / self.items

    @property
    def batches_back(self) -> float:
        """Batches per pair in blending's gradient."""
        return 1 / BATCH_BACK + 0.5 / self.listed

    @property
    def strips(self) -> int:
        """Strips that an item walks one after the other: OWN_STRIPS in strips.h."""
        return max(64 // self.items, 1)

    @property
    def team_waves(self) -> int:
        """Waves that share a strip: TEAM_WARPS in strips.h."""
        return max(self.items // 64, 1)

    @property
    def of_item(self) -> float:
        """Elements per item."""
        return self.elements / (self.groups * self.items)

    @property
    def tiles(self) -> float:
        """Tiles of keys per group in the scatter of the sort."""
        return math.ceil(self.elements / (PER_ITEM * self.items)) / self.groups

    @property
    def sums_before(self) -> float:
        """Rounds in which a wave adds up the sums of the groups before its own."""
        return math.ceil(self.groups / 2 / self.items)

    def shared(self, count: float) -> float:
        """Average rounds per wave of a group whose items share `count` elements."""
        return math.ceil(count / self.wave) / self.waves

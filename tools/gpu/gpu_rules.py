# SPDX-License-Identifier: Apache-2.0
"""Rounds of each loop of a training step's kernels: for each pair in blending, for each item elsewhere.

A loop is known by the line of the kernel's text that opens it. Each loop has one rule here and each rule a loop, so
that a kernel that is rewritten gets rules of its own (`gpu_loops.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from clsplat.layouts.columns import LOSS_GROUP_COLUMNS, PLAIN_SLOTS

if TYPE_CHECKING:
    from gpu_assembly import Loop

PER_ITEM = 16
"""Keys of a tile of the radix sort for each item, RUN in sort_radix.cl."""
WINDOW, REACH = 11, 5
"""Taps of the loss's window, and how far it reaches."""
_UNEVEN = 2
"""Rounds of a wave, of which the longest item counts, over those of an item, where Gaussians of all sizes are side by
side: a guess."""


@dataclass(frozen=True)
class Run:
    """Numbers that the rounds of a loop depend on. items: of a group; wave: items that run in step; subgroup: items
    that exchange values; addends: pairs of a visible Gaussian; listed: pairs of a tile; coefficients: of SH. Of the
    launch: groups, elements that they share, and digits of a pass of the sort."""

    items: int
    wave: int = 32
    subgroup: int = 1
    addends: float = 12.5
    listed: float = math.inf
    coefficients: int = 16
    groups: int = 1
    elements: int = 1
    digits: int = 256

    @property
    def waves(self) -> int:
        """Of a group."""
        return max(self.items // self.wave, 1)

    @property
    def batch(self) -> int:
        """Pairs of a batch of blending, BATCH in blocks.h."""
        return max(self.items, 64)

    @property
    def batches(self) -> float:
        """Batches for a pair; a tile's last one is half full."""
        return 1 / self.batch + 0.5 / self.listed

    @property
    def fetches(self) -> float:
        """Rounds in which an item fetches a splat, for a pair."""
        return self.batches * self.batch / self.items

    @property
    def together(self) -> int:
        """Pairs whose sums are made together, TOGETHER in blend_grad.cl."""
        if self.subgroup > 1:
            return self.items // PLAIN_SLOTS.floats
        return 3 if self.items < 256 else 1

    @property
    def summing(self) -> float:
        """Share of the waves that add up rows of sums."""
        return self.shared(self.together * PLAIN_SLOTS.floats)

    @property
    def of_item(self) -> float:
        """Elements of an item."""
        return self.elements / (self.groups * self.items)

    @property
    def tiles(self) -> float:
        """Tiles of keys of a group in the scatter of the sort."""
        return math.ceil(self.elements / (PER_ITEM * self.items)) / self.groups

    @property
    def sums_before(self) -> float:
        """Rounds in which a wave adds up the sums of the groups before its own."""
        return math.ceil(self.groups / 2 / self.items)

    @property
    def loss_rows(self) -> int:
        """Rows of a block of the loss, ROWS in loss.cl."""
        return min(max(self.items // 16, 1), 16)

    def shared(self, count: float) -> float:
        """Rounds of a wave, on average over the group's, where its items share so many."""
        return math.ceil(count / self.wave) / self.waves


Rounds = Callable[[Run], float]


@dataclass(frozen=True)
class Rule:
    """A part of a line of a kernel's text, and how often the loop that it opens runs, in all: for a pair, or an item.

    ends: parts of other lines, in which some compiler jumps back to the loop's head.
    function: a part of the head of the function that the line is in, where others have such a line too.
    part: not a loop but a branch: the share of its loop's rounds in which a wave takes it; the line is inside.
    mark: instructions of a class that a round has, such as ("shared", 2): a loop with more is unrolled so many times.
    inner: rounds are those for each round of the loop around it, not in all.
    """

    text: str
    rounds: Rounds
    ends: tuple[str, ...] = ()
    function: str = ""
    part: bool = False
    mark: tuple[str, int] | None = None
    inner: bool = False

    def matches(self, number: int, lines: Sequence[str]) -> bool:
        """True if the line of this number, from 1 on, is such a line."""
        if not number or not any(text in lines[number - 1] for text in (self.text, *self.ends)):
            return False
        heads = (line for line in reversed(lines[: number - 1]) if line.startswith(_HEADS))
        return self.function in next(heads, "")

    def opens(self, loop: Loop, lines: Sequence[str]) -> bool:
        """True if the loop was made of such a line."""
        return any(self.matches(number, lines) for number in loop.sources)


_HEADS = ("static ", "GROUP __kernel", "__kernel", "RARE ")
"""Beginnings of the head of a function."""


EVERYWHERE: tuple[Rule, ...] = (
    Rule(
        "ROUNDS for (uint step = 1; step < ITEMS; step *= 2)",
        lambda run: math.log2(run.items),
        ends=("barrier(CLK_LOCAL_MEM_FENCE);",),
        function=" group_exclusive_scan(",
        mark=("shared", 3),
        inner=True,
    ),
)
"""Loops that any kernel may have, of functions that kernels share."""
_BEFORE_PAIRS = (
    Rule("for (int first = last; first < end; first += ITEMS)", lambda run: 0),  # pairs beyond
    Rule("RAISE_TO_GROUP_MAX(last)", lambda run: 0),  # once a tile
)
BY_PAIR: dict[str, tuple[Rule, ...]] = {
    "blend": (
        Rule("for (int batch = begin", lambda run: run.batches, ends=("if (busy[turn] == 0) break;",)),
        Rule("for (int j = ITEM; j < BATCH; j += ITEMS)", lambda run: run.fetches),
        Rule("for (int j = 0; j < count", lambda run: 1),
    ),
    "blend_grad": (
        *_BEFORE_PAIRS,
        Rule("for (int batch = last", lambda run: run.batches),
        Rule("for (int j = ITEM; j < BATCH; j += ITEMS)", lambda run: run.fetches),
        Rule("for (int first = 0; first < count; first += TOGETHER)", lambda run: 1 / run.together),
        Rule(
            "for (int j = 0; j < together; ++j)",
            lambda run: 1,
            ends=("rows[field * ROW + get_local_id(0)] = sums[field];",),
        ),
        Rule("return (four.x + four.y)", lambda run: run.summing, ends=("DOUBLED(",), part=True),
    ),
}
"""Kernels that a group runs for a tile: rounds for a pair in each of the group's waves."""
WALK: tuple[Rule, ...] = (
    *_BEFORE_PAIRS,
    Rule("for (int k = ITEM; k < TILE * TILE; k += ITEMS)", lambda run: 0),  # once a tile
    Rule("for (int turn = last", lambda run: 1 / run.items),
    Rule("for (int round = 0; round < ITEMS; ++round)", lambda run: 1),
    Rule("slot[field] = sums[field];", lambda run: 1 / run.waves, part=True),
    Rule("const Staged s = staged[ITEM];", lambda run: 1 / run.waves, part=True),
)
"""The same of `blend_grad` where an item has a Gaussian."""


def _of_item(run: Run) -> float:
    return run.of_item


def _bands(run: Run) -> float:
    return run.coefficients - 1


def _side(run: Run) -> float:
    return _UNEVEN * math.sqrt(run.addends)


def _loss(columns: int, rounds: int = 1) -> Rounds:
    return lambda run: rounds * run.shared(run.loss_rows * (LOSS_GROUP_COLUMNS + columns))


def _never(run: Run) -> float:  # noqa: ARG001  # one of the rounds
    return 0


def _group_sum(rounds: Rounds) -> Rule:
    return Rule("for (uint i = get_local_id(0); i < count; i += ITEMS) sum += values[i];", rounds, mark=("global", 1))


def _stepped(group: str, width: int) -> Rule:
    return Rule(f"STEP_GROUP({group}, {width}, ", lambda run: width, mark=("global", 6))


BY_ITEM: dict[str, tuple[Rule, ...]] = {
    "target": (),
    "project": (
        Rule("for (int ty = e->tile_y0; ty < e->tile_y1; ++ty)", _side, ends=("count += x1 - x0;",), mark=("fp32", 60)),
        Rule("for (int k = 1; k < used; ++k, rest += 3)", _bands, mark=("global", 3)),
    ),
    "visible_sums": (
        Rule("i < end; i += ITEMS) visible += shown[i] != 0;", _of_item, mark=("global", 1)),
        _group_sum(_of_item),
    ),
    "compact_visible": (
        _group_sum(lambda run: run.sums_before),
        Rule("for (uint first = begin; first < end; first += ITEMS)", _of_item),
        Rule("atomic_max(extremes, complement)", lambda run: run.wave),  # AMD's, over a wave's items
        Rule("atomic_max(extremes + 1, largest)", lambda run: run.wave),
    ),
    "order_counts": (),
    "duplicate": (
        Rule("for (int ty = y0; ty < y1; ++ty)", _side),
        Rule("for (int tx = x0; tx < x1; ++tx, ++pair, ++slot)", lambda run: _side(run) ** 2, mark=("global", 2)),
    ),
    "scan_sums": (_group_sum(_of_item),),
    "scan_chunks": (
        _group_sum(lambda run: run.sums_before),
        Rule("for (uint base = begin; base < end; base += ITEMS)", _of_item, ends=("running += all;",)),
    ),
    "radix_histogram": (
        Rule("digit += ITEMS) counters[digit] = 0;", lambda run: run.shared(run.digits), mark=("shared", 1)),
        Rule("i < end; i += ITEMS) COUNT(counters[DIGIT(keys[i])]);", _of_item, mark=("global", 1)),
        Rule(
            "for (uint digit = item; digit < digits; digit += ITEMS) {",
            lambda run: run.shared(run.digits),
            mark=("global", 1),
        ),
    ),
    "radix_offsets": (  # its elements are the groups of the other two
        Rule("for (uint digit = get_group_id(0) * rows; digit < end; ++digit)", lambda run: run.digits / run.groups),
        Rule(
            "for (uint first = 0; first < groups; first += ITEMS)",
            lambda run: run.digits / run.groups * math.ceil(run.elements / run.items),
        ),
    ),
    "radix_scatter": (
        Rule("for (uint first = 0; first < digits; first += ITEMS)", lambda run: math.ceil(run.digits / run.items)),
        Rule("for (uint tile_begin = begin; tile_begin < end; tile_begin += TILE)", lambda run: run.tiles),
        Rule("for (uint i = item; i < TILE; i += ITEMS)", lambda run: PER_ITEM * run.tiles, mark=("shared", 1)),
        Rule("digits >> bits > 1; bits += 4) sort_tile(", lambda run: run.tiles * math.ceil(math.log2(run.digits) / 4)),
        Rule("for (uint i = item; i < count; i += ITEMS) {", _of_item),
    ),
    "ranges": (),
    "loss_ssim": (
        Rule("FOR_VECTORS(block, margin, ROWS)", _loss(2 * REACH), function=" moments("),
        Rule("for (int tap = 0; tap < taps.x; ++tap) beyond", _never),  # at the picture's edges
        Rule("for (int tap = taps.y; tap < TAPS; ++tap) beyond", _never),
        Rule("for (int tap = taps.x; tap < taps.y;", _loss(2 * REACH, WINDOW), mark=("global", 2)),
        Rule("FOR_VECTORS(block, margin, LINES)", _loss(0), function=" derivatives("),
        Rule("for (int tap = 0; tap < TAPS; ++tap) {", _loss(0, WINDOW), mark=("shared", 5)),
    ),
    "loss_grad": (
        Rule("FOR_VECTORS(block, margin, ROWS)", _loss(2 * REACH)),
        Rule("for (int tap = taps.x; tap < taps.y;", _loss(2 * REACH, WINDOW), mark=("global", 5)),
        Rule("FOR_VECTORS(block, 0, LINES)", _loss(0)),
    ),
    "project_step": (
        Rule(
            "for (uint k = 0; k < addends; ++k, slot +=",
            lambda run: _UNEVEN * run.addends,
            mark=("global", PLAIN_SLOTS.floats),
        ),
        _stepped("means", 3),
        _stepped("quaternions", 4),
        _stepped("log_scales", 3),
        _stepped("opacity_logits", 1),
        _stepped("sh_dc", 3),
        Rule("for (uint k = me; k < sh_width * rows; k += items)", lambda run: 3 * _bands(run), mark=("global", 6)),
        Rule("first[i] = 0.0f;", _never, part=True),  # a step that is refused
        Rule("second[i] = again ? 0.0f", _never, part=True),
        Rule("atomic_inc(s.readback", _never, part=True),
    ),
    "density_statistics": (),
}
"""The other kernels of a training step: rounds for an item."""

NUMBERS = {
    "visible_sums": ("elements",),
    "compact_visible": ("elements",),
    "scan_sums": ("elements",),
    "scan_chunks": ("elements",),
    "radix_histogram": ("elements", "chunk", "base", "shift", "digits"),
    "radix_offsets": ("elements", "digits"),
    "radix_scatter": ("elements", "chunk", "base", "shift", "digits"),
}
"""The first scalars that kernels are launched with."""

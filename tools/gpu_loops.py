# SPDX-License-Identifier: Apache-2.0
"""Rounds of the loops of kernels: for each pair of a tile and a Gaussian in blending, for each item elsewhere.

A compiler's loops are recognised by the line of the kernel's text that they were made of. A loop that no rule knows is
an error in a kernel that is counted by the pair, so that a kernel that is rewritten gets rules of its own.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gpu_assembly import CLASSES, Loop
from gpu_compilers import Built

from clsplat.errors import ClsplatError


@dataclass(frozen=True)
class Run:
    """Numbers that the rounds of a loop depend on. items: of a group; wave: items that run in step; addends: pairs of a
    visible Gaussian; width: of the image; coefficients: of SH."""

    items: int
    wave: int = 32
    addends: float = 12.5
    width: int = 1600
    coefficients: int = 16

    @property
    def waves(self) -> int:
        """Of a group."""
        return max(self.items // self.wave, 1)

    @property
    def owned(self) -> float:
        """Pixels of an item."""
        return 256 / self.items

    @property
    def batches(self) -> float:
        """Batches of splats that are fetched together, for a pair."""
        return 1 / 64

    @property
    def fetches(self) -> float:
        """Rounds in which a wave fetches splats, for a pair: an item fetches one."""
        return max(1 / self.items, 1 / 64 / self.waves)

    @property
    def block_rows(self) -> int:
        """Rows of the blocks of a tile."""
        return 4 if self.items >= 32 else 8

    @property
    def together(self) -> int:
        """Pairs whose sums are made together."""
        return 3 if self.items < 256 else 2

    @property
    def tree(self) -> float:
        """Waves with work in a tree over the group, of all of them, on average over its steps."""
        steps = [self.items >> step for step in range(1, self.items.bit_length())]
        return sum(math.ceil(step / self.wave) for step in steps) / (len(steps) * self.waves)


Rounds = Callable[[Run], float]


@dataclass(frozen=True)
class Rule:
    """A part of a line of a kernel's text, and how often the loop that it opens runs, in all: for a pair, or an item.

    ends: parts of other lines, in which some compiler jumps back to the loop's head.
    part: not a loop but a branch: the share of its loop's rounds in which a wave takes it; the line is inside.
    mark: instructions of a class that a round has, such as ("shared", 2): a loop with more is unrolled so many times.
    """

    text: str
    rounds: Rounds
    ends: tuple[str, ...] = ()
    part: bool = False
    mark: tuple[str, int] | None = None

    def opens(self, loop: Loop, lines: Sequence[str]) -> bool:
        """True if the loop was made of such a line."""
        return any(text in lines[number - 1] for number in loop.sources if number for text in (self.text, *self.ends))


BY_PAIR: dict[str, tuple[Rule, ...]] = {
    "blend": (
        Rule("for (; i < end && GOES_ON(open); ++i)", lambda run: 1),
        Rule("FOR_CELLS(cell, IN_OPEN(reach, open))", lambda run: run.owned),
        Rule("second = reach_of(", lambda run: 0.5, part=True),
        Rule("RAY_TABLES", lambda run: 0),
        Rule("for (int batch = begin", lambda run: run.batches, ends=("if (busy[turn] == 0) break;",)),
        Rule("for (int j = ITEM; j < count; j += ITEMS)", lambda run: run.fetches),
        Rule("for (int row = 0; row < BLOCK_ROWS; ++row)", lambda run: run.fetches * run.block_rows),
        Rule("for (int j = 0; j < count", lambda run: 1, ends=("if (!GOES_ON(open)) break;",)),
        Rule("for (int k = 0; k < OWNED; ++k)", lambda run: 0),
    ),
    "blend_grad": (
        Rule("for (int i = last - 1; i >= begin; --i)", lambda run: 1),
        Rule("FOR_CELLS(cell, reach)", lambda run: run.owned),
        Rule("for (int step = ITEMS / 2; step > 0; step /= 2)", lambda run: math.log2(run.items)),
        Rule("scratch[field * ITEMS + item] += scratch", lambda run: run.tree, part=True),
        Rule("for (int i = last + (int)get_local_id(0); i < end; i += ITEMS)", lambda run: 0),
        Rule("RAISE_TO_GROUP_MAX(last)", lambda run: 0),
        Rule("for (int batch = last", lambda run: run.batches),
        Rule("for (int j = ITEM; j < count; j += ITEMS)", lambda run: run.fetches),
        Rule("for (int row = 0; row < BLOCK_ROWS; ++row)", lambda run: run.fetches * run.block_rows),
        Rule("for (int first = 0; first < count; first += TOGETHER)", lambda run: 1 / run.together),
        Rule("for (int j = 0; j < together; ++j)", lambda run: 1, ends=("column[field * ROW] = sums[field];",)),
        Rule("for (int row = ITEM; row < together * SLOT_STRIDE", lambda run: 1 / run.together / run.waves),
        Rule("for (int i = 1; i < ITEMS / 4; ++i)", lambda run: run.items / 4 / run.together, mark=("shared", 1)),
        Rule("for (int i = 1; i < ITEMS / 4; ++i)", lambda run: 1 / run.waves, part=True),
        Rule("return (sum.x + sum.y)", lambda run: 1 / run.waves, part=True),
        Rule("for (int k = ITEM; k < TILE * TILE; k += ITEMS)", lambda run: 0),
        Rule("for (int turn = last", lambda run: 1 / run.items),
        Rule("for (int round = 0; round < ITEMS; ++round)", lambda run: 1),
        Rule("slot[field] = sums[field];", lambda run: 1 / run.waves, part=True),
        Rule("const Staged s = staged[ITEM];", lambda run: 1 / run.waves, part=True),
        Rule("for (int k = 0; k < OWNED; ++k)", lambda run: 0),
    ),
}
"""Kernels that a group runs for a tile: rounds for a pair in each of the group's waves."""

_AN_ITEM = 16
"""Elements of an item in scans and sorts, see `clsplat.stages.scan`."""
_UNEVEN = 2
"""Rounds of a wave, of which the longest item counts, over those of an item, where Gaussians of all sizes are side by
side: a guess."""


def _elements(run: Run) -> float:  # noqa: ARG001  # one of the rounds
    return _AN_ITEM


def _bands(run: Run) -> float:
    return run.coefficients - 1


def _side(run: Run) -> float:
    return _UNEVEN * math.sqrt(run.addends)


BY_ITEM: dict[str, tuple[Rule, ...]] = {
    "project": (
        Rule("for (int ty = e->tile_y0; ty < e->tile_y1; ++ty)", _side),
        Rule("for (int k = 0; k < 3; ++k) {", lambda run: 0),  # needles alone
        Rule("for (int k = 1; k < used; ++k, rest += 3)", _bands, mark=("global", 3)),
    ),
    "scan_sums": (Rule("for (uint i = begin + get_local_id(0); i < end; i += ITEMS)", _elements, mark=("global", 1)),),
    "scan_top": (Rule("for (uint base = 0; base < groups; base += ITEMS)", _elements),),
    "scan_chunks": (Rule("for (uint base = begin; base < end; base += ITEMS)", _elements),),
    "compact_visible": (
        Rule("for (uint i = begin + get_local_id(0); i < end; i += ITEMS)", _elements),
        Rule("atomic_max(extremes, complement)", lambda run: run.wave),  # AMD's, over a wave's items
        Rule("atomic_max(extremes + 1, largest)", lambda run: run.wave),
    ),
    "radix_histogram": (
        Rule("i < digits * ITEMS; i += ITEMS) counters[i] = 0;", _elements, mark=("shared", 1)),
        Rule("for (uint i = begin; i < end; ++i) counters[DIGIT(keys[i])", _elements, mark=("global", 1)),
        Rule("for (uint digit = get_local_id(0); digit < digits; digit += ITEMS)", lambda run: 1 / run.waves),
        Rule("for (uint item = 0; item < ITEMS; ++item)", lambda run: run.items / run.waves, mark=("shared", 1)),
    ),
    "radix_scatter": (
        Rule("i < digits * ITEMS; i += ITEMS) counters[i] = 0;", _elements, mark=("shared", 1)),
        Rule("for (uint i = begin; i < end; ++i) counters[DIGIT(keys[i])", _elements, mark=("global", 1)),
        Rule("for (uint digit = get_local_id(0); digit < digits; digit += ITEMS)", lambda run: 1 / run.waves),
        Rule("for (uint item = 0; item < ITEMS; ++item) {", lambda run: run.items / run.waves, mark=("shared", 2)),
        Rule("for (uint i = begin; i < end; ++i) {", _elements),
    ),
    "duplicate": (
        Rule("for (int ty = y0; ty < y1; ++ty)", _side),
        Rule("for (int tx = x0; tx < x1; ++tx, ++pair, ++slot)", lambda run: _side(run) ** 2, mark=("global", 2)),
    ),
    "loss_vertical": (
        Rule("for (int x = x_first; x < stride; x += step)", lambda run: run.width / 64),
        Rule("for (int tap = tap0; tap < tap1; ++tap)", lambda run: 11 * run.width / 64, mark=("global", 2)),
    ),
    "loss_ssim": (
        Rule("for (int x = x_first; x < stride; x += step)", lambda run: run.width / 64),
        Rule("for (int tap = 0; tap < TAPS; ++tap)", lambda run: 11 * run.width / 64),
    ),
    "loss_vertical_grad": (
        Rule("for (int x = x_first; x < stride; x += step)", lambda run: run.width / 64),
        Rule("for (int tap = tap0; tap < tap1; ++tap)", lambda run: 11 * run.width / 64, mark=("global", 3)),
    ),
    "loss_grad": (Rule("for (int x = x_first; x < stride; x += step)", lambda run: run.width / 64),),
    "project_grad": (
        Rule("for (uint k = 0; k < addends; ++k, slot +=", lambda run: _UNEVEN * run.addends, mark=("global", 9)),
        Rule("for (int k = 0; k < 3; ++k) {", lambda run: 0),  # needles alone
        Rule("for (int k = 1; k < SH_USED(coefficients); ++k", _bands, mark=("global", 6)),
    ),
    "adam": (Rule("for (ulong k = i; k < min(i + LANES, n); ++k)", lambda run: 1),),
}
"""The other kernels of a training step: rounds for an item. Loops without a rule count as one round."""


class UnknownLoopError(ClsplatError):
    """A loop that no rule knows."""


@dataclass(frozen=True)
class Cost:
    """Instructions by class that a wave runs, on average. once: beside all loops; rounds: in them."""

    once: Counter[str]
    rounds: Counter[str]
    unknown: tuple[str, ...] = ()


def _unrolled(loop: Loop, rule: Rule, twins: Sequence[Loop]) -> float:
    """Rounds of the text in one of the loop: by the rule's mark, or beside a shorter loop of the same line, which does
    what is left over, by how often memory is used; infinite for that one."""
    uses = [each.counts["shared"] + each.counts["global"] for each in twins]
    if len(twins) > 1 and loop is not max(twins, key=lambda each: each.size):
        return math.inf
    if rule.mark:
        return max(loop.counts[rule.mark[0]] // rule.mark[1], 1)
    return max(uses) / min(uses) if min(uses) else 1


def cost_of(built: Built, lines: Sequence[str], rules: Sequence[Rule], run: Run, *, strict: bool) -> Cost:
    """Instructions of a wave of the kernel. lines: the kernel's text. Raises UnknownLoopError where strict."""
    rounds: Counter[str] = Counter()
    unknown: list[str] = []
    parts = [rule for rule in rules if rule.part]
    once = _share(built.whole, lines, [], run)

    def visit(outer: Loop) -> None:
        for loop in outer.inner:
            if loop.size <= 1 and not loop.inner:  # a jump to itself behind the end
                continue
            matching = [rule for rule in rules if not rule.part and rule.opens(loop, lines)]
            if len(matching) == 1:
                twins = [each for each in outer.inner if matching[0].opens(each, lines)]
                factor = matching[0].rounds(run) / _unrolled(loop, matching[0], twins)
            else:
                unknown.append(_title(loop, lines))
                factor = 1
            for kind, count in _share(loop, lines, parts, run).items():
                rounds[kind] += factor * count  # type: ignore[assignment]
            visit(loop)

    visit(built.whole)
    if unknown and strict:
        raise UnknownLoopError(
            f"{built.kernel} for {built.target} in groups of {run.items}: no rule of BY_PAIR in tools/gpu_loops.py, or "
            f"more than one, is for {'; '.join(unknown)}"
        )
    return Cost(once, rounds, tuple(unknown))


def _title(loop: Loop, lines: Sequence[str]) -> str:
    named = [f"`{lines[number - 1].strip()}`" for number in sorted(loop.sources) if number]
    return f"the loop of {' or '.join(named) or 'an unknown line'} ({loop.size} instructions)"


def _share(loop: Loop, lines: Sequence[str], parts: Sequence[Rule], run: Run) -> Counter[str]:
    """Instructions by class of a round, each as often as it runs."""
    counts: Counter[str] = Counter()
    for block in loop.blocks:
        inside = [
            rule for rule in parts if any(each.source and rule.text in lines[each.source - 1] for each in block.body)
        ]
        factor = min((rule.rounds(run) for rule in inside), default=1)
        for each in block.body:
            counts[each.kind] += factor  # type: ignore[assignment]
    return counts


def by_pair(built: Built, lines: Sequence[str], run: Run) -> Counter[str]:
    """Instructions by class, of all waves of a group, for a pair. Raises UnknownLoopError."""
    cost = cost_of(built, lines, BY_PAIR[built.kernel], run, strict=True)
    counts: Counter[str] = Counter()
    for kind in CLASSES:
        counts[kind] = cost.rounds[kind] * run.waves
    return counts


def loop_table(built: Built, lines: Sequence[str]) -> list[tuple[int, str, Counter[str]]]:
    """Depth, title and instructions of each loop."""
    return [
        (depth - 1, _title(loop, lines), loop.counts) for depth, loop in built.whole.walk() if depth and loop.size > 1
    ]

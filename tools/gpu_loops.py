# SPDX-License-Identifier: Apache-2.0
"""How often the loops of kernels run: for each pair of a tile and a Gaussian in blending, for each item elsewhere.

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
    visible Gaussian; list: pairs of a tile."""

    items: int
    wave: int = 32
    addends: float = 12.5
    list: float = 1050.0

    @property
    def waves(self) -> int:
        """Of a group."""
        return max(self.items // self.wave, 1)

    @property
    def owned(self) -> float:
        """Pixels of an item."""
        return 256 / self.items

    @property
    def tree(self) -> float:
        """Waves with work in a tree over the group, of all of them, on average over its steps."""
        steps = [self.items >> step for step in range(1, self.items.bit_length())]
        return sum(math.ceil(step / self.wave) for step in steps) / (len(steps) * self.waves)


Rounds = Callable[[Run], float]


@dataclass(frozen=True)
class Rule:
    """A part of a line of a kernel's text, and how often the loop that it opens runs, in all: for a pair, or an item.

    part: not a loop but a branch: the share of its loop's rounds in which a wave takes it; the line is inside.
    mark: instructions of a class that a round has, such as ("shared", 2): a loop with more is unrolled so many times.
    """

    text: str
    rounds: Rounds
    part: bool = False
    mark: tuple[str, int] | None = None


BY_PAIR: dict[str, tuple[Rule, ...]] = {
    "blend": (
        Rule("for (; i < end && GOES_ON(open); ++i)", lambda run: 1),
        Rule("FOR_CELLS(cell, IN_OPEN(reach, open))", lambda run: run.owned),
        Rule("second = reach_of(", lambda run: 0.5, part=True),
        Rule("for (int k = 0; k < OWNED; ++k)", lambda run: 0),
    ),
    "blend_grad": (
        Rule("for (int i = last - 1; i >= begin; --i)", lambda run: 1),
        Rule("FOR_CELLS(cell, reach)", lambda run: run.owned),
        Rule("for (int step = ITEMS / 2; step > 0; step /= 2)", lambda run: math.log2(run.items)),
        Rule("scratch[field * ITEMS + item] += scratch", lambda run: run.tree, part=True),
        Rule("for (int i = last + (int)get_local_id(0); i < end; i += ITEMS)", lambda run: 0),
        Rule("RAISE_TO_GROUP_MAX(last)", lambda run: 0),
        Rule("for (int k = 0; k < OWNED; ++k)", lambda run: 0),
    ),
}
"""Kernels that a group runs for a tile: rounds for a pair in each of the group's waves."""


class UnknownLoopError(ClsplatError):
    """A loop that no rule knows."""


@dataclass(frozen=True)
class Cost:
    """Instructions by class that a wave runs, on average. once: beside all loops; rounds: in them."""

    once: Counter[str]
    rounds: Counter[str]
    unknown: tuple[str, ...] = ()


def _unrolled(loop: Loop, rule: Rule, twins: Sequence[Loop]) -> float:
    """Rounds of the text in one of the loop: by the rule's mark, or beside a loop of the same line that is made for
    what is left over by how often memory is used; 0 for that one."""
    if rule.mark:
        return max(loop.counts[rule.mark[0]] / rule.mark[1], 1)
    uses = [each.counts["shared"] + each.counts["global"] for each in twins]
    own = loop.counts["shared"] + loop.counts["global"]
    if len(twins) == 1 or own == 0 or min(uses) == 0:
        return 1
    return math.inf if own < max(uses) else max(uses) / min(uses)


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
            matching = [rule for rule in rules if not rule.part and _made_of(loop, lines, rule.text)]
            if len(matching) == 1:
                twins = [each for each in outer.inner if _made_of(each, lines, matching[0].text)]
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


def _made_of(loop: Loop, lines: Sequence[str], text: str) -> bool:
    return any(text in lines[number - 1] for number in loop.sources if number)


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

# SPDX-License-Identifier: Apache-2.0
"""Count the instructions that a wave runs in a kernel, from its loops and how often each runs (`gpu_rules.py`).

A loop without a rule is an error, and so is a rule that no loop has on any target.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from gpu_assembly import CLASSES, Block, Instruction, Loop
from gpu_banks import passes
from gpu_chain import ENDLESS, NEAR, NOTHING, Chain, chain_of
from gpu_compilers import Built
from gpu_lines import lines_touched
from gpu_rules import BY_ITEM, BY_PAIR, EVERYWHERE, OUTSIDE, Rule
from gpu_rules_measured import MEASURED
from gpu_run import Run

from clsplat.errors import ClsplatError


class UnknownLoopError(ClsplatError):
    """A kernel or loop has no rule, or a rule has no loop."""


@dataclass(frozen=True)
class Cost:
    """Average numbers of instructions, by class, that a wave runs.

    once, rounds: instructions outside of loops, and in them.
    rules: the rules that apply to a loop or branch.
    first, then: the chain of a warp outside of loops, and in them.
    """

    once: Counter[str]
    rounds: Counter[str]
    rules: frozenset[Rule]
    first: Chain = NOTHING
    then: Chain = NOTHING


def rules_of(kernel: str, commit: str = "") -> tuple[Rule, ...]:
    """The rules of a kernel. commit: of older code; empty for the present code. Raises UnknownLoopError."""
    if kernel in (measured := MEASURED.get(commit, {})):
        return measured[kernel] + EVERYWHERE
    if kernel not in BY_PAIR and kernel not in BY_ITEM:
        raise UnknownLoopError(f"{kernel}: no kernel of BY_PAIR or BY_ITEM in tools/gpu/gpu_rules.py")
    return (BY_PAIR.get(kernel) or BY_ITEM[kernel]) + EVERYWHERE


def _same(one: Loop, other: Loop, lines: Sequence[str]) -> bool:
    """True if two loops of one rule are copies of one source loop. lines: the kernel's text.

    Copies share source lines, or none of their lines have the same text. Lines of the same text at different places
    belong to different loops.
    """
    texts = ({lines[number - 1] for number in each.sources if number} for each in (one, other))
    return bool(one.sources & other.sources) or not set.intersection(*texts)


def _unrolled(loop: Loop, rule: Rule, copies: Sequence[Loop]) -> float:
    """Number of rounds of the source loop in one round of a compiled loop; infinite for a remainder loop.

    It follows from the rule's mark, or else from the number of memory accesses relative to the remainder loop.
    copies: all compiled copies of the source loop. The remainder loop is a shorter one.
    """

    def uses(each: Loop) -> tuple[int, int]:
        return each.counts["shared"] + each.counts["global"], each.size

    longest, shortest = max(map(uses, copies)), min(map(uses, copies))
    if uses(loop)[0] < longest[0] or (not longest[0] and uses(loop) < longest):
        return math.inf
    if rule.mark:
        return max(loop.counts[rule.mark[0]] // rule.mark[1], 1)
    return longest[0] / shortest[0] if shortest[0] else 1


def cost_of(built: Built, lines: Sequence[str], rules: Sequence[Rule], run: Run) -> Cost:
    """Number of instructions that a wave of the kernel runs. lines: the kernel's text. Raises UnknownLoopError."""
    rounds: Counter[str] = Counter()
    unknown: list[str] = []
    parts = [rule for rule in rules if rule.part]
    used: set[Rule] = set()
    then = NOTHING

    def shared(loop: Loop, opened: str) -> list[tuple[Block, float]]:
        here = [rule for rule in parts if not rule.inside or rule.inside in opened]
        return list(_shares(loop, lines, here, run, used))

    def lines_of(active: float) -> Callable[[Instruction], float]:
        return lambda each: lines_touched(each, lines[each.source - 1] if each.source else "", run, active)

    def passes_of(each: Instruction) -> tuple[float, float]:
        return passes(each, lines[each.source - 1] if each.source else "", run.wave)

    def visit(outer: Loop, outer_rounds: float) -> None:
        nonlocal then
        for loop in outer.inner:
            matching = [rule for rule in rules if not rule.part and rule.opens(loop, lines)]
            if len(matching) != 1:
                unknown.append(_title(loop, lines))
                continue
            used.update(matching)
            copies = [each for each in outer.inner if matching[0].opens(each, lines) and _same(each, loop, lines)]
            times = outer_rounds if matching[0].inner else 1
            unrolled = 1 if matching[0].copies else _unrolled(loop, matching[0], copies)
            factor = times * matching[0].rounds(run) / unrolled
            blocks = shared(loop, matching[0].text)
            for kind, count in _counts(blocks).items():
                rounds[kind] += factor * count  # type: ignore[assignment]
            touched = lines_of(matching[0].active(run) if matching[0].active else run.wave)
            then += chain_of(blocks, touched, 2, NEAR if matching[0].near else ENDLESS, passes_of).times(factor)
            visit(loop, factor)

    visit(built.whole, 1)
    if unknown:
        raise UnknownLoopError(
            f"{built.kernel} for {built.target} in groups of {run.items}: no rule of tools/gpu/gpu_rules.py, or more "
            f"than one, is for {'; '.join(unknown)}"
        )
    whole = shared(built.whole, OUTSIDE)
    return Cost(
        _counts(whole), rounds, frozenset(used), chain_of(whole, lines_of(run.wave), 1, passes_of=passes_of), then
    )


def unused_rules(used: Mapping[str, Iterable[Rule]]) -> list[str]:
    """Descriptions of rules without a loop. used: for each kernel, the rules of its loops on all targets and shapes."""
    found = {kernel: set(rules) for kernel, rules in used.items()}
    somewhere = set().union(*found.values()).intersection(EVERYWHERE)
    return [
        f"{kernel}: has no loop for the rule `{rule.text}` in tools/gpu/gpu_rules.py"
        for kernel, rules in found.items()
        for rule in rules_of(kernel)
        if rule not in rules | somewhere
    ]


def _title(loop: Loop, lines: Sequence[str]) -> str:
    named = [f"`{lines[number - 1].strip()}`" for number in sorted(loop.sources) if number]
    return f"the loop of {' or '.join(named) or 'an unknown line'} ({loop.size} instructions)"


def _shares(
    loop: Loop, lines: Sequence[str], parts: Sequence[Rule], run: Run, used: set[Rule]
) -> Iterator[tuple[Block, float]]:
    """The blocks of a loop, each with the fraction of rounds that run it.

    Slow paths of divisions and square roots never run, as few operands need them.
    parts: rules of branches.
    used: gets the rules that apply.
    """
    sources = [{each.source for each in block.body} for block in loop.blocks]
    held = [[rule for rule in parts if rule.holds(each, lines)] for each in sources]
    heads = {
        rule: {block.number for block, rules in zip(loop.blocks, held, strict=True) if rule in rules}
        for rule in parts
        if rule.below
    }
    for block, here in zip(loop.blocks, held, strict=True):
        found = [rule for rule in parts if rule in here or heads.get(rule, set()) & block.above]
        used.update(found)
        yield block, 0 if block.calls else found[0].rounds(run) if found else 1


def _counts(blocks: Iterable[tuple[Block, float]]) -> Counter[str]:
    """Instructions by class in a round, weighted by how often each runs."""
    counts: Counter[str] = Counter()
    for block, share in blocks:
        for each in block.body:
            counts[each.kind] += share  # type: ignore[assignment]
    return counts


def by_pair(cost: Cost, run: Run) -> Counter[str]:
    """Instructions by class per pair, of all waves of a group."""
    counts: Counter[str] = Counter()
    for kind in CLASSES:
        counts[kind] = cost.rounds[kind] * run.waves
    return counts


def loop_table(built: Built, lines: Sequence[str]) -> list[tuple[int, str, Counter[str]]]:
    """Depth, title and instructions of each loop."""
    return [
        (depth - 1, _title(loop, lines), loop.counts) for depth, loop in built.whole.walk() if depth and loop.size > 1
    ]

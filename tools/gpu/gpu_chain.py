# SPDX-License-Identifier: Apache-2.0
"""Compute the time of a single warp from the scheduling bits in NVIDIA's code.

Each instruction says how many cycles pass before the next one. An instruction of varying time, such as a load or a
reciprocal, sets one of six scoreboards, and later instructions name the scoreboards for which they wait. So the
compiler's code shows which loads run at the same time, and how often a warp waits for one load after another.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache

from gpu_assembly import Block, Instruction

VARIABLE = (("LDS|LDL|LDC|ATOMS", 30), ("LD|ATOM", None), ("", 20))
"""Cycles until the result of an instruction of varying time is ready, by the first pattern that its name begins with.

None stands for an access to global memory.
"""
ENDLESS = 1 << 30
"""Cycles of an access to global memory while waits are counted: longer than everything else together."""
BARRIER = 30
"""Cycles of a barrier of a group: about the 16 ns of an H100 (docs/gpus/calibration.json)."""
NEAR = 150
"""Cycles of an access to lines that the unit has just read: 77 ns on an H100."""


@dataclass(frozen=True)
class Chain:
    """The sequence of a warp's waits.

    cycles: cycles of its own instructions.
    accesses: number of accesses to global memory that it waits for, one after the other.
    lines: number of cache lines of 128 bytes that its accesses touch, counted for each instruction.
    passes: passes of its accesses through the banks of local memory.
    """

    cycles: float = 0.0
    accesses: float = 0.0
    lines: float = 0.0
    passes: float = 0.0

    def __add__(self, other: Chain) -> Chain:
        return Chain(
            self.cycles + other.cycles,
            self.accesses + other.accesses,
            self.lines + other.lines,
            self.passes + other.passes,
        )

    def times(self, rounds: float) -> Chain:
        """This chain, repeated for this number of rounds."""
        return Chain(self.cycles * rounds, self.accesses * rounds, self.lines * rounds, self.passes * rounds)


NOTHING = Chain()


def chain_of(
    blocks: Iterable[tuple[Block, float]],
    lines_of: Callable[[Instruction], float],
    rounds: int = 2,
    access: int = ENDLESS,
    passes_of: Callable[[Instruction], tuple[float, float]] = lambda _: (0, 0),
) -> Chain:
    """The chain of one round of a loop: of the last one, if `rounds` rounds run.

    blocks: blocks of the loop, each with the fraction of the rounds that run it.
    lines_of: cache lines that an instruction touches.
    access: cycles of an access to global memory. With ENDLESS, waits are counted as `accesses` instead.
    passes_of: an instruction's passes through the banks of local memory, and how many of them are conflicts.
    """
    weighted = [(each, share, *passes_of(each)) for block, share in blocks if share for each in block.body]
    now, ready = 0, [0] * 8
    for _ in range(rounds - 1):
        for each, _, _, conflicts in weighted:
            now = _issued(each, now, ready, access, round(conflicts))
    cycles = accesses = lines = passes = 0.0
    for each, share, own_passes, conflicts in weighted:
        before = now
        now = _issued(each, now, ready, access, round(conflicts))
        waits = round((now - before) / ENDLESS)
        cycles += (now - before - waits * ENDLESS) * share
        accesses += waits * share
        lines += lines_of(each) * share
        passes += own_passes * share
    return Chain(cycles, accesses, lines, passes)


@cache
def _latency(name: str) -> int | None:
    """The cycles of VARIABLE for an instruction of this name; None for an access to global memory."""
    return next(cycles for pattern, cycles in VARIABLE if re.match(pattern, name))


def _issued(each: Instruction, now: int, ready: list[int], access: int, conflicts: int) -> int:
    """The cycle in which the next instruction may begin.

    now: the cycle in which this instruction may begin.
    ready: cycles in which the scoreboards are clear; changed in place.
    access: cycles of an access to global memory.
    conflicts: cycles by which conflicts of banks delay the instruction's result.
    """
    control = each.control
    result, operands, waits = control >> 5 & 7, control >> 8 & 7, control >> 11 & 63
    start = now
    for board in range(6) if waits else ():
        if waits >> board & 1:
            start = max(start, ready[board])
    cycles = _latency(each.name)
    ready[operands] = max(ready[operands], start + 20)
    ready[result] = max(ready[result], start + (access if cycles is None else cycles + conflicts))
    ready[7] = 0
    return start + (control & 15) + (BARRIER if each.name.startswith("BAR") else 0)

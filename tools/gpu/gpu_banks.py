# SPDX-License-Identifier: Apache-2.0
"""Count the passes that an access takes through the banks of local memory.

A unit has 32 banks, each of which delivers a word of four bytes per cycle. Words of one bank that a wave's items access
together pass one after another; items that read the same word share it.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable
from functools import cache

from gpu_assembly import Instruction

BANKS = 32
RUN, RUNS, ROW = 6, 9, 64
"""Samples of a run in the loss, runs in a row, and words in a row: RUN, RUNS and PARTS in loss_groups.h."""
SCATTERED = 3.53
"""Mean number of words in the fullest bank, if each of 32 items accesses a random word."""

Address = Callable[[int], int]
"""The first word that an item accesses, by its number in the wave."""


def _same(item: int) -> int:  # noqa: ARG001  # one of the addresses
    return 0


def _neighbours(item: int) -> int:
    return item


def _run_of_samples(item: int) -> int:
    return item // RUNS * ROW + item % RUNS * RUN


def _pair(item: int) -> int:
    return 2 * item


WORDS: tuple[tuple[str, Address | None], ...] = (
    (r"staged\[|Staged s = |OPEN_CELLS\(open\)|FROM_OWN\(s\.blocks\)|steps\[number\]|numbers\[block\]", _same),
    (r"marks\[\(begin|\*total = |counts\[strip\]|busy\[turn\]", _same),
    (r"near\[PLACE\(place\)\]\.x", _pair),
    (r"= in\[i|middle\[REACH|fma1\(e1, e[12], (fma1\(e2, e2, )?in\[i", _run_of_samples),
    (r"COUNT\(counters|\*counter |tile\[GAPPED\(\(first", None),
)
"""Words that items access, where a line of the kernel's text matches: None for scattered ones. Elsewhere neighbouring
items access neighbouring words."""
ONE_WORD = r"atomic_m(ax|in)\((lasts|extremes|&longest)|RAISE_TO_GROUP_MAX"
"""Lines whose atomics are all on one word, and pass one after another."""


@cache
def passes_of(words: int, address: Address, wave: int) -> int:
    """Number of passes of an access by which each of a wave's items reads or writes `words` words.

    As many items as fill the banks pass together, or all, if they access the same words.
    address: an item's first word.
    wave: number of items.
    """
    if len({address(item) for item in range(wave)}) == 1:
        return 1
    found = 0
    together = max(BANKS // words, 1)
    for begin in range(0, wave, together):
        banks: defaultdict[int, set[int]] = defaultdict(set)
        for item in range(begin, min(begin + together, wave)):
            for word in range(address(item), address(item) + words):
                banks[word % BANKS].add(word)
        found += max(map(len, banks.values()))
    return found


def passes(each: Instruction, text: str, wave: int) -> tuple[float, float]:
    """Passes of an instruction through the banks of local memory, and how many of them are conflicts.

    text: its line in the kernel's text.
    wave: number of items.
    """
    if each.kind != "shared" or re.match("LDL|STL|scratch_|buffer_", each.name):  # private memory is no local memory
        return 0, 0
    words = next((bits // 32 for bits in (128, 64) if re.search(rf"\.{bits}|_b{bits}", each.name)), 1)
    least = wave * words / BANKS
    if each.name.startswith("ATOMS.M") and re.search(ONE_WORD, text):
        return wave, wave - least
    address = next((address for line, address in WORDS if re.search(line, text)), _neighbours)
    if address is _neighbours:
        return least, 0
    found = SCATTERED * least if address is None else passes_of(words, address, wave)  # below `least` for shared words
    return found, max(found - least, 0)

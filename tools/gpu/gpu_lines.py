# SPDX-License-Identifier: Apache-2.0
"""Count the cache lines that an access to memory touches, from the line of the kernel's text with the access."""

from __future__ import annotations

import re
from collections.abc import Callable

from gpu_assembly import Instruction
from gpu_run import Run

WORD = r"STG\.E$|global_store_(dword|b32)$"
"""Names of stores of four bytes."""
APART: tuple[tuple[str, str, float | Callable[[Run], float]], ...] = (
    (r"APPEND\(", WORD, lambda run: 4 * run.addends),  # gaussian_from_slot, where a Gaussian's slots are neighbours
    (r"tile_keys\[pair\] = ty", "", lambda run: 4 * run.addends),
    (r"pair_ids\[pair\] = \(uint2\)\(slot, i\)", "", lambda run: 8 * run.addends),
    (r"\bf\[0\]", "", 4 * 45),
    (r"splat\[|rgb\[|fields\[k\]", "", 64),
    (r"\+= slot\[|\[place\]|\[from\]|pair_ids\[pair_from|slots\[i\]|\[order\[|tile_counts\[i\];", "", 128),
    (r"APPEND\(|atomic_inc\((lengths|counts|places)|gaussian_from_slot\[|max\(most", "", 128),
    (r"values\[(tile|k \+ i|first \+ i)\]", "", 128),
    (r"GATHER\(\w+, 3|FROM_CAMERA\(means|dc\[0\]", "", 12),
    (r"GATHER\(quaternions", "", 16),
)
"""Bytes between what neighbouring items access, where a line of the kernel's text and the instruction's name match; 128
for scattered ones."""


def lines_touched(each: Instruction, text: str, run: Run, active: float) -> float:
    """Cache lines of 128 bytes that an instruction's items touch.

    text: its line in the kernel's text.
    active: mean number of a wave's items that take part.
    """
    if each.kind != "global":
        return 0
    width = next((bits // 8 for bits in (128, 64) if f".{bits}" in each.name), 4)
    found = (apart for line, name, apart in APART if re.search(line, text) and re.search(name, each.name))
    apart = next(found, width)
    return min(run.wave * min(apart(run) if callable(apart) else apart, 128) / 128, active)

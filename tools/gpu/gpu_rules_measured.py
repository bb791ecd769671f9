# SPDX-License-Identifier: Apache-2.0
"""Rules of the kernels that docs/gpus/calibration.json measured, where they differ from the present ones.

`gpu_static.py --inputs` counts the measured kernels by these rules (`gpu_recount.py`).
"""

from __future__ import annotations

from gpu_rules import (
    ADAM,
    ADDENDS,
    BEFORE_PAIRS,
    OVER_TILES,
    REFINED,
    SHARED_COLUMNS,
    Rounds,
    Rule,
    abreast,
    bands,
    group_sum,
    never,
    own_active,
)
from gpu_run import BLOCKS, Run

from clsplat.layouts.columns import PLAIN_SLOTS

_WINDOW, _REACH = 11, 5
"""Taps of the loss's window, and their distance from its middle."""
_LOSS_COLUMNS = 32
"""Columns of a block of the loss: LOSS_GROUP_COLUMNS."""


def _together(run: Run) -> int:
    """Pairs whose sums are made together: TOGETHER in blend_grad.cl."""
    return 3 if run.items < 256 else 1


def _rows(columns: int, rounds: int = 1) -> Rounds:
    """Rounds over a block of the loss and this many columns of its neighbours, `rounds` for each of their elements."""
    return lambda run: rounds * run.shared(min(max(run.items // 16, 1), 16) * (_LOSS_COLUMNS + columns))


def _stepped(group: str, width: int) -> Rule:
    return Rule(f"STEP_GROUP({group}, {width}, ", lambda run: width, mark=("global", 6))


def _of_run(run: Run) -> float:
    """Elements per item in the larger of the two groups of `list_offsets`."""
    return max(run.elements, run.lists) / run.items


MEASURED: dict[str, dict[str, tuple[Rule, ...]]] = {
    "5ea10cd9": {
        "target": (),
        "compact_visible": (
            group_sum(lambda run: run.sums_before),
            Rule("for (uint first = begin; first < end; first += ITEMS)", lambda run: run.of_item),
        ),
        "blend": (
            Rule("for (int batch = begin", lambda run: run.batches, ends=("if (busy[turn] == 0) break;",)),
            Rule("for (int j = ITEM; j < BATCH; j += ITEMS)", lambda run: run.fetches),
            Rule("for (int j = 0; j < count", lambda run: 1),
            Rule("const intL goes_on = MASKL(after", lambda run: run.taken / BLOCKS, part=True),
            Rule("const floatL power = LOG2_ALPHA(splat, cell);", lambda run: run.reached / BLOCKS, part=True),
        ),
        "blend_grad": (
            *BEFORE_PAIRS,
            Rule("const floatL before = p->t[cell] * inverse;", lambda run: run.taken / BLOCKS, part=True),
            Rule(
                "TAKE_PAIR(FROM_OWN(s.blocks))",
                lambda run: run.reached / BLOCKS,
                ("return fma(a, b, c);",),
                part=True,
                alone=True,
            ),
            Rule("for (int batch = last", lambda run: run.batches),
            Rule("for (int j = ITEM; j < BATCH; j += ITEMS)", lambda run: run.fetches),
            Rule("for (int first = 0; first < count; first += TOGETHER)", lambda run: 1 / _together(run)),
            Rule(
                "for (int j = 0; j < together; ++j)",
                lambda run: 1,
                ends=("rows[field * ROW + get_local_id(0)] = sums[field];",),
            ),
            Rule(
                "return (four.x + four.y)",
                lambda run: run.shared(_together(run) * PLAIN_SLOTS.floats),
                ends=("DOUBLED(",),
                part=True,
            ),
        ),
        "loss_ssim": (
            Rule("FOR_VECTORS(block, margin, ROWS)", _rows(2 * _REACH), function=" moments("),
            Rule("for (int tap = 0; tap < taps.x; ++tap) beyond", never),  # only at the picture's edges
            Rule("for (int tap = taps.y; tap < TAPS; ++tap) beyond", never),
            Rule("for (int tap = taps.x; tap < taps.y;", _rows(2 * _REACH, _WINDOW), mark=("global", 2), near=True),
            Rule("FOR_VECTORS(block, margin, LINES)", _rows(0), function=" derivatives("),
            Rule("for (int tap = 0; tap < TAPS; ++tap) {", _rows(0, _WINDOW), mark=("shared", 5)),
        ),
        "loss_grad": (
            Rule("FOR_VECTORS(block, margin, ROWS)", _rows(2 * _REACH)),
            Rule("for (int tap = taps.x; tap < taps.y;", _rows(2 * _REACH, _WINDOW), mark=("global", 5), near=True),
            Rule("FOR_VECTORS(block, 0, LINES)", _rows(0)),
        ),
        "project_step": (
            REFINED,
            ADDENDS,
            _stepped("means", 3),
            _stepped("quaternions", 4),
            _stepped("log_scales", 3),
            _stepped("opacity_logits", 1),
            _stepped("sh_dc", 3),
            Rule("for (uint k = me; k < sh_width * rows; k += items)", lambda run: 3 * bands(run), mark=("global", 6)),
            Rule("first[i] = 0.0f;", never, part=True),  # only for a refused step
            Rule("second[i] = again ? 0.0f", never, part=True),
            Rule("atomic_inc(s.readback", never, part=True),
        ),
    },
    "37c3be07": {
        "count_tiles": (
            *OVER_TILES,
            Rule(
                "for (int tx = x0; tx < x1; ++tx) atomic_inc(",
                lambda run: run.boxes.wave_tiles,
                mark=("global", 1),
                active=own_active,
            ),
            Rule("for (int row = e.tile_y0 + (int)item / SIDE;", lambda run: run.boxes.shared_rows(run.items)),
            SHARED_COLUMNS,
        ),
        "list_offsets": (
            Rule("for (uint k = begin; k < end; ++k) {", _of_run, mark=("global", 1)),
            Rule("for (uint tile = begin; tile < end; ++tile) {", _of_run, mark=("shared", 1)),
            Rule("for (uint k = begin; k < end_of_tiles; ++k)", lambda run: run.lists / run.items, mark=("shared", 1)),
            Rule("atomic_max(&longest, most);", lambda run: run.wave),  # AMD's compiler loops over a wave's items
        ),
        "project_step": (
            REFINED,
            ADDENDS,
            Rule(
                "for (uint k = own; k < whole_floats;", lambda run: abreast(run, 3 * bands(run) / 4), mark=("global", 4)
            ),
            Rule("for (uint k = whole_floats + me;", never),  # only for the last row
            Rule("for (uint k = any ?", lambda run: 3 * bands(run), mark=("shared", 1)),
            Rule("for (int number = 0; number < ARRAYS; ++number)", lambda run: 6),
            ADAM,
            Rule("for (uint k = own; left != 0;", never),  # only for refused steps and the last row
            Rule("for (uint i = k; (left & 1)", never),
        ),
    },
}
"""Rules by commit and kernel."""

# SPDX-License-Identifier: Apache-2.0
"""Rules for how often each loop of a training step's kernels runs: per pair in blending, per item in other kernels.

A rule names the line of the kernel's text that opens its loop. Each loop must have one rule and each rule a loop, so
that a rewritten kernel needs new rules (`gpu_loops.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gpu_lists import AHEAD
from gpu_run import BATCH_BACK, BLOCKS, PER_ITEM, Run

from clsplat.device.launch import DEFAULT_GROUP_ITEMS
from clsplat.layouts.columns import LOSS_PARTS, PLAIN_SLOTS
from clsplat.stages.blend import PART_PAIRS

if TYPE_CHECKING:
    from gpu_assembly import Loop

Rounds = Callable[[Run], float]


@dataclass(frozen=True)
class Rule:
    """A part of a line of a kernel's text, and the total rounds of the loop that the line opens, per pair or per item.

    ends: parts of other lines, from which some compiler jumps back to the loop's head.
    function: a part of the head of the function with the line, if several functions have such a line.
    part: True for a branch that contains the line; rounds is then the fraction of the loop's rounds that take the
    branch. Of several such rules the first counts.
    alone: True for a branch that contains no other lines than this and `ends`.
    below: True if the fraction also holds for the blocks that run only after the branch.
    inside: for a branch in one loop alone, a part of the line that opens the loop; OUTSIDE for one in no loop.
    holding, lacking: a part of a line that the loop contains, or does not contain, if a compiler jumps from one line to
    the heads of two loops.
    mark: number of instructions of a class in a round, such as ("shared", 2). A loop with more of them is unrolled.
    inner: True if rounds are per round of the enclosing loop.
    copies: True if a compiler makes copies of the loop that run so often each, with no remainder loop among them.
    near: True if the loop reads what the group's items have just read.
    active: mean number of a wave's items that take part in a round, or that access different addresses; all if None.
    """

    text: str
    rounds: Rounds
    ends: tuple[str, ...] = ()
    function: str = ""
    part: bool = False
    alone: bool = False
    below: bool = False
    inside: str = ""
    holding: str = ""
    lacking: str = ""
    mark: tuple[str, int] | None = None
    inner: bool = False
    near: bool = False
    copies: bool = False
    active: Rounds | None = None

    def matches(self, number: int, lines: Sequence[str]) -> bool:
        """True if the rule matches the line with this number, counted from 1."""
        if not number or not any(text in lines[number - 1] for text in (self.text, *self.ends)):
            return False
        heads = (line for line in reversed(lines[: number - 1]) if line.startswith(_HEADS))
        return self.function in next(heads, "")

    def holds(self, sources: Collection[int], lines: Sequence[str]) -> bool:
        """True if the rule is for a branch with these source lines."""
        return (all if self.alone else any)(self.matches(number, lines) for number in sources)

    def opens(self, loop: Loop, lines: Sequence[str]) -> bool:
        """True if a source line of the loop's jumps matches the rule, and the loop has `holding` but not `lacking`."""
        if not any(self.matches(number, lines) for number in loop.sources):
            return False
        text = "".join(lines[each.source - 1] for block in loop.blocks for each in block.body if each.source)
        return self.holding in text and not (self.lacking and self.lacking in text)


OUTSIDE = "outside of loops"
"""Place of a branch that is in no loop."""
_HEADS = ("static ", "GROUP __kernel", "COUNTING_GROUP __kernel", "__kernel", "RARE ")
"""Words with which the head of a function begins."""


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
"""Rules of loops in functions that kernels share."""
BEFORE_PAIRS = (
    Rule("for (int first = last; first < end; first += ITEMS)", lambda run: 0),  # for pairs beyond the last
    Rule("RAISE_TO_GROUP_MAX(last)", lambda run: 0),  # once a tile
)


def _of_visit(text: str, share: Rounds) -> Rule:
    return Rule(text, lambda run: share(run) / run.visits, part=True)


def _of_others(run: Run, others: float, all_pairs: float) -> float:
    return (others if run.team_waves == 1 else all_pairs) / BLOCKS


def _of_turn(text: str, share: Rounds, inside: str = "") -> Rule:
    return Rule(text, lambda run: share(run) / run.turns_back * run.strips, part=True, inside=inside)


_TURNS, _JOINS = "for (int turn = first; turn < stop_at;", "for (int turn = first + TEAM_WARP;"


BY_PAIR: dict[str, tuple[Rule, ...]] = {
    "blend": (
        Rule(  # once a tile
            "for (int state = FIRST_STATE(begin) + ITEM; state < FIRST_STATE(end); state += ITEMS)",
            lambda run: 0,
            ends=("tile_of_state[state] = listed_tile;",),
        ),
        Rule("const int state = FIRST_STATE(begin) + (batch - begin)", lambda run: run.batch / PART_PAIRS, part=True),
        Rule("for (int batch = begin", lambda run: run.batches, ends=("if (live == 0) break;",)),
        Rule("for (int k = 1; k <= count; ++k)", lambda run: run.visits, mark=("shared", 4)),
        _of_visit("for (int k = 1; k <= count; ++k)", lambda run: run.visits),
        _of_visit("ALL_CELLS(cell) { BLEND(", lambda run: run.dense),
        _of_visit("FOR_CELLS(cell, reach) {", lambda run: run.visits - run.dense),
        _of_visit("p->t = goes_on ? after : -fabs(before);", lambda run: run.sparse_taken / BLOCKS),
        _of_visit("const floatL power = LOG2_ALPHA(", lambda run: run.sparse_reached / BLOCKS),
    ),
    "blend_grad": (
        *BEFORE_PAIRS,
        Rule("atomic_max(lasts", lambda run: 0),  # once a tile: AMD's compiler loops over a wave's items
        Rule(
            "for (int batch = last",
            lambda run: run.batches_back,
            ends=("BARRIER_LOCAL();",),
            holding="LIST_MARKED(",
        ),
        Rule(
            "for (int first = 0; first < most; first += TOGETHER)",
            lambda run: run.rounds_back / run.strips,
            ends=(_TURNS,),
            holding="BARRIER_LOCAL();",
            copies=True,
        ),
        Rule(
            _TURNS,
            lambda run: run.turns_back / run.strips,
            lacking="BARRIER_LOCAL();",
            copies=True,
        ),
        _of_turn("ADD_PIXEL(k * BLOCK_COLUMNS + c, 1)", lambda run: run.whole_back / run.strips),
        *(
            _of_turn(text, lambda run: _of_others(run, run.others_reached, run.reached))
            for text in ("l11 * dx);", "block_rows[LANE] = share.g;")
        ),
        _of_turn("const floatL t = x + 12582912.0f;", lambda run: _of_others(run, run.others_taken, run.taken)),
        _of_turn("sums[SLOT_G] += g;", lambda run: _of_others(run, run.others_reached, run.reached), inside=_JOINS),
        _of_turn(
            "FOR_STRIP(c) if (reach >> c & 1) ADD_PIXEL(",
            lambda run: (run.turns_back - run.whole_back) / run.strips,
        ),
        Rule(_JOINS, lambda run: run.turns_back / run.team_waves),
        Rule("return (four.x + four.y)", lambda run: 1 / run.team_waves, ends=("DOUBLED(",), part=True),
        Rule(
            "for (int j = ITEM / ABREAST; j < count;",
            lambda run: run.batches_back * BATCH_BACK / (run.items // PLAIN_SLOTS.floats),
        ),
    ),
}
"""Rules of kernels that run a group per tile: rounds per pair in each of the group's waves."""
WALK: tuple[Rule, ...] = (
    *BEFORE_PAIRS,
    Rule("for (int k = ITEM; k < TILE * TILE; k += ITEMS)", lambda run: 0),  # once a tile
    Rule("for (int turn = last", lambda run: 1 / run.items),
    Rule("for (int round = 0; round < ITEMS; ++round)", lambda run: 1),
    Rule("slot[field] = sums[field];", lambda run: 1 / run.waves, part=True),
    Rule("const Staged s = staged[ITEM];", lambda run: 1 / run.waves, part=True),
)
"""Rules of `blend_grad` if each item has a Gaussian."""


def _of_item(run: Run) -> float:
    return run.of_item


def bands(run: Run) -> float:
    return run.coefficients - 1


def _parts(run: Run) -> float:
    return LOSS_PARTS / run.items


def never(run: Run) -> float:  # noqa: ARG001  # one of the rounds
    return 0


def group_sum(rounds: Rounds) -> Rule:
    return Rule("for (uint i = get_local_id(0); i < count; i += ITEMS) sum += values[i];", rounds, mark=("global", 1))


def abreast(run: Run, width: float, ahead: int = 1) -> float:
    """Rounds per wave over a group's rows of this width, if an item takes `ahead` times ABREAST elements in a round."""
    waves = DEFAULT_GROUP_ITEMS // run.wave
    runs = math.ceil(DEFAULT_GROUP_ITEMS * width / ABREAST / run.wave)  # of elements side by side, in turn to each wave
    return sum(math.ceil(len(range(wave, runs, waves)) / ahead) for wave in range(waves)) / waves


def _adam(run: Run) -> float:
    return sum(abreast(run, width) for width in (3, 4, 3, 1, 3, 3 * bands(run)))


ABREAST, COPIED_AHEAD = 4, 6
"""Elements that an item steps at once: ABREAST in adam.h; and loads that start together in the copy of SH
coefficients."""
ADAM = Rule("for (uint k = own, bit = 1; k < count; k += stride, bit += bit)", _adam, mark=("global", 6))
"""Adam's loop in `project_step`."""

REFINED = Rule("const floatL size = AS_FLOATL(AS_INTL(length)", lambda run: run.boxes.refined, part=True, below=True)
"""`refine` in `project_gaussians`: a wave runs it where one of its items does."""


def _tested(inside: str, share: Rounds) -> Rule:
    """The rule of the branch of `tile_span` that tests a row of a large box.

    inside: opens the loop over rows.
    share: the fraction of its rounds in which one of a wave's items takes the branch.
    """
    return Rule("if (e->tangent >= d0 && e->tangent <= d1)", share, part=True, below=True, inside=inside)


def _unnamed(inside: str, share: Rounds) -> Rule:
    """The rule of `_tested` for blocks to which a compiler gives only the line of the first return of `tile_span`."""
    return Rule("if (e->box <= SMALL_BOX) return;", share, part=True, alone=True, inside=inside)


def _own_tested(run: Run) -> float:
    return run.boxes.wave_tested / run.boxes.wave_rows


def _sorted_tested(run: Run) -> float:
    return run.boxes.sorted_tested / run.boxes.sorted_rows


def own_active(run: Run) -> float:
    return run.boxes.own_pairs / run.boxes.wave_tiles


def of_addends(run: Run) -> float:
    """Mean number of a wave's items that have an addend left in a round."""
    return run.wave * run.shown * run.addends / run.boxes.all_pairs


ADDENDS = Rule(
    "for (uint k = 0; k < addends; ++k, slot +=",
    lambda run: run.boxes.all_pairs,
    mark=("global", PLAIN_SLOTS.floats),
    active=of_addends,
)
"""The sum of a Gaussian's slots in `project_step`."""


SHARED_COLUMNS = Rule(
    "for (int tx = x0 + (int)item % SIDE;",
    lambda run: run.boxes.shared_rows(run.items) * run.boxes.shared_columns,
    active=lambda run: run.boxes.rows_at_once(run.items) / run.waves * run.boxes.columns_at_once,
)
"""The loop over a row of a wide box, where each wave of a group has rows of its own."""
_COUNTED_ROWS = "for (int ty = e->tile_y0; ty < e->tile_y1; ++ty) {"
_ROWS = "for (int ty = e.tile_y0; ty < e.tile_y1; ++ty) {"
OVER_TILES = (
    Rule(_ROWS, lambda run: run.boxes.wave_rows),
    _tested(_ROWS, _own_tested),
    Rule("for (uint k = 0; k < wides; ++k) {", lambda run: run.boxes.wide, active=lambda run: 1),  # all read the same
)
"""Rules of kernels in which an item goes over a Gaussian's tiles, and a group over those of wide boxes."""


def _of_run(run: Run) -> float:
    """Rounds of an item, each over AHEAD elements, in the larger of the two groups of `list_offsets`, which scan counts
    of tiles and sums."""
    return _ahead(max(run.elements, run.lists), run)


def _ahead(number: float, run: Run) -> float:
    """Rounds in which a group's items go over this many elements, each over AHEAD in a round."""
    return math.ceil(math.ceil(number / run.items) / AHEAD)


def _over_list(function: str, rounds: Rounds, text: str = "k < count; k += ITEMS") -> Rule:
    return Rule(f"for (uint k = get_local_id(0); {text}", rounds, function=function)


BY_ITEM: dict[str, tuple[Rule, ...]] = {
    "project": (
        REFINED,
        Rule(
            "for (int ty = e->tile_y0; ty < e->tile_y1; ++ty)",
            lambda run: run.boxes.all_tested,
            function=" tile_count(",
            ends=("count += x1 - x0;",),
            mark=("fp32", 60),
        ),
        Rule("for (int k = 1; k < used; ++k, rest += 3)", bands, mark=("global", 3)),
        Rule(_COUNTED_ROWS, lambda run: run.boxes.wave_rows),
        _tested(_COUNTED_ROWS, _own_tested),
        Rule(
            "for (int tx = x0; tx < x1; ++tx) atomic_inc(",
            lambda run: run.boxes.wave_tiles,
            mark=("global", 1),
            active=own_active,
        ),
        Rule("k < group->wides; ++k) {", lambda run: run.boxes.wide, active=lambda run: 1),  # all read the same
        Rule("for (int row = wide.tile_y0 + (int)item / SIDE;", lambda run: run.boxes.shared_rows(run.items)),
        SHARED_COLUMNS,
    ),
    "visible_sums": (
        Rule("i < end; i += ITEMS) visible += shown[i] != 0;", _of_item, mark=("global", 1)),
        group_sum(_of_item),
    ),
    "compact_visible": (
        group_sum(lambda run: run.sums_before),
        Rule("for (uint first = begin; first < end; first += ITEMS)", _of_item),
        Rule("atomic_min(extremes, least)", lambda run: run.wave),  # AMD's compiler loops over a wave's items
        Rule("atomic_max(extremes + 1, largest)", lambda run: run.wave),
    ),
    "list_offsets": (  # its elements are the groups of project
        Rule("for (uint k = begin; k < end; k += AHEAD) {", _of_run),
        Rule("for (uint first = begin; first < end; first += AHEAD) {", _of_run),
        Rule(
            "for (uint k = begin; k < end_of_tiles; k += AHEAD) {", lambda run: math.ceil(run.lists / run.items / AHEAD)
        ),
        Rule("atomic_max(&longest, most);", lambda run: run.wave),  # AMD's compiler loops over a wave's items
    ),
    "append_pairs": (
        *OVER_TILES,
        _unnamed(_ROWS, _own_tested),
        Rule(
            "for (int tx = x0; tx < x1; ++tx, ++slot)",
            lambda run: run.boxes.wave_tiles,
            mark=("global", 3),
            active=own_active,
        ),
        Rule("for (int row = e.tile_y0; row < e.tile_y1; ++row)", lambda run: run.boxes.wide * run.boxes.wide_rows),
        Rule(  # a wave has rows of its own
            "for (int tx = x0 + (int)item % SIDE;",
            lambda run: run.boxes.wide * run.boxes.wide_rows / run.waves * run.boxes.shared_columns,
            active=lambda run: run.boxes.columns_at_once,
        ),
    ),
    "sort_lists": (
        Rule("for (uint stage = fit / 2;", lambda run: run.sorting.stages),
        Rule("for (uint step = stage; step >= fit; step /= 2)", lambda run: run.sorting.far_steps),
        _over_list(" order_step_far(", lambda run: run.sorting.ordered_far, "2 * k - (k & (step - 1)) + 1 < count;"),
        Rule(
            "for (uint first = 0; first < count; first += fit) {",
            lambda run: run.sorting.parts,
            ends=("BARRIER_LOCAL();",),
        ),
        _over_list(" fetch_pairs(", lambda run: run.sorting.fetched, "k < whole; k += AHEAD * ITEMS"),
        Rule("for (uint half_block = sorts", lambda run: run.sorting.blocks),
        Rule("for (uint step = half_block; step > 0; step /= 4) {", lambda run: run.sorting.steps),
        _over_list(" order_steps(", lambda run: run.sorting.ordered, "4 * k - 3 * (k & within) < count; k += ITEMS"),
        _over_list(" store_pairs(", lambda run: run.sorting.stored),
        _over_list(" sort_lists(", lambda run: run.sorting.listed, "k < count; k += AHEAD * ITEMS"),
    ),
    "order_counts": (),
    "duplicate": (
        Rule("for (int ty = y0; ty < y1; ++ty)", lambda run: run.boxes.sorted_rows),
        _tested("for (int ty = y0; ty < y1; ++ty)", _sorted_tested),
        _unnamed("for (int ty = y0; ty < y1; ++ty)", _sorted_tested),
        Rule(
            "for (int tx = x0; tx < x1; ++tx, ++pair, ++slot)",
            lambda run: run.boxes.sorted_tiles,
            mark=("global", 2),
            active=lambda run: run.wave * run.addends / run.boxes.sorted_tiles,
        ),
    ),
    "scan_sums": (group_sum(_of_item),),
    "scan_chunks": (
        group_sum(lambda run: run.sums_before),
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
    "radix_offsets": (  # its elements are the groups of radix_histogram
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
        Rule("for (uint i = item; i < count; i += ITEMS) {", _of_item, near=True),
    ),
    "ranges": (),
    "loss_ssim": (  # loops only if a group has fewer items than parts
        Rule("FOR_PARTS(part, PARTS) {", _parts, function=" moments("),
        Rule("FOR_PARTS(part, PARTS) {", _parts, function=" derivatives("),
    ),
    "loss_grad": (
        Rule("FOR_PARTS(part, PARTS) {", _parts, function=" adjoint_moments("),
        Rule("FOR_PARTS(part, PARTS) {", _parts, function=" differences("),
    ),
    "project_step": (
        REFINED,
        ADDENDS,
        Rule(
            "for (uint k = own; k < whole_floats;",
            lambda run: abreast(run, 3 * bands(run), COPIED_AHEAD),
            mark=("global", COPIED_AHEAD),
        ),
        Rule("for (uint k = whole_floats + me;", never),  # only for the last row
        Rule("for (uint k = any ?", lambda run: 3 * bands(run), mark=("shared", 1)),
        Rule("for (int number = 0; number < ARRAYS; ++number)", lambda run: 6),
        Rule("gradients[by_", lambda run: 1 / 6, part=True, inside="for (int number = 0;"),  # after sh_rest
        ADAM,
        Rule("for (uint k = own; left != 0;", never),  # only for refused steps and the last row
        Rule("for (uint i = k; (left & 1)", never),
    ),
    "density_statistics": (),
}
"""Rules of the other kernels of a training step: rounds per item."""

NUMBERS = {
    "list_offsets": ("tiles", "elements"),
    "visible_sums": ("elements",),
    "compact_visible": ("elements",),
    "scan_sums": ("elements",),
    "scan_chunks": ("elements",),
    "radix_histogram": ("elements", "chunk", "base", "shift", "digits"),
    "radix_offsets": ("elements", "digits"),
    "radix_scatter": ("elements", "chunk", "base", "shift", "digits"),
}
"""Names of the first scalar arguments of kernels."""

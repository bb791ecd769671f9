# SPDX-License-Identifier: Apache-2.0
"""The model of a GPU's step: each of its terms against a figure by hand, and the fit to what was measured."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import gpu_static
import numpy as np
import pytest
from calls import Capture, refuses
from gpu_assembly import Block, Instruction, Loop, parse_sass
from gpu_chain import ENDLESS, NEAR, Chain, chain_of
from gpu_compilers import Built, Source
from gpu_devices import GPUS, Gpu
from gpu_frames import as_measured, subject_of, summary, walk_of
from gpu_lines import lines_touched
from gpu_lists import Boxes
from gpu_loops import cost_of
from gpu_measured import CALIBRATION, WALLS, Measured, beyond, fit_constants, read, with_inputs
from gpu_model import (
    FITTED,
    LAUNCH,
    LINES,
    PASSES,
    Constants,
    Work,
    blocks_of,
    fit,
    longest_of,
    stages_of,
    wall,
    works_of,
)
from gpu_page import measured_table, now_table
from gpu_rules import BY_PAIR, Rule
from gpu_run import BLOCKS, VISITS, Run

from clsplat.device.source import kernel_root
from clsplat.errors import ClsplatError
from clsplat.layouts.columns import SPLAT, TILE

GPU = Gpu("some", "sm_90", units=2, issue=4, ghz=1.0, gb=1000)
CONSTANTS = Constants(efficiency=0.5, access=100, host=0.05, copy=0.5, groups=0.5)


def control(stall: int, result: int = 7, operands: int = 7, waits: Sequence[int] = ()) -> int:
    return stall | result << 5 | operands << 8 | sum(1 << board for board in waits) << 11


def code(*lines: tuple[str, int], source: int = 1) -> Block:
    kinds = {"LDG.E": "global", "STG.E": "global", "LDS": "shared"}
    return Block(body=[Instruction(name, kinds.get(name, "fp32"), source=source, control=bits) for name, bits in lines])


def none(_: Instruction) -> float:
    return 0


def test_scheduling_bits_of_sass() -> None:
    """Bits 41 on of the upper word, as nvdisasm -hex writes it."""
    text = """
.text.walk:
        /*0090*/                   LDG.E R0, desc[UR14][R4.64] ;       /* 0x0000000e04007981 */
                                                                       /* 0x000ee8000c1e1900 */
        /*00a0*/                   FADD R1, R0, R0 ;                   /* 0x0000000000017221 */
                                                                       /* 0x004fc80000000000 */
"""
    ((load, add),) = [block.body for block in parse_sass(text)["walk"].blocks]
    assert load.control & 0xF == 4
    assert load.control >> 5 & 7 == 3
    assert add.control >> 11 == 0b000100  # it waits for the third scoreboard
    assert add.kind == "fp32"


def test_loads_that_are_under_way_together_are_waited_for_once() -> None:
    together = code(("LDG.E", control(2, 0)), ("LDG.E", control(2, 1)), ("FADD", control(4, waits=(0, 1))))
    assert chain_of([(together, 1)], none) == Chain(2 + 4, 1)  # of the first load 2 cycles pass before the second
    in_turn = code(("LDG.E", control(2, 0)), ("LDG.E", control(2, 0, waits=(0,))), ("FADD", control(4, waits=(0,))))
    assert chain_of([(in_turn, 1)], none).accesses == 2


def test_a_load_of_the_next_round_does_not_wait_in_this_one() -> None:
    ahead = code(("FADD", control(5, waits=(0,))), ("LDG.E", control(3, 0)))
    assert chain_of([(ahead, 1)], none, rounds=1) == Chain(5 + 3, 0)
    assert chain_of([(ahead, 1)], none, rounds=2).accesses == 1


def test_what_takes_cycles() -> None:
    assert chain_of([(code(("LDS", control(1, 0)), ("FADD", control(4, waits=(0,)))), 1)], none) == Chain(30 + 4)
    assert chain_of([(code(("BAR.SYNC", control(6))), 1)], none) == Chain(6 + 30)
    assert chain_of([(code(("MUFU.RCP", control(1, 2)), ("FADD", control(4, waits=(2,)))), 1)], none) == Chain(20 + 4)
    load = code(("LDG.E", control(2, 0)), ("FADD", control(4, waits=(0,))))
    assert chain_of([(load, 1)], none, 2, NEAR) == Chain(NEAR + 4)
    body = code(("FADD", control(8)))
    assert chain_of([(body, 1), (body, 0.25), (body, 0)], none) == Chain(8 + 2)
    assert chain_of([(load, 0.5)], lambda each: 3 * (each.kind == "global")) == Chain(2, 0.5, 1.5)
    assert ENDLESS > 1e6, "longer than a kernel's own instructions"


@pytest.mark.parametrize(
    ("name", "text", "lines"),
    [
        ("LDG.E", "sum += values[i];", 1),
        ("LDG.E.128", "sum += values[i];", 4),
        ("LDG.E.64", "const uint2 ids = pair_ids[pair];", 2),
        ("STG.E.64", "pair_ids[pair] = (uint2)(slot, i);", 6),  # three pairs of 8 bytes a Gaussian
        ("STG.E", "tile_keys[pair] = ty * tiles_x + tx - first_tile;", 3),
        ("STG.E", "for (int tx = x0; tx < x1; ++tx, ++slot) APPEND(ty * tiles_x + tx, slot, i)", 3),
        ("STG.E.64", "for (int tx = x0; tx < x1; ++tx, ++slot) APPEND(ty * tiles_x + tx, slot, i)", 32),
        ("ATOMG.E.ADD", "for (int tx = x0; tx < x1; ++tx, ++slot) APPEND(ty * tiles_x + tx, slot, i)", 32),
        ("LDG.E", "e.mx = splat[SPLAT_PIXEL_X];", 16),
        ("LDG.E", "raw[0] = GATHER(quaternions, 4, 0);", 4),
        ("LDG.E", "return last ? (float4)(f[0], f[1], f[2], 0.0f)", 32),
        ("LDG.E", "keys_out[place] = keys[from];", 32),
        ("LDS", "keys_out[place] = keys[from];", 0),
    ],
)
def test_lines_that_a_warp_touches(name: str, text: str, lines: float) -> None:
    kind = "shared" if name == "LDS" else "global"
    assert lines_touched(Instruction(name, kind), text, Run(64, addends=3), 32) == lines
    assert lines_touched(Instruction(name, kind), text, Run(64, addends=3), 2.5) == min(lines, 2.5), (
        "of few items, each its own"
    )


def test_items_that_take_part_in_a_round() -> None:
    whole = Loop([], set(), [Loop([code(("LDG.E", control(2)), source=3)], {2})])
    built = Built("walk", "sm_90", 40, 0, 0, 0, whole)
    for active, lines in ((None, 32), (lambda run: run.waves + 1, 3)):
        rules = (Rule("walk", lambda run: 5, active=active),)
        assert cost_of(built, ["", "walk {", "keys[place]"], rules, Run(64)).then.lines == 5 * lines


def test_blocks_and_pixels_that_skip_a_pair() -> None:
    lines = ["kernel", "walk {", "if (block)", "power", "weight"]
    blocks = [code(("FADD", control(1)), source=2), code(("FADD", control(1)), source=4)]
    blocks.append(code(("FADD", control(1)), ("FADD", control(1)), source=5))
    mixed = Block(body=[*blocks[0].body, *blocks[1].body])
    rules = (
        Rule("walk", lambda run: 1),
        Rule("power", lambda run: run.reached / BLOCKS, part=True, alone=True),
        Rule("weight", lambda run: run.taken / BLOCKS, part=True),
    )
    built = Built("blend", "sm_90", 40, 0, 0, 0, Loop([], set(), [Loop([*blocks, mixed], {2})]))
    cost = cost_of(built, lines, rules, Run(64, reached=4, taken=2))
    assert cost.rounds["fp32"] == 1 + 4 / 8 + 2 * 2 / 8 + 2  # the mixed block has other lines, and counts in full
    assert cost.then == Chain(1 + 4 / 8 + 2 * 2 / 8 + 2)


def branched() -> Loop:
    """A kernel whose first block jumps past three others; the second of them may call a slow path."""
    lines = """
.text.walk:
        //## File "walk.cl", line 2
        /*0000*/                   FADD R1, R0, R0 ;                   /* 0x0000000000017221 */
        /*0010*/              @!P0 BRA `(.L_x_9) ;                     /* 0x0000000000017221 */
        //## File "walk.cl", line 3
        /*0020*/                   FMUL R1, R0, R0 ;                   /* 0x0000000000017221 */
        //## File "walk.cl", line 2
        /*0030*/               @P1 BRA `(.L_x_8) ;                     /* 0x0000000000017221 */
        /*0040*/                   MOV R3, R0 ;                        /* 0x0000000000017221 */
        /*0050*/                   CALL.REL.NOINC `($__internal_0_$__cuda_sm3x_div_rn_noftz_f32_slowpath) ;
.L_x_8:
        /*0060*/                   FADD R1, R0, R0 ;                   /* 0x0000000000017221 */
.L_x_9:
        /*0070*/                   FADD R1, R0, R0 ;                   /* 0x0000000000017221 */
        /*0080*/                   EXIT ;                              /* 0x0000000000017221 */
"""
    return parse_sass(lines)["walk"]


def test_slow_paths_of_divisions_never_run() -> None:
    built = Built("walk", "sm_90", 40, 0, 0, 0, branched())
    cost = cost_of(built, ["walk {", "a / b", "c"], (), Run(64))
    assert +cost.once == Counter(fp32=4, control=3), "without MOV and CALL, and with what follows them"


@pytest.mark.parametrize(
    ("inside", "below", "fp32"), [("", True, 2 + 2 / 4), ("", False, 3 + 1 / 4), ("for (", True, 4)]
)
def test_a_branch_and_what_is_only_run_after_it(inside: str, below: bool, fp32: float) -> None:
    built = Built("walk", "sm_90", 40, 0, 0, 0, branched())
    rule = Rule("c", lambda run: 1 / 4, part=True, below=below, inside=inside)
    assert cost_of(built, ["walk {", "a / b", "c"], (rule,), Run(64)).once["fp32"] == fp32


def test_a_tile_has_the_kernels_blocks() -> None:
    text = (kernel_root() / "shared/blocks.h").read_text()
    assert "#define BLOCK_W 4\n" in text
    assert "#define BLOCK_ITEMS (ITEMS < 32 ? ITEMS : 32)\n" in text
    assert TILE * TILE // 32 == BLOCKS


def test_the_terms_of_a_launch() -> None:
    """A device of two units at 1 GHz that starts 8 instructions a nanosecond; half of its figures are usable."""
    none = Work("blend", 0, resident=8)
    assert none.on(GPU, CONSTANTS).ms == LAUNCH
    issue = Work("blend", 0, instructions=8e6, resident=8).on(GPU, CONSTANTS)
    assert (issue.issue, issue.ms) == (2, 2)
    memory = Work("blend", 1e9, resident=8).on(GPU, CONSTANTS)
    assert (memory.memory, memory.ms) == (2, 2)
    assert Work("blend", 0, groups=1e6).on(GPU, CONSTANTS).ms == 2
    lines = Work("blend", 0, waves=4, resident=8, chain=Chain(lines=1e6)).on(GPU, CONSTANTS)
    assert lines.ms == pytest.approx(4 * 1e6 / LINES / 2 * 1e-6)
    local = Work("blend", 0, waves=4, resident=8, chain=Chain(passes=1e6)).on(GPU, CONSTANTS)
    assert local.ms == pytest.approx(4 * 1e6 / PASSES / 2 * 1e-6)
    both = Work("blend", 1e9, instructions=8e6, groups=1e6, resident=8).on(GPU, CONSTANTS)
    assert both.ms == 2 + 2, "bytes, and then the longest of the others"


def test_the_chains_of_a_launch() -> None:
    chain = Chain(1e6, 1e4)  # 1 ms, and 10,000 accesses of 100 ns
    assert Work("blend", 0, waves=16, resident=8, chain=chain).on(GPU, CONSTANTS).chain == 1 + 1
    assert Work("blend", 0, waves=160, resident=8, chain=chain).on(GPU, CONSTANTS).chain == 10 * 2
    longest = Work("blend", 0, waves=16, resident=8, chain=chain, longest=chain.times(5))
    assert longest.on(GPU, CONSTANTS).chain == 5 * 2


def test_the_wall_time_of_a_host_that_queues() -> None:
    short, long = Work("project", 0), Work("blend", 0, instructions=4e6)  # 0.003 and 1 ms; 0.05 to queue one
    assert wall([short, short], GPU, CONSTANTS) == pytest.approx(2 * 0.05 + LAUNCH)
    assert wall([long, short], GPU, CONSTANTS) == pytest.approx(0.05 + 1 + LAUNCH)
    assert wall([long, None, short], GPU, CONSTANTS) == pytest.approx(0.05 + 1 + 0.05 + LAUNCH)


WALKS = {name: [1.0, 0.5, 3.0, 4.0] for name in VISITS} | {f"longest_{name}": [0.5, 0.75, 0, 0] for name in VISITS}
"""Walks of tiles of 1, 2, 4 and 8 warps."""


def test_how_a_groups_warps_walk_a_pair() -> None:
    frame = {"reached": 3, "taken": 2, "longer_reached": 2, "longer_taken": 1, **WALKS}
    blocks = ("sparse_reached", "sparse_taken", "others_reached", "others_taken")
    shares = dict.fromkeys(set(VISITS).difference(blocks), 0.25) | dict.fromkeys(blocks, 0.5)
    assert blocks_of(frame, 64) == {"reached": 3, "taken": 2, **shares}
    shares = dict.fromkeys(set(VISITS).difference(blocks), 0.75) | dict.fromkeys(blocks, 1.5)
    assert longest_of(frame, 64) == {"reached": 4, "taken": 2, **shares}
    assert blocks_of(frame, 256)["visits"] == 4 / 8


def test_a_dense_pair_and_the_blocks_of_others() -> None:
    """A warp of two walks half of the pairs, of which half are dense; the others reach one of its four blocks."""
    texts = (
        "k = 1; k <= count; ++k)",
        "ALL_CELLS(cell) { BLEND(",
        "FOR_CELLS(cell, reach) {",
        "LOG2_ALPHA(",
        "p->t = ",
    )
    rules = [next(rule for rule in BY_PAIR["blend"] if rule.part and text in rule.text) for text in texts]
    loop = next(rule for rule in BY_PAIR["blend"] if not rule.part and texts[0] in rule.text)
    lines = ["kernel", *(rule.text for rule in rules)]
    blocks = [code(*[("FADD", control(1))] * 10**k, source=k + 2) for k in range(5)]
    blocks.append(code(("FMUL", control(1)), source=6))
    blocks[-1].body += blocks[1].body[:1]  # arithmetic of a dense pair has its own line and that of the walk's
    built = Built("blend", "sm_90", 40, 0, 0, 0, Loop([], set(), [Loop(blocks, {2})]))
    run = Run(64, visits=0.5, dense=0.25, sparse_reached=0.5, sparse_taken=0.25)
    cost = cost_of(built, lines, (loop, *rules), run)
    counted = 0.5 * 1 + 0.25 * 10 + 0.25 * 100 + 0.5 / 8 * 1000 + 0.25 / 8 * 10000 + 0.25 * 2
    assert cost.rounds.total() == pytest.approx(counted)


@pytest.mark.parametrize(("kernel", "options", "walked"), [
    ("blend", ("-DITEMS=64",), 9),
    ("blend", ("-DITEMS=64", "-DPART_PAIRS=4"), 9),
    ("blend_grad", ("-DITEMS=64",), 9),
    ("blend_grad", ("-DITEMS=64", "-DPART_PAIRS=4"), 4),
])  # fmt: skip
def test_the_work_of_a_launch(
    monkeypatch: pytest.MonkeyPatch, kernel: str, options: tuple[str, ...], walked: int
) -> None:
    """Ten groups of 64 items: five instructions, and eight a pair, of which half are skipped. Of the slowest tile's
    nine pairs no group of the gradient walks more than a part."""
    loop = Loop([code(("FADD", control(2)), source=2), code(*[("FMUL", control(4))] * 7, source=3)], {2})
    whole = Loop([code(*[("FADD", control(1))] * 5)], set(), [loop])
    source = Source("blend", options)
    rules = (Rule("walk", lambda run: 1), Rule("weight", lambda run: run.taken / BLOCKS, part=True))
    monkeypatch.setitem(BY_PAIR, kernel, rules)
    monkeypatch.setattr(Source, "lines", ["kernel", "walk", "weight"])
    frame = {"width": 160, "height": 16, "gaussians": 25, "visible": 20, "listed": 40, "walked": 30, "sh_degree": 3}
    frame |= {
        "reached": 8,
        "taken": 4,
        "slowest": 9,
        "longer_reached": 4,
        "longer_taken": 3,
        **WALKS,
        **asdict(Boxes()),
    }
    launch = {"kernel": kernel, "stem": "blend", "options": list(source.options), "stage": "blend", "shared": 0}
    launch |= {"size": [640], "local": [64], "scalars": [], "bytes": 5e6}
    built = {(source, kernel): Built(kernel, "sm_90", 64, 0, 0, 0, whole)}
    (work, read_back, filled) = works_of(
        [launch, {"kernel": "read", "stage": "x"}, {"kernel": "fill", "stage": "x", "bytes": 7}], built, frame
    )
    assert work is not None
    assert (work.groups, work.waves, work.resident) == (10, 20, 32)
    assert work.instructions == 20 * 5 + 30 * 2 * (1 + 7 / 2)
    assert work.chain == Chain(5 + 3 * (2 + 28 / 2))  # three pairs a tile
    assert work.longest == Chain(5 + walked * (2 + 28 * 3 / 4))
    assert read_back is None
    assert (work.kernel, filled) == (kernel, Work("x", 7, kernel="fill"))
    assert set(stages_of([work, read_back, filled], GPU, CONSTANTS)) == {"blend", "x"}


def test_a_fit_finds_the_constants() -> None:
    wanted = Constants(efficiency=0.7, access=300, host=0.03)

    def error(each: Constants) -> float:
        return sum(math.log(getattr(each, name) / getattr(wanted, name)) ** 2 for name in FITTED)

    assert fit(error, Constants()) == wanted


def rows(**changes: Any) -> list[dict[str, Any]]:
    scene = {"scene": "a scene", "frame": "made up, 1 M", "frame_ms": 1.0, "step_ms": 2.0, "parts_ms": {"blend": 0.5}}
    row = {"device": "NVIDIA H200", "gpu": "H200", "date": "today", "commit": "abc", "scenes": [scene]}
    return [{**row, **changes}]


def completed(**changes: Any) -> Any:
    return json.loads(with_inputs(rows(**changes), {("sm_90", "made up, 1 M"): STEP}))


STEP = [
    Work("blend", 1e9, 123456789, 20, 10, 8, Chain(1, 2, 3), Chain(4, 5, 6), "blend"),
    None,
    Work("loss", 7, kernel="loss_grad"),
    Work("target", 8, kernel="target"),
]


def test_a_row_keeps_the_inputs_of_the_code_that_was_measured() -> None:
    given = completed()
    kept = with_inputs(given, {("sm_90", "made up, 1 M"): []})
    assert json.loads(kept) == given, "inputs that are there already are of another code"
    assert sum(line.strip().startswith(('{"stage"', "null")) for line in kept.splitlines()) == len(STEP)
    now = {("H200", "made up, 1 M"): STEP[1:]}
    ((one,), _) = read(given, now)
    assert one.works == [replace(STEP[0], instructions=123457000.0), *STEP[1:]], "six digits"
    assert one.now == STEP[1:]


def test_what_was_measured() -> None:
    ((one,), unused) = read(completed(), {})
    assert unused == []
    assert one.ms == {"blend": 0.5, WALLS[0]: 1.0, WALLS[1]: 2.0}
    assert one.code == "abc of today"
    by_kernel = {"target": 0.1, "loss_grad": 0.2, "blend: fill": 0.3, "transfers: write": 9.0}
    scenes = [{**rows()[0]["scenes"][0], "parts_ms": {}, "kernels_ms": by_kernel}]
    ((one,), _) = read(completed(scenes=scenes), {})
    assert one.ms["loss"] == pytest.approx(0.3)
    assert one.ms["blend"] == 0.3


def test_what_is_not_used_is_told() -> None:
    assert read(completed(gpu="H300"), {}) == ([], ["NVIDIA H200: unknown device"])
    assert read(rows(), {}) == ([], ["NVIDIA H200, today: a scene has no inputs"])


def test_the_present_kernels_beside_those_that_were_measured() -> None:
    (gpu,) = [each for each in GPUS if each.name == "H200"]
    works = [[Work("blend", 0, instructions=gpu.issued * ms)] for ms in (0.5, 0.25)]
    one = Measured(gpu, "made up, 1 M", "abc of today", {"blend": 0.4}, works[0], works[1])
    constants = Constants(efficiency=1.0)
    assert "| blend | 0.500, 0.250, **0.50** |" in now_table([one, replace(one, now=())], constants)
    measured = measured_table([one], constants, [])
    assert "| blend | 0.400, 0.500, **1.25** |" in measured
    assert "Code: abc of today. Every row is used." in measured


def test_a_prediction_that_is_too_far_off_is_told() -> None:
    (gpu,) = [each for each in GPUS if each.name == "H200"]
    works = [Work("blend", 0, instructions=gpu.issued * 0.5)]
    constants = Constants(efficiency=1.0)
    assert beyond([Measured(gpu, "made up, 1 M", "", {"blend": 0.401}, works)], constants) == []
    (told,) = beyond([Measured(gpu, "made up, 1 M", "", {"blend": 0.399}, works)], constants)
    assert told == "made up, 1 M, H200, blend: 0.500 ms predicted, 0.399 measured, expected within 25%"
    assert beyond([Measured(gpu, "fox, step 7000", "", {"blend": 0.399}, works)], constants) == []
    assert len(beyond([Measured(gpu, "fox, step 7000", "", {"blend": 0.84}, works)], constants)) == 1


@pytest.mark.parametrize(("measured", "status"), [(0.45, 0), (0.3, 1)])
def test_ci_holds_the_predictions(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture, measured: float, status: int
) -> None:
    (gpu,) = [each for each in GPUS if each.name == "H200"]
    one = Measured(gpu, "made up, 1 M", "", {"blend": measured}, [Work("blend", 0, instructions=gpu.issued * 0.5)])
    for name, value in {
        "counted": ([], {}, ([one], Constants(efficiency=1.0), [], {})),
        "broken": [],
        "loss_faults": [],
        "missed_goals": [],
    }.items():
        monkeypatch.setattr(gpu_static, name, lambda *_, value=value: value)
    monkeypatch.setattr(gpu_static, "tables_of", lambda *_: {})
    monkeypatch.setattr(gpu_static, "compilers", lambda: "")
    assert gpu_static.check([], 1) == status
    assert ("blend: 0.500 ms predicted" in capsys.readouterr().out) is bool(status)


def test_constants_of_small_kernels_are_from_the_file() -> None:
    calibration = json.loads(CALIBRATION.read_text())
    (gpu,) = [each for each in GPUS if each.name == "H200"]
    busy = [Work("blend", 0, instructions=gpu.issued * 0.4)]
    constants = fit_constants(calibration, [Measured(gpu, "held out", "", {"blend": 0.8}, busy)])
    assert constants.efficiency == Constants().efficiency, "of a frame that is not fitted"
    assert fit_constants(calibration, [Measured(gpu, "made up, 1 M", "", {"blend": 0.8}, busy)]).efficiency == 0.5
    limits = next(row["limits"] for row in calibration if "limits" in row)
    assert constants.copy == pytest.approx(limits["copy float4 x1, 1024"] / 3350)
    assert constants.groups == pytest.approx(limits["groups G/s, 64"] / 1.98)


def splat(x: float, y: float, radius: float) -> list[float]:
    """A round Gaussian of opacity one: alpha falls under 1/255 at the radius in pixels."""
    narrow = math.sqrt(math.log2(255)) / radius
    given = {"PIXEL_X": x, "PIXEL_Y": y, "L11": narrow, "L22": narrow}
    return [given.get(name, 0.0) for name in SPLAT]


def test_the_walk_of_a_tile() -> None:
    """In the tile from (16, 32) on: a small Gaussian in the upper left block, and a wide one that one pixel takes,
    in the lower right block. The pixels of the others are finished by it."""
    splats = np.array([splat(18.2, 34, 1.5), splat(24, 40, 100), splat(24, 40, 100)], np.float32)
    stops = np.ones((TILE, TILE), np.int64)
    stops[-1, -1] = 2
    walk = [2, 1 + 1, 1 + 1, 1 + 2, 1 + 1, 1 + 1]
    # one warp: the third pair is not walked, but of the batch; the gradient visits each of two strips once
    visits = [1 + 1 + 1, 1 + 1, 1, 1, 2, 0, 2, 2, 2, 3, 2, 1, 1, 2, 0, 2, 2, 2]
    visits += [1 + 2 + 2, 2 + 2, 1, 1, 2, 0, 2, 2, 2, 3, 2, 1, 1, 1, 0, 1, 1, 1]
    visits += [1 + 4 + 4, 4 + 4, 1, 1, 4, 0, 4, 4, 4, 3, 2, 1, 1, 1, 0, 1, 1, 1]
    visits += [1 + 8 + 8, 1 + 8 + 8, 0, 0, 8, 0, 8, 8, 8, 3, 3, 0, 0, 1, 0, 1, 1, 1]
    found = walk_of(splats, stops, np.array((16, 32)))
    assert found == walk + visits
    told = summary(np.array([found, [0] * len(found)]))
    assert told == {
        "walked": 2,
        "reached": 1,
        "taken": 1,
        "halves": 1.5,
        "list_99": 1,
        "longest": 2,
        "slowest": 2,
        "longer_reached": 1,
        "longer_taken": 1,
        "visits": [1.5, 2.5, 4.5, 8.5],
        "dense": [1, 2, 4, 8.5],
        "turns_back": [1, 1, 2, 4],
        "whole_back": [0] * 4,
        "others_reached": [1, 1, 2, 4],
        "others_taken": [1, 1, 2, 4],
        "rounds_back": [1, 1, 2, 4],
        "sparse_reached": [0.5, 0.5, 0.5, 0],
        "sparse_taken": [0.5, 0.5, 0.5, 0],
        "longest_visits": [1.5] * 4,
        "longest_dense": [1, 1, 1, 1.5],
        "longest_turns_back": [1, 0.5, 0.5, 0.5],
        "longest_whole_back": [0] * 4,
        "longest_others_reached": [1, 0.5, 0.5, 0.5],
        "longest_others_taken": [1, 0.5, 0.5, 0.5],
        "longest_rounds_back": [1, 0.5, 0.5, 0.5],
        "longest_sparse_reached": [0.5, 0.5, 0.5, 0],
        "longest_sparse_taken": [0.5, 0.5, 0.5, 0],
    }


def test_a_frame_that_was_measured_elsewhere() -> None:
    row = {"name": "fox", "gaussians": 100, "visible": 80, "listed": 200, "walked": 190, "reached": 3.0}
    row |= {
        "list_99": 20,
        "longest": 30,
        "slowest": 25,
        "longest_listed": 32,
        "list_tiles": [0, 7],
        "list_pairs": [0, 14],
    }
    scene = {"frame": "fox", "gaussians": 150, "visible": 110, "pairs": {"listed": 300}}
    lists = {"walked": 285, "list_99": 30, "longest": 45, "slowest": 38, "counted": 100}
    lists |= {"longest_listed": 48, "list_pairs": [0, 21]}
    assert as_measured(row, [{"scenes": [{"scene": "another"}, scene]}]) == {
        **row,
        **lists,
        "gaussians": 150,
        "visible": 110,
        "listed": 300,
    }
    assert as_measured(row, [{"scenes": []}]) == row


def test_the_synthetic_scene_is_the_benchs() -> None:
    subject = subject_of("synthetic:10:64x48")
    assert (len(subject.gaussians), subject.camera.width, subject.camera.height) == (10, 64, 48)
    refuses("synthetic:10", subject_of, "synthetic:10", error=ClsplatError)

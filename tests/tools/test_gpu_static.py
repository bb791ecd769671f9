# SPDX-License-Identifier: Apache-2.0
"""Counting for GPUs: what is read of assembly and of compilers' words, and what is said where one is missing."""

from __future__ import annotations

import json
import re
import subprocess
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gpu_compilers
import gpu_intel
import gpu_page
import gpu_rules
import gpu_run
import gpu_static
import pytest
from calls import Capture, refuses
from gpu_assembly import Block, Instruction, Loop, gcn_kind, parse_gcn, parse_sass, sass_kind
from gpu_compilers import Built, NoCompilerError, Source, ask_package, read_amd, read_nvidia
from gpu_devices import occupancy, waves_at_a_time
from gpu_intel import read_intel
from gpu_loops import UnknownLoopError, cost_of, rules_of, unused_rules
from gpu_model import Stage
from gpu_rules import BY_ITEM, BY_PAIR, EVERYWHERE, WALK, Rule
from gpu_run import Run
from gpu_static import (
    FRAMES,
    MOST_A_PAIR,
    MOST_A_SAMPLE,
    MOST_BY_GAUSSIAN,
    NO_STACK,
    SH_READ,
    Row,
    broken,
    loss_faults,
    sources_of,
)

from clsplat.device.source import kernel_root, kernel_source
from clsplat.errors import ClsplatError
from clsplat.layouts.columns import LOSS_GROUP_COLUMNS, LOSS_GROUP_ROWS, LOSS_PARTS, PLAIN_SLOTS

SASS = """
.text.walk:
\t//## File "walk.cl", line 1
        /*0000*/                   S2R R2, SR_CTAID.X ;
        /*0010*/               @P0 EXIT ;
.L_x_3:
\t//## File "walk.cl", line 2
        /*0020*/                   LDG.E R0, [R4.64] ;
        /*0030*/                   BSSY B0, `(.L_x_1) ;
.L_x_0:
\t//## File "walk.cl", line 3
        /*0040*/                   LDS R1, [R3] ;
        /*0050*/                   FFMA R5, R1, R1, R5 ;
        /*0060*/               @P1 CALL.REL.NOINC `(.L_x_2) ;
        /*0070*/                   BRA `(.L_x_0) ;
.L_x_2:
\t//## File "walk.cl", line 2
        /*0080*/                   BSYNC B0 ;
.L_x_1:
        /*0090*/                   MUFU.RCP R8, R8 ;
        /*00a0*/                   CALL.REL.NOINC `($__internal_0_$__cuda_sm20_rcp_rn_f32_slowpath) ;
\t//## File "walk.cl", line 4
        /*00b0*/              @!P2 BRA P3, `(.L_x_3) ;
        /*00c0*/                   EXIT ;
.L_x_4:
        /*00d0*/                   BRA `(.L_x_4);
        /*00e0*/                   NOP;
"""
"""A loop in a loop, whose way out is a CALL to a label, which ptxas writes for a far jump of some items."""

LINES = ["kernel", "for (outer)", "for (inner)", "while (outer);"]

GCN = """
\t.file\t1 "." "walk.cl"
walk:
\t.loc\t1 1 0
\ts_load_dwordx2 s[0:1], s[4:5], 0x0
.LBB0_1:                                ; %loop
\t.loc\t1 2 3 is_stmt 1
\tglobal_load_b32 v1, v0, s[0:1]          ; 4-byte load
\ts_waitcnt vmcnt(0)
\tv_fma_f32 v2, v1, v1, v2
\tv_rcp_f32_e32 v3, v2
\tv_add_nc_u32_e32 v0, 4, v0
\ts_add_i32 s2, s2, 1
\ts_cbranch_scc0 .LBB0_1
; %bb.2:
\ts_endpgm
.Lfunc_end0:
\t.amdhsa_kernel walk
\t.end_amdhsa_kernel
amdhsa.kernels:
  - .args:
      - .offset:         0
        .size:           8
        .value_kind:     global_buffer
    .group_segment_fixed_size: 512
    .name:           walk
    .private_segment_fixed_size: 16
    .sgpr_count:     70
    .sgpr_spill_count: 1
    .vgpr_count:     52
    .vgpr_spill_count: 2
amdhsa.target:   amdgcn-amd-amdhsa--gfx1100
"""

ZEBIN = b"""\x7fELF\x00---
version:         '1.20'
kernels:
  - name:            walk
    execution_env:
      grf_count:       128
      simd_size:       8
      slm_size:        2336
    per_thread_memory_buffers:
      - type:            scratch
        usage:           single_space
        size:            1024
      - type:            global
        usage:           private_space
        size:            64
        is_simt_thread:  true
kernels_misc_info:
  - name:            walk
\x00"""

TOLD = """ptxas info    : Compiling entry function 'walk' for 'sm_89'
ptxas info    : Function properties for walk
    96 bytes stack frame, 8 bytes spill stores, 4 bytes spill loads
ptxas info    : Used 81 registers, used 1 barriers, 96 bytes cumulative stack size, 2308 bytes smem, 440 bytes cmem[0]
"""


def built(whole: Loop | None = None, **changes: Any) -> Built:
    values = {"kernel": "blend", "target": "sm_89", "registers": 40, "spills": 0, "stack": 0, "shared": 0, **changes}
    return Built(**values, whole=whole or Loop([], set()))


def test_loops_of_sass() -> None:
    whole = parse_sass(SASS)["walk"]
    (outer,) = whole.inner
    (inner,) = outer.inner
    assert whole.tree == "((()))"  # without the jump to itself behind the end, which nothing reaches
    assert outer.sources == {4}
    assert inner.sources == {3}
    assert inner.counts == {"shared": 1, "fp32": 1, "control": 2}
    assert outer.counts == {"global": 1, "other": 1, "control": 4}
    assert whole.counts == {"other": 1, "control": 2}


def test_loops_of_amd() -> None:
    whole = parse_gcn(GCN)["walk"]
    (loop,) = whole.inner
    assert loop.sources == {2}
    assert loop.counts == {"global": 1, "control": 2, "fp32": 1, "other": 1, "integer": 1, "scalar": 1}
    assert whole.counts == {"global": 1, "control": 1}


@pytest.mark.parametrize(
    ("kind_of", "kind", "names"),
    [
        (sass_kind, "fp32", "FFMA FSETP.GEU.AND"),
        (sass_kind, "integer", "IMAD.MOV.U32 UISETP.NE.AND"),
        (sass_kind, "other", "I2FP.F32.S32 LDGSTS.E ULDC.64 VOTE.ANY"),
        (sass_kind, "shared", "LDL.64 ATOMS.MAX"),
        (sass_kind, "global", "STG.E.128"),
        (sass_kind, "control", "BAR.SYNC.DEFER_BLOCKING"),
        (gcn_kind, "fp32", "v_dual_fmac_f32 v_cmp_lt_f32_e32"),
        (gcn_kind, "integer", "v_cndmask_b32_e32"),
        (gcn_kind, "shared", "ds_load_b128 scratch_store_b32"),
        (gcn_kind, "control", "s_delay_alu"),
        (gcn_kind, "scalar", "s_and_b32"),
        (gcn_kind, "other", "v_cvt_f32_i32_e32"),
    ],
)
def test_kinds_of_instructions(kind_of: Callable[[str], str], kind: str, names: str) -> None:
    assert {name: kind_of(name) for name in names.split()} == dict.fromkeys(names.split(), kind)


def test_what_ptxas_says() -> None:
    (kernel,) = read_nvidia(TOLD, SASS, "sm_89")
    assert (kernel.registers, kernel.spills, kernel.stack, kernel.shared) == (81, 12, 96, 2308)


def test_what_amds_metadata_says() -> None:
    (kernel,) = read_amd(GCN, "gfx1100")
    assert (kernel.registers, kernel.spills, kernel.stack, kernel.shared) == (52, 12, 16, 512)


def test_what_intels_binary_says() -> None:
    (kernel,) = read_intel(Source("ranges", ("-DITEMS=64",)), "tgllp", ZEBIN)
    assert (kernel.kernel, kernel.step, kernel.shared) == ("walk", 8, 2336)
    assert kernel.stack == 1024 // 8 + 64  # of eight items, and of one


def test_a_binary_that_says_nothing() -> None:
    with pytest.raises(ClsplatError, match="ranges for tgllp: the binary of ocloc does not describe its kernels"):
        read_intel(Source("ranges", ("-DITEMS=64",)), "tgllp", b"\x7fELF")


def test_without_ocloc(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setattr(gpu_intel, "ocloc", lambda: None)
    monkeypatch.setattr(gpu_static, "ask_package", lambda *_: [[{"stem": "ranges", "options": ["-DITEMS=64"]}]])
    assert gpu_static.main(["--intel"]) == 2
    assert capsys.readouterr().err.endswith("gpu_static: error: no ocloc found: apt install intel-opencl-icd\n")


def test_instructions_a_pair() -> None:
    kernel = built(parse_sass(SASS)["walk"])
    rules = (
        Rule("while (outer)", lambda run: 0.5),
        Rule("for (inner)", lambda run: run.items),
        Rule("for (outer)", lambda run: 0.25, part=True),  # in both of the outer loop's blocks
    )
    cost = cost_of(kernel, LINES, rules, Run(64))
    assert cost.rules == set(rules)
    assert cost.once == {"other": 1, "control": 2}
    assert cost.rounds["fp32"] == 64
    assert cost.rounds["global"] == 0.5 * 0.25


def test_a_loop_that_no_rule_knows_is_told() -> None:
    kernel = built(parse_sass(SASS)["walk"])
    rules = (Rule("for (inner)", lambda run: 1),)
    with pytest.raises(
        UnknownLoopError, match=r"blend for sm_89 .*gpu_rules.* the loop of `while \(outer\);` \(6 instr"
    ):
        cost_of(kernel, LINES, rules, Run(64))
    refuses("walk: no kernel of BY_PAIR or BY_ITEM", rules_of, "walk", error=UnknownLoopError)


def test_an_unrolled_loop_runs_less_often() -> None:
    kernel = built(parse_sass(SASS.replace("FFMA R5, R1, R1, R5", "LDS R5, [R6]"))["walk"])
    rules = (Rule("while (outer)", lambda run: 1), Rule("for (inner)", lambda run: 8, mark=("shared", 1)))
    assert cost_of(kernel, LINES, rules, Run(64)).rounds["shared"] == 8


def loop_of(source: int, shared: int, fp32: int = 1) -> Loop:
    body = [Instruction("LDS", "shared", source=source)] * shared + [Instruction("FADD", "fp32", source=source)] * fp32
    return Loop([Block(body=body)], {source})


@pytest.mark.parametrize(
    ("loops", "shared"),
    [
        ((loop_of(2, 4), loop_of(2, 1)), 8),  # the second does what is left over
        ((loop_of(2, 1), loop_of(2, 1)), 16),  # a function that is called twice
        ((loop_of(2, 1), loop_of(3, 2)), 24),  # lines that read alike
        ((loop_of(2, 4), loop_of(4, 1)), 8),  # left over, with its jump in the line of the end
    ],
)
def test_loops_of_one_rule(loops: tuple[Loop, ...], shared: float) -> None:
    lines = ["kernel", "for (each)", "for (each)", "sum += each;"]
    rules = (Rule("for (each)", lambda run: 8, ends=("sum += each;",)),)
    cost = cost_of(built(Loop([], set(), list(loops))), lines, rules, Run(64))
    assert cost.rounds["shared"] == shared


def test_rounds_within_rounds() -> None:
    lines = ["kernel", "for (outer)", "for (scan)", "for (scan)"]
    rules = (Rule("for (outer)", lambda run: 3), Rule("for (scan)", lambda run: 5, inner=True, mark=("shared", 1)))
    outer = loop_of(2, 0)
    outer.inner.append(loop_of(3, 1))
    cost = cost_of(built(Loop([], set(), [outer, loop_of(4, 1)])), lines, rules, Run(32))
    assert cost.rounds["shared"] == 3 * 5 + 5  # in the loop, and behind it


def test_a_line_of_one_function() -> None:
    lines = ["static inline float first(void) {", "  for (each)", "GROUP __kernel void second(void) {", "  for (each)"]
    rules = (
        Rule("for (each)", lambda run: 2, function="first("),
        Rule("for (each)", lambda run: 3, function="second("),
    )
    cost = cost_of(built(Loop([], set(), [loop_of(2, 1), loop_of(4, 1)])), lines, rules, Run(64))
    assert cost.rounds["shared"] == 2 + 3


def test_rules_that_no_loop_has_are_told() -> None:
    used = {"scan_chunks": (*BY_ITEM["scan_chunks"][:1], *EVERYWHERE)}
    (told,) = unused_rules(used)
    assert told.startswith("scan_chunks: has no loop for the rule `for (uint base = begin;")
    used = {"scan_chunks": (*BY_ITEM["scan_chunks"], *EVERYWHERE), "ranges": ()}
    assert unused_rules(used) == []  # of a rule for every kernel, one has the loop
    used["scan_chunks"] = BY_ITEM["scan_chunks"]
    assert [told.partition(":")[0] for told in unused_rules(used)] == ["scan_chunks", "ranges"]


def test_rules_are_of_lines_that_kernels_have() -> None:
    texts = {path.stem: kernel_source(path.stem).splitlines() for path in kernel_root().glob("*.cl")}
    for kernel, rules in [*BY_PAIR.items(), *BY_ITEM.items(), ("blend_grad", WALK), ("scan_sums", EVERYWHERE)]:
        (lines,) = [text for text in texts.values() if any(re.match(rf"(.* )?{kernel}\(", line) for line in text)]
        for rule in rules:
            assert any(rule.matches(number, lines) for number in range(1, len(lines) + 1)), (kernel, rule.text)


@pytest.mark.parametrize("items", [32, 64, 128, 256])
def test_rules_have_the_kernels_own_sizes(items: int) -> None:
    """Numbers of the rules that stand in the kernels too."""

    def defined(path: str, name: str, **others: int) -> int:
        text = (kernel_root() / path).read_text()
        (value,) = re.findall(rf"^#define {name} (.*ITEMS.*|\d{{2,}})$", text, re.MULTILINE)
        words = re.sub(r"(.*?) \? (.*?) : ", r"(\2) if (\1) else ", value.strip("()"))
        words = words.replace("/", "//").replace("&&", "and")
        return int(eval(words, {"ITEMS": items, **others}))  # of a file of this repository

    run = Run(items)
    strips = (kernel_root() / "shared/strips.h").read_text()
    assert "#define TOGETHER (SLOT_STRIDE > 9 ? 1 : 2)\n" in strips
    assert "#define TOGETHER (BLOCK_ITEMS < SLOT_STRIDE ? 1 : BLOCK_ITEMS / SLOT_STRIDE)\n" in strips
    assert gpu_run.together(items // 32) == (2 if items > 64 else 32 // PLAIN_SLOTS.floats)
    assert defined("blend_grad.cl", "BATCH") == gpu_run.BATCH_BACK
    assert run.batch == defined("shared/blocks.h", "BATCH")
    assert defined("sort_radix.cl", "RUN") == gpu_run.PER_ITEM
    assert f"#define ABREAST {gpu_rules.ABREAST}\n" in (kernel_root() / "shared/adam.h").read_text()


def test_rounds_of_a_launch() -> None:
    run = Run(64, groups=10, elements=12_000, digits=256)
    assert run.of_item == pytest.approx(12_000 / 640)
    assert run.tiles == pytest.approx(12 / 10)  # of 1024 keys, the last one not full
    assert run.sums_before == 1
    assert run.shared(100) == 4 / 2  # 100 elements are four waves' work, and two waves share it
    assert Run(64, listed=32).batches == pytest.approx(2 / 64)  # half a batch a tile is left over


@pytest.mark.parametrize(
    ("registers", "shared", "items", "waves", "by"),
    [
        (32, 0, 64, 48, "warps"),
        (72, 0, 64, 28, "registers: 65,536 / (72 x 32)"),
        (40, 33_000, 64, 6, "memory: 102,400 / 34,024 groups of two"),
        (40, 0, 32, 24, "groups"),
    ],
)
def test_occupancy_on_ada(registers: int, shared: int, items: int, waves: int, by: str) -> None:
    kernel = built(registers=registers, shared=shared)
    assert waves_at_a_time(kernel, items) == waves, by
    assert occupancy(kernel, items) == waves / 48


def test_a_limit_of_registers_is_for_ptxas() -> None:
    source = Source("blend", ("-DITEMS=64", "-cl-std=CL1.2", "-cl-nv-maxrregcount=96"))
    assert source.register_limit == ("-maxrregcount=96",)
    assert source.options_for("sm_89") == source.options_for("gfx1100") == ("-DITEMS=64", "-cl-std=CL1.2")
    assert Source("blend", source.common).register_limit == ()


def test_a_file_is_compiled_once_for_shapes_that_it_does_not_tell_apart() -> None:
    """`project_grad` does not name ITEMS, `blend` does, in a file that it includes."""
    for stem, options, same in (("project_grad", "-DRAYS", True), ("blend", "-DRAYS", False)):
        small, large = (Source(stem, (f"-DITEMS={items}", "-DLANES=1", options, "-cl-std=CL1.2")) for items in (32, 64))
        assert small != large
        assert (small.used == large.used) is same
        assert small.used != Source(stem, (*small.options[:1], "-DLANES=2", *small.options[2:])).used
        assert "-cl-std=CL1.2" in small.used.options


def row(
    stem: str = "blend", pair: float | None = None, unknown: str = "", more: tuple[str, ...] = (), **changes: Any
) -> Row:
    counts = None if pair is None else Counter(fp32=pair)
    source = Source(stem, ("-DITEMS=64", "-DLANES=1", *more))
    return Row(source, built(kernel=stem, **changes), 64, 0, counts, unknown=unknown)  # type: ignore[arg-type]


def test_ceilings() -> None:
    good = [row(stem, MOST_A_PAIR.get(stem)) for stem in NO_STACK]
    assert broken(good) == []
    (told,) = broken([*good, row("blend_grad", MOST_A_PAIR["blend_grad"] + 1)])
    assert told == "blend_grad, 1x64, sm_89: 241 instructions of a warp for a pair, expected at most 240"
    (told,) = broken([*good, row("blend_grad", MOST_BY_GAUSSIAN + 1, more=("-DBY_GAUSSIAN",))])
    assert told.endswith("501 instructions of a warp for a pair, expected at most 500")
    (told,) = broken([*good, row("sort_radix", stack=8)])
    assert told == "sort_radix, 1x64, sm_89: 8 bytes of stack and 0 of spills, expected none"
    assert broken([*good, row("sort_radix", stack=8, target="gfx1100")]) == []
    assert len(broken([*good, row("blend", spills=4, target="gfx1100")])) == 1
    assert broken([*good, row("blend", unknown="a loop")]) == ["a loop"]
    assert "sort_radix: in NO_STACK of gpu_static.py, expected a kernel file of a step" in broken(good[:-1])[0]


def adams_loop(loads: int, size: int, name: str = "LDG.E.128", scattered: int = 0) -> Loop:
    """scattered: loads of SH coefficients before the loop."""
    lines = list(enumerate(kernel_source("project_grad").splitlines(), 1))
    (line,) = [number for number, text in lines if gpu_rules.ADAM.text in text]
    (read,) = [number for number, text in lines if SH_READ in text]
    body = [Instruction(name, "global", source=line)] * loads + [Instruction("FADD", "fp32", source=line)]
    body += [Instruction(name, "global", source=line)] * (size - len(body))
    before = [Instruction("LDG.E", "global", source=read)] * scattered + [Instruction("LDS", "shared", source=read)]
    return Loop([Block(body=before)], set(), [Loop([Block(body=body)], {line})])


@pytest.mark.parametrize(
    ("whole", "changes", "told"),
    [
        (adams_loop(3, 200), {}, ""),
        (adams_loop(3, 201), {}, "50.25 instructions of Adam per element, expected at most 50"),
        (adams_loop(2, 200), {}, "2 loads of 16 bytes before Adam's arithmetic, expected 3"),
        (adams_loop(3, 200, "LDG.E"), {}, "0 loads of 16 bytes before Adam's arithmetic, expected 3"),
        (adams_loop(3, 200, scattered=45), {}, "45 loads of SH coefficients, each item from its row, expected none"),
        (adams_loop(3, 200), {"registers": 97}, "97 registers, expected at most 96"),
        (adams_loop(3, 3382), {"target": "gfx1100"}, "3383 instructions, expected at most 3382"),
    ],
)
def test_ceilings_of_the_step(whole: Loop, changes: dict[str, Any], told: str) -> None:
    source = Source("project_grad", ("-DITEMS=64", "-DLANES=1", "-DADAM"))
    step = Row(source, built(whole, **{"kernel": "project_step", **changes}), 64, 0, None)
    others = [row(stem) for stem in NO_STACK if stem != "project_grad"]
    target = changes.get("target", "sm_89")
    assert broken([*others, step]) == ([f"project_step, 1x64, {target}: {told}"] if told else [])


def test_ceilings_of_the_loss() -> None:
    half = {t: most * LOSS_GROUP_ROWS * LOSS_GROUP_COLUMNS / LOSS_PARTS / 2 for t, most in MOST_A_SAMPLE.items()}
    good = [replace(row("loss", target=target), a_wave=half[target]) for target in half for _ in range(2)]
    assert loss_faults(good) == []
    assert loss_faults([*good, row("target", target="sm_89")]) == ["loss, sm_89: 3 launches, expected 2"]
    dear = [*good[1:], replace(good[0], a_wave=half["sm_89"] + 1)]
    assert loss_faults(dear) == ["loss, sm_89: 450.2 instructions a sample, expected at most 450"]
    spilt = [*good[:-1], row("loss", target="gfx90a", stack=8)]
    assert loss_faults(spilt) == ["loss, gfx90a: stack or spills, expected none"]


@pytest.mark.parametrize(("most", "told"), [(12, 0), (11.9, 2)])
def test_goals(monkeypatch: pytest.MonkeyPatch, most: float, told: int) -> None:
    monkeypatch.setattr(gpu_page, "WANTED", most)
    monkeypatch.setattr(gpu_page, "FRAMES_WANTED", 1000 / most)
    frames: list[dict[str, Any]] = [{"name": "small"}, {"name": "large"}]
    frames += [{"name": "larger", "held_out": True}, {"name": "drawn", "picture": True}]
    stages = {"small": {"blend": Stage(ms=100)}, "large": {"blend": Stage(ms=5), "loss": Stage(ms=7)}}
    predictions = {("1x64", "RTX 4090", name): each for name, each in {**stages, "drawn": stages["large"]}.items()}
    missed = gpu_page.missed_goals(predictions, frames)
    assert len(missed) == told
    assert not told or missed[0] == "large, 1x64, RTX 4090: 12.0 ms a step predicted, expected at most 11.9"


def test_a_page_of_older_kernels_is_told() -> None:
    page = "<!-- compilers -->\nclang 1\n<!-- end -->\n<!-- kernels -->\n| 7 |\n<!-- end -->\n"
    assert gpu_page.stale_tables(page, {"compilers": "clang 1", "kernels": "| 7 |"}) == []
    assert gpu_page.stale_tables(page, {"compilers": "clang 1", "kernels": "| 8 |"}) == ["kernels"]
    assert gpu_page.stale_tables(page, {"compilers": "clang 2", "kernels": "| 8 |"}) == []  # other compilers
    refuses("has no place for the table pairs", gpu_page.stale_tables, page, {"pairs": ""}, error=ClsplatError)


def test_without_clang(monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setattr(gpu_compilers.shutil, "which", lambda _: None)
    monkeypatch.setattr(gpu_static, "ask_package", lambda *_: [[]])
    assert gpu_static.main(["--check"]) == 2
    assert capsys.readouterr().err == "gpu_static: error: no clang 19 found: apt install clang-19\n"


def test_another_clang(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_compilers.shutil, "which", lambda name: "/bin/clang" if name == "clang" else None)
    done = subprocess.CompletedProcess([], 0, "clang version 15.0.6\n", "")
    monkeypatch.setattr(gpu_compilers, "_run", lambda _: done)
    told = "no clang 19 found; /bin/clang is another version: apt install clang-19"
    refuses(told, gpu_compilers.clang, error=NoCompilerError)


def test_without_an_index(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    gpu_compilers.nvidia.cache_clear()
    monkeypatch.setattr(gpu_compilers, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(gpu_compilers, "_run", lambda _: subprocess.CompletedProcess([], 1, "", "ERROR: no index\n"))
    told = r"no ptxas found: .*pip download nvidia-cuda-nvcc==\S+ failed: ERROR: no i"
    refuses(told, gpu_compilers.nvidia, "ptxas", error=NoCompilerError)


@pytest.mark.parametrize("arguments", [["--shapes", "8x1"], ["--targets", "sm_20"]])
def test_what_is_not_known_is_told(arguments: list[str], capsys: Capture) -> None:
    assert gpu_static.main(arguments) != 0
    assert capsys.readouterr().err.startswith(f"gpu_static: error: {arguments[0]} {arguments[1]}: expected one of")


def test_a_rehearsed_step_is_the_packages() -> None:
    """And a frame, whose lists are made by radix sorts."""
    frame = {**json.loads(FRAMES.read_text())["frames"][0], "listed": 1_000_000}
    launches, of_picture = ask_package("1x64", [frame, {**frame, "picture": True}])
    sources = sources_of([*launches, *of_picture])
    assert {source.stem for source in sources} >= set(NO_STACK)
    assert {source.items for source, kernels in sources.items() if "list_offsets" not in kernels} == {64}
    stages = {launch["stage"] for launch in launches}
    assert {"project", "append", "blend", "loss", "blend_grad"} <= stages
    assert not stages & {"duplicate", "ranges"}
    (blend,) = [launch for launch in launches if launch["kernel"] == "blend"]
    tiles = -(-frame["width"] // 16) * -(-frame["height"] // 16)
    assert (blend["size"], blend["local"]) == ([64 * tiles], [64])
    assert {kernel for kernels in sources.values() for kernel in kernels} == {*BY_PAIR, *BY_ITEM}

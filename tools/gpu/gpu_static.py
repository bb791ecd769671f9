#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Count registers, spills, memory and instructions of kernels from GPUs' compilers, without a GPU.

    python tools/gpu/gpu_static.py [--shapes 1x64] [--targets sm_89,gfx1100] [--stems blend,...] [--loops] [--json]
    python tools/gpu/gpu_static.py --check
    python tools/gpu/gpu_static.py --page
    python tools/gpu/gpu_static.py --inputs
    python tools/gpu/gpu_static.py --intel [--shapes 1x64] [--stems blend,...]

The kernels are those of a training step, with clsplat's defines (`gpu_variants.py`). clang 19 compiles them to
NVIDIA's and AMD's assembly. ptxas assembles NVIDIA's; pip downloads it once into the cache folder. Division and sqrt
are rounded correctly.

Instructions per (tile, Gaussian) pair are those of all waves of a group, from rules for loops (`gpu_rules.py`). --intel
prints a table from Intel's compiler, which reports less (`gpu_intel.py`). --page writes docs/gpu-static.md, with the
times that `gpu_model.py` predicts, and fits the model's constants to docs/gpus/calibration.json on the way. --check
tests the ceilings below, the page's goals, and the predictions against what was measured, and compares the page with
current kernels. The exit status is 0 if all is as expected, and 2 if a compiler is missing. It is 1 if a ceiling is
exceeded, a goal is missed, a prediction is too far off or the page is out of date. It is 1 also if a loop has no rule,
a rule has no loop, or a compiler refuses a kernel.
--inputs counts the inputs in docs/gpus/calibration.json anew, in the code that was measured, from the repository's
history.
`gpu_devices.py` computes the occupancy.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "bench"))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from gpu_assembly import CLASSES
from gpu_compilers import TARGETS, Built, Source, ask_package, build_builtins, clang, compile_source, compilers, nvidia
from gpu_devices import ARCHITECTURES, GPUS, occupancy
from gpu_intel import IntelBuilt, compiled_for_intel, ocloc
from gpu_loops import UnknownLoopError, by_pair, cost_of, loop_table, rules_of, unused_rules
from gpu_measured import CALIBRATION, Fit, Works, beyond, fit_constants, inputs_of, read, with_inputs
from gpu_model import blocks_of, stages_of, works_of
from gpu_page import PAGE, SHAPE, Predictions, missed_goals, stale_tables, tables_of, trained_and_picture, write_page
from gpu_recount import recount
from gpu_rules import ABREAST, ADAM, BY_PAIR, WALK, Rule
from gpu_run import Run
from gpu_shapes import FORMS, SHAPES, frames_in, on_each_gpu
from measuring import plain_parser, require, tool

from clsplat.files.atomic import atomic_write
from clsplat.layouts.columns import LOSS_GROUP_COLUMNS, LOSS_GROUP_ROWS, LOSS_PARTS
from clsplat.progress import aligned

FRAMES = Path(__file__).with_name("gpu_frames.json")
CHECKED = (("1x64", "1x32g"), ("sm_89", "sm_90", "gfx1100", "gfx90a"))
"""Shapes and targets that have ceilings."""
NO_STACK = ("blend", "blend_grad", "project_grad", "sort_radix")
"""Kernel files that must use no stack memory and no spills on NVIDIA's GPUs."""
NO_SCRATCH = ("blend", "blend_grad", "project_grad")
"""Kernel files that must use no stack memory and no spills on AMD's GPUs."""
MOST_A_PAIR = {"blend": 140, "blend_grad": 240}
"""Maximum number of a warp's instructions per pair of the largest frame, on NVIDIA's GPUs."""
MOST_A_SAMPLE = {"sm_89": 450, "sm_90": 450, "gfx1100": 540, "gfx90a": 540}
"""Maximum number of instructions of the loss for a pixel and channel, of all items of a block. On these targets the
loss uses no stack memory and no spills, and it has two launches."""
MOST_BY_GAUSSIAN = 500
"""Maximum number of a warp's instructions per pair there, for blend_grad with a Gaussian per item."""
MOST_AN_ELEMENT = 50
"""Maximum number of instructions per element of the model in Adam's loop, on NVIDIA's GPUs."""
MOST_REGISTERS = {"project_step": 96}
"""Maximum number of registers on NVIDIA's GPUs."""
LOADS_AHEAD = 3
"""Loads of 16 bytes in Adam's loop before it uses the first on NVIDIA's GPUs: parameters and both moments."""
SH_READ = "fma1(d_colour.x, f[0]"
"""Part of the line in which an item of `project_step` reads its row of SH coefficients. A load from global memory would
touch a line for each item there; a group copies its rows to local memory, in loads of 16 bytes side by side."""
MOST_INSTRUCTIONS = {"gfx1100": {"project_step": 3382}, "gfx90a": {"project_step": 3268}}
"""Maximum number of instructions of whole kernels: those before Adam by fours."""


@dataclass(frozen=True)
class Row:
    """A kernel for a target and shape.

    items: number of items per group.
    more_shared: bytes of local memory per group that the host adds.
    pair: instructions per pair, by class; None if the kernel has no pairs.
    rules: the rules of its loops.
    unknown: description of loops without a rule, or "".
    a_wave: number of instructions that a wave runs, for a kernel without pairs.
    """

    source: Source
    built: Built
    items: int
    more_shared: int
    pair: Counter[str] | None
    rules: frozenset[Rule] = frozenset()
    unknown: str = ""
    a_wave: float = 0

    @property
    def a_pair(self) -> float | None:
        """Number of instructions per pair."""
        return None if self.pair is None else sum(self.pair.values())

    @property
    def instructions(self) -> int:
        """Number of instructions of the kernel's code."""
        return sum(loop.size for _, loop in self.built.whole.walk())

    def told(self) -> dict[str, Any]:
        """The row as a dict for JSON."""
        built = self.built
        loops = [
            {"depth": depth, "loop": title, "instructions": dict(counts)}
            for depth, title, counts in loop_table(built, self.source.lines)
        ]
        return {
            "kernel": built.kernel,
            "source": self.source.label,
            "target": built.target,
            "shape": self.source.shape,
            "group": self.items,
            "registers": built.registers,
            "spills": built.spills,
            "stack": built.stack,
            "shared": built.shared + self.more_shared,
            "occupancy": round(occupancy(built, self.items, self.more_shared), 3),
            "instructions": self.instructions,
            "loops": loops,
            "a_pair": None if self.pair is None else {kind: round(self.pair[kind], 1) for kind in CLASSES},
        }


_COMPILED: dict[tuple[Source, str], list[Built]] = {}
"""Cache of compiled kernels, keyed by `Source.used` and target."""


def sources_of(launches: Iterable[Mapping[str, Any]]) -> dict[Source, dict[str, tuple[int, int]]]:
    """The kernel files of launches, and for each kernel the items per group and the bytes of local memory that the host
    adds."""
    found: dict[Source, dict[str, tuple[int, int]]] = {}
    for launch in launches:
        if "stem" in launch:
            kernels = found.setdefault(Source.of(launch), {})
            if "kernel" in launch:
                items = 1
                for side in launch["local"] or (64,):
                    items *= side
                kernels[launch["kernel"]] = (items, launch["shared"])
    return found


def compiled(
    sources: Mapping[Source, Mapping[str, tuple[int, int]]],
    targets: Sequence[str],
    jobs: int,
    say: Callable[[str], None],
    frame: Mapping[str, Any],
) -> list[Row]:
    """The rows of all sources for all targets. Raises ClsplatError.

    sources: from `sources_of`.
    say: prints progress.
    frame: the frame whose counts determine the instructions per pair.
    """
    clang()
    if any(target.startswith("sm_") for target in targets):
        nvidia("ptxas")
        nvidia("nvdisasm")
    with tempfile.TemporaryDirectory(prefix="clsplat-gpu-") as scratch, ThreadPoolExecutor(jobs) as pool:
        bitcode = pool.map(lambda target: build_builtins(target, Path(scratch)), targets)
        builtins = dict(zip(targets, bitcode, strict=True))
        asked = {(source, target): (source.used, target) for target in targets for source in sources}
        new = {used: each for each, used in asked.items() if used not in _COMPILED}
        say(f"{len(new)} kernel files to compile")
        built = pool.map(lambda each: compile_source(each[0], each[1], builtins[each[1]]), new.values())
        _COMPILED.update(zip(new, built, strict=True))
        return [
            row_of(source, kernel, sources[source].get(kernel.kernel), frame)
            for (source, _), used in asked.items()
            for kernel in _COMPILED[used]
            if not sources[source] or kernel.kernel in sources[source]
        ]


def row_of(source: Source, built: Built, launch: tuple[int, int] | None, frame: Mapping[str, Any]) -> Row:
    """The row of a kernel. launch: items per group and the host's bytes of local memory; None if it is not launched."""
    items, more_shared = launch or (source.items if built.kernel in BY_PAIR else 64, 0)
    pair, rules, unknown, a_wave = None, frozenset[Rule](), "", 0.0
    if launch or built.kernel in BY_PAIR:
        wave = ARCHITECTURES[built.target].wave
        run = Run(source.items, wave, source.subgroup, **blocks_of(frame, source.items))
        try:
            cost = cost_of(
                built, source.lines, WALK if source.by_gaussian else rules_of(built.kernel, source.commit), run
            )
            rules, pair = cost.rules, by_pair(cost, run) if built.kernel in BY_PAIR else None
            a_wave = (cost.once + cost.rounds).total()
        except UnknownLoopError as error:
            unknown = str(error)
    return Row(source, built, items, more_shared, pair, rules, unknown, a_wave)


def table(rows: Sequence[Row]) -> list[str]:
    """Text table of the rows. The last column has the defines that do not come from the shape."""
    names = ("registers", "spills", "stack", "shared")
    lines: list[tuple[str, ...]] = [("kernel", "shape", "target", *names, "occupancy", "instructions", "a pair")]
    for row in rows:
        told = row.told()
        numbers = [str(told[name]) for name in names]
        pair = "unknown" if row.unknown else "-" if row.a_pair is None else f"{row.a_pair:.0f}"
        last = (f"{told['occupancy']:.0%}", str(told["instructions"]), pair)
        lines.append((row.built.kernel, told["shape"], row.built.target, *numbers, *last))
    defines = ["", *(row.source.label.removeprefix(row.source.stem) for row in rows)]
    return [f"{line} {text}".rstrip() for line, text in zip(aligned(lines), defines, strict=True)]


def intel_lines(built: Sequence[IntelBuilt]) -> list[str]:
    """Text table of the reports of Intel's compiler."""
    lines: list[tuple[str, ...]] = [("kernel", "shape", "device", "items in step", "stack", "shared")]
    for each in built:
        numbers = (str(value) for value in (each.step, each.stack, each.shared))
        lines.append((each.kernel, f"1x{each.source.items}", each.device, *numbers))
    return list(aligned(lines))


def loops_of(rows: Sequence[Row]) -> list[str]:
    """Text with the loops of each row, as a tree."""
    lines = []
    for row in rows:
        lines.append(f"{row.source.label}: {row.built.kernel}, {row.source.shape}, {row.built.target}")
        for depth, title, counts in loop_table(row.built, row.source.lines):
            kinds = ", ".join(f"{counts[kind]} {kind}" for kind in CLASSES if counts[kind])
            lines.append(f"{'  ' * (depth + 1)}{title}: {kinds}")
        if row.pair:
            kinds = ", ".join(f"{row.pair[kind]:.0f} {kind}" for kind in CLASSES if row.pair[kind])
            lines.append(f"  for a pair: {kinds}")
    return lines


def broken_loop(row: Row) -> list[str]:
    """Descriptions of exceeded ceilings of Adam's loop, if the kernel has it."""
    loops = [loop for _, loop in row.built.whole.walk() if ADAM.opens(loop, row.source.lines)]
    found = []
    for loop in sorted(loops, key=lambda each: each.size)[-1:]:  # smaller loops come from jumps that ptxas adds
        if loop.size > MOST_AN_ELEMENT * ABREAST:
            found.append(
                f"{loop.size / ABREAST:g} instructions of Adam per element, expected at most {MOST_AN_ELEMENT}"
            )
        body = (each for block in loop.blocks for each in block.body)
        before = takewhile(lambda each: each.kind != "fp32", body)
        ahead = sum(each.name.startswith("LDG.E.128") for each in before)
        if ahead < LOADS_AHEAD:
            found.append(f"{ahead} loads of 16 bytes before Adam's arithmetic, expected {LOADS_AHEAD}")
    lines = row.source.lines
    reads = [each for _, loop in row.built.whole.walk() for block in loop.blocks for each in block.body if each.source]
    scattered = sum(each.kind == "global" and SH_READ in lines[each.source - 1] for each in reads)
    if row.built.kernel == "project_step" and scattered:
        found.append(f"{scattered} loads of SH coefficients, each item from its row, expected none")
    return found


def broken(rows: Sequence[Row]) -> list[str]:
    """Descriptions of exceeded ceilings."""
    found = []
    for row in rows:
        built, stem = row.built, row.source.stem
        where = f"{built.kernel}, {row.source.shape}, {built.target}"
        bare = NO_STACK if built.target.startswith("sm_") else NO_SCRATCH
        if stem in bare and (built.stack or built.spills):
            found.append(f"{where}: {built.stack} bytes of stack and {built.spills} of spills, expected none")
        most = MOST_BY_GAUSSIAN if row.source.by_gaussian else MOST_A_PAIR.get(built.kernel)
        if most is not None and built.target.startswith("sm_") and row.a_pair is not None and row.a_pair > most:
            found.append(f"{where}: {row.a_pair:.0f} instructions of a warp for a pair, expected at most {most}")
        most = MOST_INSTRUCTIONS.get(built.target, {}).get(built.kernel)
        if most is not None and (number := row.told()["instructions"]) > most:
            found.append(f"{where}: {number} instructions, expected at most {most}")
        if built.target.startswith("sm_"):
            most = MOST_REGISTERS.get(built.kernel)
            if most is not None and built.registers > most:
                found.append(f"{where}: {built.registers} registers, expected at most {most}")
            found += [f"{where}: {text}" for text in broken_loop(row)]
        if row.unknown:
            found.append(row.unknown)
    stems = {row.source.stem for row in rows}
    found += [
        f"{stem}: in NO_STACK of gpu_static.py, expected a kernel file of a step"
        for stem in NO_STACK
        if stem not in stems
    ]
    return found


def loss_faults(rows: Sequence[Row]) -> list[str]:
    """Descriptions of exceeded ceilings of the loss in the shape 1x64. Kernels of target.cl are part of the loss."""
    found = []
    for target, most in MOST_A_SAMPLE.items():
        launched = [
            row
            for row in rows
            if (row.source.shape, row.built.target) == ("1x64", target) and row.source.stem in ("target", "loss")
        ]
        if len(launched) != 2:
            found.append(f"loss, {target}: {len(launched)} launches, expected 2")
        found += [
            f"{row.built.kernel}, {target}: stack or spills, expected none"
            for row in launched
            if row.built.stack or row.built.spills
        ]
        a_sample = sum(row.a_wave for row in launched) * LOSS_PARTS / (LOSS_GROUP_ROWS * LOSS_GROUP_COLUMNS)
        if a_sample > most:
            found.append(f"loss, {target}: {a_sample:.1f} instructions a sample, expected at most {most}")
    return found


@tool("gpu_static")
def main(arguments: Sequence[str]) -> int:
    """Compile, count and print."""
    parser = plain_parser(__doc__, prog="gpu_static")
    parser.add_argument("--shapes", default="1x64", help=f"of the kernels, such as {','.join(SHAPES)}")
    parser.add_argument("--targets", default=",".join(CHECKED[1]), help=f"of {','.join(TARGETS)}, or `all`")
    parser.add_argument("--stems", default="", help="kernel files; all where not given")
    parser.add_argument("--loops", action="store_true", help="print the loops of each kernel")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--check", action="store_true", help="hold the ceilings, the goals and the page")
    parser.add_argument("--page", action="store_true", help="write the tables and the plot of docs/gpu-static.md")
    parser.add_argument("--inputs", action="store_true", help="count measured steps anew, after a change to the model")
    parser.add_argument("--intel", action="store_true", help="Intel's GPUs in place of --targets")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="compilers at once")
    options = parser.parse_args(arguments)
    frames = json.loads(FRAMES.read_text())["frames"]
    trained, _ = trained_and_picture(frames)
    if options.page:
        return make_page(frames, options.jobs)
    if options.inputs:
        return make_inputs(frames, options.jobs)
    if options.check:
        return check(frames, options.jobs)
    shapes = options.shapes.split(",")
    targets = TARGETS if options.targets == "all" else options.targets.split(",")
    for shape in shapes:
        require(shape in SHAPES + FORMS, f"--shapes {shape}: expected one of {', '.join(SHAPES + FORMS)}")
    for target in targets:
        require(target in TARGETS, f"--targets {target}: expected one of {', '.join(TARGETS)}")
    wanted = options.stems.split(",") if options.stems else []
    rows: list[Row] = []
    for shape in shapes:
        asked = ask_package(shape, trained[-1:])[0]
        sources = {
            source: kernels for source, kernels in sources_of(asked).items() if not wanted or source.stem in wanted
        }
        if options.intel:
            built = compiled_for_intel(sources, options.jobs, partial(note, shape))
            print("\n".join(intel_lines(built)))
            continue
        rows += compiled(sources, targets, options.jobs, partial(note, shape), trained[-1])
    if options.intel:
        return 0
    if options.json:
        print(json.dumps([row.told() for row in rows], indent=2))
    else:
        print("\n".join(loops_of(rows) if options.loops else table(rows)))
    for row in rows:
        if row.unknown:
            note(row.unknown)
    return 0


def check(frames: Sequence[Mapping[str, Any]], jobs: int) -> int:
    """Print the rows that have ceilings, exceeded ceilings, missed goals, predictions that are too far from what was
    measured, and outdated tables."""
    rows, predictions, fit = counted(frames, jobs)
    shapes, targets = CHECKED
    held = [row for row in rows if row.source.shape in shapes and row.built.target in targets]
    found = broken(held) + loss_faults(rows) + missed_goals(predictions, frames) + beyond(fit[0], fit[1])
    tables = tables_of(rows, predictions, frames, compilers(), fit)
    if stale := stale_tables(PAGE.read_text("utf-8"), tables):
        update = "python tools/gpu/gpu_static.py --page"
        found.append(f"{PAGE.name}: {', '.join(stale)} differ from current kernels, expected the tables of `{update}`")
    print("\n".join([*table(held), "", *(found or ["every ceiling holds, and the page is today's"])]))
    return int(bool(found))


def make_page(frames: Sequence[Mapping[str, Any]], jobs: int) -> int:
    """Count and predict everything, and write the page. Without ocloc, Intel's table is unchanged."""
    rows, predictions, fit = counted(frames, jobs)
    sources = dict.fromkeys(row.source for row in rows if row.source.stem in NO_STACK and not row.source.by_gaussian)
    intel = compiled_for_intel(list(sources), jobs, note) if ocloc() else []
    write_page(tables_of(rows, predictions, frames, compilers(), fit, intel), predictions, frames)
    for each in beyond(fit[0], fit[1]):
        note(each)
    return 0


def make_inputs(frames: Sequence[Mapping[str, Any]], jobs: int) -> int:
    """Count the measured steps of calibration.json in the code that was measured, and write the file."""

    def count(step: Sequence[Mapping[str, Any]], target: str, frame: Mapping[str, Any]) -> list[Any]:
        rows = compiled(sources_of(step), (target,), jobs, note, frame)
        return inputs_of(works_of(step, {(row.source, row.built.kernel): row.built for row in rows}, frame))

    measured = json.loads(CALIBRATION.read_text())
    recount(measured, frames, count)
    atomic_write(CALIBRATION, with_inputs(measured, {}).encode())
    return 0


def counted(frames: Sequence[Mapping[str, Any]], jobs: int) -> tuple[list[Row], Predictions, Fit]:
    """The rows of a step's kernels in every shape for every target, the stages of each frame on every GPU, and the
    constants that were fitted. Raises UnknownLoopError for a loop without a rule and a rule without a loop."""
    rows: list[Row] = []
    used: dict[str, set[Rule]] = {}
    works: dict[str, Works] = {}
    # Compilers run in processes of their own, while this process counts the kernels of the shape before.
    with ThreadPoolExecutor(jobs) as asking, ThreadPoolExecutor(1) as compiling:
        steps = {shape: asking.submit(ask_package, shape, frames_in(shape, frames)) for shape in SHAPES + FORMS}
        made = [compiling.submit(rows_in, shape, asked, frames, jobs) for shape, asked in steps.items()]
        for (shape, asked), found in zip(steps.items(), made, strict=True):
            rows += found.result()
            if shape in SHAPES:
                works[shape] = works_in(found.result(), asked.result(), frames_in(shape, frames))
                for row in found.result():
                    used.setdefault(row.built.kernel, set()).update(row.rules)
    if unused := unused_rules(used):
        raise UnknownLoopError("; ".join(unused))
    now = on_each_gpu(works, frames)
    calibration = json.loads(CALIBRATION.read_text())
    measured, unread = read(calibration, now)
    constants = fit_constants(calibration, measured)
    predictions = {
        (shape, gpu.name, frame): stages_of(now[gpu.name, frame] if shape == SHAPE else each, gpu, constants)
        for shape, of_shape in works.items()
        for (target, frame), each in of_shape.items()
        for gpu in GPUS
        if gpu.target == target
    }
    return rows, predictions, (measured, constants, unread, now)


def rows_in(shape: str, asked: Future[list[Any]], frames: Sequence[Mapping[str, Any]], jobs: int) -> list[Row]:
    """The rows of a shape's kernels for every target; for a shape in FORMS, only those of kernels that have this form.

    asked: a future with the launches of each frame.
    """
    sources = sources_of(launch for step in asked.result() for launch in step)
    if shape in FORMS:
        sources = {source: kernels for source, kernels in sources.items() if source.shape == shape}
    return compiled(sources, TARGETS, jobs, partial(note, shape), trained_and_picture(frames)[0][-1])


def works_in(rows: Sequence[Row], steps: Sequence[Any], frames: Sequence[Mapping[str, Any]]) -> Works:
    """The work of each frame's launches on every target. steps: launches of each frame."""
    works = {}
    for target in TARGETS:
        built = {(row.source, row.built.kernel): row.built for row in rows if row.built.target == target}
        for frame, step in zip(frames, steps, strict=True):
            works[target, frame["name"]] = works_of(step, built, frame)
    return works


def note(*words: str) -> None:
    """Print a line to standard error: words with colons between them."""
    print(*words, sep=": ", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

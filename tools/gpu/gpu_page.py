# SPDX-License-Identifier: Apache-2.0
"""The tables and the plot of docs/gpu-static.md, from the rows and predictions of `gpu_static.py`."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from gpu_chain import NEAR
from gpu_devices import GPUS, occupancy
from gpu_intel import INTEL, IntelBuilt
from gpu_measured import PARTS, WALLS, Fit, Measured, Works, milliseconds
from gpu_model import LAUNCH, LINES, PASSES, Constants, Stage
from plotting import plot_stacks

from clsplat.errors import ClsplatError
from clsplat.files.atomic import atomic_write
from clsplat.layouts.columns import TILE

ROOT = Path(__file__).resolve().parents[2]
PAGE, PLOT = ROOT / "docs/gpu-static.md", ROOT / "docs/images/gpu-static.svg"
SHAPE, TARGET, GPU = "1x64", "sm_89", "RTX 4090"
"""Shape, target and GPU of the tables that show only one."""
LETTERS = 128
"""Length of a line of text."""
VKSPLAT, VKSPLAT_GPU = (19, 25, 25, 32, 130, 131, 5), "RTX 3090"
"""Seconds of the parts in VkSplat's trainings of 30,000 steps: means of seven scenes, from its project's page."""
WANTED, FRAMES_WANTED, LITEGS = 8, 400, 4.0
"""Maximum milliseconds of a step, and minimum pictures per second; milliseconds of a step of LiteGS."""

WANTED_STEPS = (
    ("H200", "made up, 1 M", 2.6),
    ("H100 SXM", "made up, 1 M", 2.8),
    ("H200", "fox, step 7000", 1.2),
    ("RTX 4090", "made up, 1 M", 3.9),
)
"""GPUs and frames, with the maximum milliseconds of a step that is wanted there."""

Predictions = Mapping[tuple[str, str, str], Mapping[str, Stage]]
"""Stages of a step, keyed by shape, GPU and frame."""


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first row is its head."""
    head, *body = rows
    lines = [head, ["---"] * len(head), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def kernel_table(rows: Sequence[Any]) -> str:
    """Table of the kernels of a step, for one target and shape."""
    lines = [
        ["kernel", "registers", "stack, B", "spills, B", "local memory, B", "occupancy", "instructions", "in loops"]
    ]
    for row in rows:
        built = row.built
        if (built.target, row.source.shape) != (TARGET, SHAPE):
            continue
        told = row.told()
        loops = [sum(loop["instructions"].values()) for loop in told["loops"]]
        numbers = (built.registers, built.stack, built.spills, built.shared + row.more_shared)
        share = f"{occupancy(built, row.items, row.more_shared):.0%}"
        inner = ", ".join(map(str, loops)) or "none"
        lines.append([f"`{built.kernel}`", *map(str, numbers), share, str(told["instructions"]), inner])
    return markdown(lines)


def pair_table(rows: Sequence[Any]) -> str:
    """Table of instructions per pair of the two blending kernels, by shape and target."""
    found = {(row.built.kernel, row.built.target, row.source.shape): row for row in rows if row.pair or row.unknown}
    targets = list(dict.fromkeys(target for _, target, _ in found))
    lines = [["kernel", "shape", *targets]]
    for kernel in ("blend", "blend_grad"):
        for shape in dict.fromkeys(shape for name, _, shape in found if name == kernel):
            cells = []
            for target in targets:
                row = found.get((kernel, target, shape))
                number = "unknown" if row is None or row.a_pair is None else f"{row.a_pair:.0f}"
                stack = row.built.stack + row.built.spills if row else 0
                cells.append(f"{number}, {stack} B" if stack else number)
            lines.append([f"`{kernel}`", shape, *cells])
    return markdown(lines)


def intel_table(built: Sequence[IntelBuilt]) -> str:
    """Table of items that run in step, and of stack memory, by shape and device."""
    found = {(each.kernel, each.device, each.source.items): each for each in built}
    shapes = sorted({items for _, _, items in found})
    lines = [["kernel", *(f"{INTEL[device]}, 1x{items}" for device in INTEL for items in shapes)]]
    for kernel in dict.fromkeys(kernel for kernel, _, _ in found):
        cells = []
        for device in INTEL:
            for items in shapes:
                each = found.get((kernel, device, items))
                stack = f", {each.stack} B" if each and each.stack else ""
                cells.append(f"{each.step}{stack}" if each else "")
        lines.append([f"`{kernel}`", *cells])
    return markdown(lines)


def parts_of(stages: Mapping[str, Stage]) -> dict[str, Stage]:
    """Milliseconds of the parts of a step. Raises ClsplatError for a stage that belongs to no part."""
    of_part = {stage: part for part, members in PARTS.items() for stage in members}
    if strange := [name for name in stages if name not in of_part]:
        raise ClsplatError(f"stages {', '.join(strange)}: of no part in PARTS of gpu_measured.py, expected one each")
    return {part: sum((stages[name] for name in members if name in stages), Stage()) for part, members in PARTS.items()}


def stage_table(predictions: Predictions, frame: str) -> str:
    """Table of the milliseconds of each part of a step: on `GPU`, and on `VKSPLAT_GPU` beside VkSplat's."""
    now, other = (list(parts_of(predictions[SHAPE, gpu, frame]).items()) for gpu in (GPU, VKSPLAT_GPU))
    lines = [["part", "launches", "issue, ms", "memory, ms", "chains, ms", "predicted, ms"]]
    lines[0] += [f"{VKSPLAT_GPU}: predicted, ms", "VkSplat there, ms"]
    theirs = [seconds / 30 for seconds in VKSPLAT]
    for each in (now, other):
        each.append(("all", sum((stage for _, stage in each), Stage())))
    for (name, stage), (_, there), seen in zip(now, other, [*theirs, sum(theirs)], strict=True):
        numbers = (f"{value:.2f}" for value in (stage.issue, stage.memory, stage.chain, stage.ms, there.ms, seen))
        lines.append([name, str(stage.launches), *numbers])
    return markdown(lines)


def goals(predictions: Predictions, frame: str, picture: str) -> str:
    """Text with the predicted times of a step and a picture beside the goals, and with LiteGS's step.

    frame, picture: names of the frames that are trained and drawn.
    """
    stages, drawn = (predictions[SHAPE, GPU, name] for name in (frame, picture))
    whole, shown = (sum(each.values(), Stage()).ms for each in (stages, drawn))
    beside = whole - stages["blend"].ms - stages["blend_grad"].ms
    told = (
        f"A step of the largest frame on an {GPU}: **{whole:.1f} ms** (wanted: at most {WANTED}). The picture of "
        f"1080p: **{1000 / shown:.0f} a second** (wanted: at least {FRAMES_WANTED}). LiteGS takes {LITEGS:.1f} ms a "
        "step there, mean of trainings that end at 1 M Gaussians; all but blending and its gradient takes "
        f"{beside:.1f} ms here."
    )
    return fill(told, LETTERS)


def device_table(predictions: Predictions, frames: Sequence[str], picture: str) -> str:
    """Table of milliseconds of a step on every GPU, and of pictures per second. The largest frame has all shapes, the
    others have one."""
    *smaller, largest = frames
    shapes = sorted({shape for shape, _, _ in predictions}, key=lambda shape: int(shape.partition("x")[2]))
    columns = [(SHAPE, frame) for frame in smaller] + [(shape, largest) for shape in shapes]
    lines = [["GPU", *(f"{frame}, {shape}" for shape, frame in columns), f"1080p a second, {SHAPE}"]]
    for gpu in GPUS:
        sums = [sum(predictions[shape, gpu.name, frame].values(), Stage()) for shape, frame in columns]
        drawn = sum(predictions[SHAPE, gpu.name, picture].values(), Stage())
        lines.append([gpu.name, *(f"{each.ms:.1f}" for each in sums), f"{1000 / drawn.ms:.0f}"])
    return markdown(lines)


def frame_table(frames: Sequence[Mapping[str, Any]]) -> str:
    """Table of the frames' counts."""
    counts = ("gaussians", "visible", "listed", "walked")
    lines = [["frame", "pixels", "Gaussians", "visible", "pairs listed", "pairs walked"]]
    lines[0] += ["list: mean, 99 %, longest", "blocks reached, taken", "halves reached"]
    for frame in frames:
        tiles = -(-frame["width"] // TILE) * -(-frame["height"] // TILE)
        lists = f"{frame['walked'] / tiles:.0f}, {frame['list_99']}, {frame['longest']}"
        blocks = (f"{frame['reached']:.2f}, {frame['taken']:.2f}", f"{frame['halves']:.2f}")
        size = f"{frame['width']}x{frame['height']}"
        numbers = [f"{frame[key]:,}" for key in counts]
        if frame.get("counted", frame["gaussians"]) != frame["gaussians"]:
            numbers[0] += f" (lists of {frame['counted']:,})"
        lines.append([frame["name"], size, *numbers, lists, *blocks])
    return markdown(lines)


def gpu_table(measured: Sequence[Measured]) -> str:
    """Table of the GPUs' data, and whether the model's constants were measured on each."""
    lines = [["GPU", "code for", "units", "instructions a cycle and unit", "GHz", "GB/s", "constants"]]
    held = {each.gpu for each in measured}
    for g in GPUS:
        how = "measured" if g in held else "assumed" if g.target.startswith("sm_") else "assumed, without chains"
        lines.append([g.name, g.target, str(g.units), str(g.issue), f"{g.ghz:g}", f"{g.gb:g}", how])
    return markdown(lines)


def constant_table(constants: Constants) -> str:
    """Table of the model's constants."""
    lines = [
        ["constant", "value", "from"],
        ["issue slots used where there is enough to do", f"{constants.efficiency:.0%}", "fit"],
        ["an access to global memory", f"{constants.access:.0f} ns", "fit"],
        ["an access to lines that the unit has just read", f"{NEAR} cycles", "H100, a chain of loads"],
        ["the host queues a launch", f"{constants.host * 1e3:.0f} µs", "fit"],
        ["a launch, at least", f"{LAUNCH * 1e3:.0f} µs", "H100, its shortest kernels"],
        ["memory, of the data sheet's bandwidth", f"{constants.copy:.0%}", "H100, copying"],
        ["groups started a cycle", f"{constants.groups:.2f}", "H100, empty groups"],
        ["an integer atomic in global memory", f"{constants.atomic * 1e3:.0f} ps", "H100, 3.4 M of them"],
        ["the next one on the same counter", f"{constants.counter:.0f} ns", "H100, 3.4 M on 1450 and 6700 counters"],
        ["lines looked up a cycle and unit", f"{LINES}", "assumed; `project` agrees"],
        ["passes through 32 banks of local memory, a cycle and unit", f"{PASSES}", "programming guides"],
    ]
    return markdown(lines)


def measured_table(measured: Sequence[Measured], constants: Constants, unused: Sequence[str]) -> str:
    """Table of measured and predicted times with their ratio, and text about the code and rows that are not used."""
    lines = [["stage", *(f"{each.gpu.name}, {each.frame}: measured, predicted, ratio" for each in measured)]]
    predicted = [each.predicted(constants) for each in measured]
    for name in (*PARTS, *WALLS):
        cells = []
        for each, found in zip(measured, predicted, strict=True):
            ms = each.ms.get(name)
            cells.append("" if ms is None else f"{ms:.3f}, {found[name]:.3f}, **{found[name] / ms:.2f}**")
        lines.append([name, *cells])
    told = f"Code: {' and '.join(sorted({each.code for each in measured}))}. "
    told += f"Not used: {'; '.join(unused)}." if unused else "Every row is used."
    return f"{markdown(lines)}\n\n{fill(told, LETTERS)}"


def now_table(measured: Sequence[Measured], constants: Constants) -> str:
    """Table of the predictions for the code that was measured, and for the present kernels, with their ratio."""
    held = [each for each in measured if each.now]
    lines = [["stage", *(f"{each.gpu.name}, {each.frame}: then, now, ratio" for each in held)]]
    pairs = [
        [milliseconds(works, each.gpu, constants, drawn) for works, drawn in ((each.works, ()), (each.now, each.drawn))]
        for each in held
    ]
    for name in (*PARTS, *WALLS):
        cells = []
        for each, (then, now) in zip(held, pairs, strict=True):
            of_both = f"{then[name]:.3f}, {now[name]:.3f}, **{now[name] / then[name]:.2f}**" if name in each.ms else ""
            cells.append(of_both)
        lines.append([name, *cells])
    return markdown(lines)


def wanted_table(measured: Sequence[Measured], constants: Constants, now: Works) -> str:
    """Table of the steps of WANTED_STEPS, predicted for the code that was measured and for the present kernels.

    It also has the model's error against the measurement, in the step and on average in its parts.
    """
    lines = [["step", "then, ms", "now, ms", "wanted, ms", "met", "error of fit: step, parts"]]
    for name, frame, most in WANTED_STEPS:
        (gpu,) = (each for each in GPUS if each.name == name)
        ms = milliseconds(now[gpu.name, frame], gpu, constants)[WALLS[1]]
        then, error = "not counted", "not measured"
        for each in measured:
            if (each.gpu.name, each.frame) == (name, frame) and WALLS[1] in each.ms:
                ratios = {part: found / each.ms[part] for part, found in each.predicted(constants).items()}
                of_parts = [math.log(ratio) ** 2 for part, ratio in ratios.items() if part not in WALLS]
                then = f"{each.predicted(constants)[WALLS[1]]:.2f}"
                error = f"{ratios[WALLS[1]] - 1:+.0%}, {math.sqrt(sum(of_parts) / max(len(of_parts), 1)):.0%}"
        lines.append([f"{name}, {frame}", then, f"{ms:.2f}", f"{most:.1f}", "yes" if ms <= most else "no", error])
    return markdown(lines)


def fill_in(page: str, tables: Mapping[str, str], name_of_page: str = PAGE.name) -> str:
    """The page's text with its tables replaced. Each table is between `<!-- NAME -->` and `<!-- end -->`. Raises
    ClsplatError if the page lacks these comments. name_of_page: for the message."""
    for name, text in tables.items():
        pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not pattern.search(page):
            raise ClsplatError(
                f"{name_of_page}: has no place for the table {name}, expected <!-- {name} --> and <!-- end -->"
            )
        page = pattern.sub(_between(text), page)
    return page


def _between(text: str) -> Callable[[re.Match[str]], str]:
    """A function for `re.sub` that puts the text between the two comments of a match."""
    return lambda match: f"{match[1]}{text}\n{match[2]}"


def trained_and_picture(frames: Sequence[Mapping[str, Any]]) -> tuple[list[Mapping[str, Any]], str]:
    """The frames that are trained, the largest last, and the name of the frame that is only rendered. Frames with
    `held_out` are not among them."""
    trained = [frame for frame in frames if not frame.get("picture") and not frame.get("held_out")]
    return trained, next(frame["name"] for frame in frames if frame.get("picture"))


def missed_goals(predictions: Predictions, frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """Descriptions of the goals that the predictions miss."""
    trained, picture = trained_and_picture(frames)
    largest = trained[-1]["name"]
    step, shown = (sum(predictions[SHAPE, GPU, name].values(), Stage()).ms for name in (largest, picture))
    found = []
    if step > WANTED:
        found.append(f"{largest}, {SHAPE}, {GPU}: {step:.1f} ms a step predicted, expected at most {WANTED}")
    if shown * FRAMES_WANTED > 1000:
        found.append(f"{picture}, {SHAPE}, {GPU}: {1000 / shown:.0f} a second, expected at least {FRAMES_WANTED}")
    return found


def tables_of(
    rows: Sequence[Any],
    predictions: Predictions,
    frames: Sequence[Mapping[str, Any]],
    compilers: str,
    fitted: Fit,
    intel: Sequence[IntelBuilt] = (),
) -> dict[str, str]:
    """The page's tables, keyed by name. fitted: from `gpu_static.counted`. intel: empty to omit Intel's table."""
    trained, picture = trained_and_picture(frames)
    names, largest = [frame["name"] for frame in trained], trained[-1]["name"]
    tables = {
        "compilers": compilers,
        "kernels": kernel_table(rows),
        "pairs": pair_table(rows),
        "frames": frame_table(frames),
        "stages": stage_table(predictions, largest),
        "goals": goals(predictions, largest, picture),
        "steps": device_table(predictions, names, picture),
        "devices": gpu_table(fitted[0]),
        "constants": constant_table(fitted[1]),
        "measured": measured_table(*fitted[:3]),
        "now": now_table(*fitted[:2]),
        "wanted": wanted_table(*fitted[:2], fitted[3]),
    }
    if intel:
        tables["intel"] = intel_table(intel)
    return tables


def stale_tables(page: str, tables: Mapping[str, str]) -> list[str]:
    """Names of tables that differ from the page's; none if other compilers made the page. Raises ClsplatError if the
    page has no place for a table."""
    stale = [name for name, text in tables.items() if fill_in(page, {name: text}) != page]
    return [] if "compilers" in stale else stale


def write_page(tables: Mapping[str, str], predictions: Predictions, frames: Sequence[Mapping[str, Any]]) -> None:
    """Write the tables into the page, and the plot beside it."""
    atomic_write(PAGE, fill_in(PAGE.read_text("utf-8"), tables).encode())
    largest = trained_and_picture(frames)[0][-1]["name"]
    bars = {
        gpu.name: {part: stage.ms for part, stage in parts_of(predictions[SHAPE, gpu.name, largest]).items()}
        for gpu in GPUS
    }
    plot_stacks(PLOT, bars, f"A training step, {largest}, {SHAPE}: predicted", "ms")

# SPDX-License-Identifier: Apache-2.0
"""The tables and the plot of docs/gpu-static.md, from the rows and predictions of `gpu_static.py`."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from gpu_devices import GPUS, Gpu, occupancy
from gpu_intel import INTEL, IntelBuilt
from gpu_model import Stage
from plotting import plot_stacks

from clsplat.errors import ClsplatError
from clsplat.files.atomic import atomic_write
from clsplat.gaussians import floats_of

ROOT = Path(__file__).resolve().parents[2]
PAGE, PLOT = ROOT / "docs/gpu-static.md", ROOT / "docs/images/gpu-static.svg"
SHAPE, TARGET, GPU = "1x64", "sm_89", "RTX 4090"
"""Shape, target and GPU of the tables that show only one."""
LETTERS = 128
"""Length of a line of text."""
PARTS = {
    "project": ("project",),
    "lists and sorts": ("duplicate", "ranges"),
    "blend": ("blend",),
    "loss": ("target", "loss"),
    "blend_grad": ("blend_grad",),
    "project_grad, Adam": ("project_grad", "adam"),
    "statistics": ("statistics",),
}
"""Parts of a step, each a row of the table and a part of the plot's bars, with the names of their stages."""
VKSPLAT, VKSPLAT_GPU = (19, 25, 25, 32, 130, 131, 5), "RTX 3090"
"""Seconds of these parts in VkSplat's trainings of 30,000 steps: means of seven scenes, from its project's page."""
WANTED, FRAMES_WANTED, LITEGS = 12, 200, 4.0
"""Maximum milliseconds of a step, and minimum pictures per second; milliseconds of a step of LiteGS."""

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
    """Table of items in step, and of stack memory, by shape and device."""
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
        raise ClsplatError(f"stages {', '.join(strange)}: of no part in PARTS of gpu_page.py")
    return {part: sum((stages[name] for name in members if name in stages), Stage()) for part, members in PARTS.items()}


def _gpu(name: str) -> Gpu:
    return next(gpu for gpu in GPUS if gpu.name == name)


def stage_table(predictions: Predictions, frame: str) -> str:
    """Table of the milliseconds of each part of a step on one GPU, beside those of other programs."""
    now, other = (list(parts_of(predictions[SHAPE, gpu, frame]).items()) for gpu in (GPU, VKSPLAT_GPU))
    lines = [["part", "launches", "issue, ms", "memory, ms", "sum, ms", f"{VKSPLAT_GPU}: sum, ms", "VkSplat there, ms"]]
    theirs = [seconds / 30 for seconds in VKSPLAT]
    for each in (now, other):
        each.append(("all", sum((stage for _, stage in each), Stage())))
    for (name, stage), (_, there), seen in zip(now, other, [*theirs, sum(theirs)], strict=True):
        numbers = (f"{value:.2f}" for value in (stage.issue, stage.memory, stage.both, there.both, seen))
        lines.append([name, str(stage.launches), *numbers])
    return markdown(lines)


def goals(rows: Sequence[Any], predictions: Predictions, frame: Mapping[str, Any], picture: str) -> str:
    """A sentence each about a step and a picture, and about a step as fast as that of LiteGS."""
    gpu = _gpu(GPU)
    stages, drawn = (predictions[SHAPE, GPU, name] for name in (frame["name"], picture))
    whole, shown = (sum(each.values(), Stage()) for each in (stages, drawn))
    shown_rows = [row for row in rows if (row.built.target, row.source.shape) == (TARGET, SHAPE)]
    pair = sum({row.built.kernel: row.a_pair for row in shown_rows if row.a_pair}.values())
    hidden = frame["gaussians"] - frame["visible"]
    saved = hidden * 4 * 6 * floats_of((frame["sh_degree"] + 1) ** 2) / gpu.gb * 1e-6
    beside = [stage for name, stage in stages.items() if name not in ("blend", "blend_grad")]
    left = LITEGS - sum(max(stage.issue, stage.memory) for stage in beside) + saved
    instructions = max(left, 0) * gpu.issued / frame["walked"]
    return "\n\n".join(
        (
            fill(
                f"A step of the largest frame on an {GPU}: **{whole.both:.1f} ms** (wanted: at most {WANTED}), as if "
                f"nothing hid behind anything. The picture of 1080p: **{1000 / shown.both:.0f} a second** (wanted: at "
                f"least {FRAMES_WANTED}).",
                LETTERS,
            ),
            fill(
                f"LiteGS takes {LITEGS:.1f} ms a step there, mean of trainings that end at 1 M Gaussians. For as much "
                "of this frame, memory and instructions would have to hide each other in each stage, rows of Gaussians "
                f"that are not visible to stay as they are ({saved:.1f} ms), and blending with its gradient to take "
                f"{left:.1f} ms: {instructions:.0f} instructions of a warp for a pair in place of {pair:.0f}.",
                LETTERS,
            ),
        )
    )


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
        cells = (f"{each.issue:.1f} + {each.memory:.1f}" for each in sums)
        lines.append([gpu.name, *cells, f"{1000 / drawn.both:.0f}"])
    return markdown(lines)


def frame_table(frames: Sequence[Mapping[str, Any]]) -> str:
    """Table of the frames' counts."""
    lines = [["frame", "pixels", "Gaussians", "visible", "pairs listed", "pairs walked"]]
    for frame in frames:
        size = f"{frame['width']}x{frame['height']}"
        lines.append(
            [frame["name"], size, *(f"{frame[key]:,}" for key in ("gaussians", "visible", "listed", "walked"))]
        )
    return markdown(lines)


def gpu_table() -> str:
    """Table of the devices' data."""
    lines = [["GPU", "code for", "units", "instructions a cycle and unit", "GHz", "GB/s"]]
    lines += [[g.name, g.target, str(g.units), str(g.issue), f"{g.ghz:g}", f"{g.gb:g}"] for g in GPUS]
    return markdown(lines)


def fill_in(page: str, tables: Mapping[str, str]) -> str:
    """The page with its tables replaced. Each is between `<!-- NAME -->` and `<!-- end -->`. Raises ClsplatError if the
    page lacks these comments."""
    for name, text in tables.items():
        pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not pattern.search(page):
            raise ClsplatError(
                f"{PAGE.name}: has no place for the table {name}, expected <!-- {name} --> and <!-- end -->"
            )
        page = pattern.sub(_between(text), page)
    return page


def _between(text: str) -> Callable[[re.Match[str]], str]:
    """Replace a table, and keep the text around it."""
    return lambda match: f"{match[1]}{text}\n{match[2]}"


def trained_and_picture(frames: Sequence[Mapping[str, Any]]) -> tuple[list[Mapping[str, Any]], str]:
    """The frames that are trained, the largest last, and the name of the frame that is only rendered."""
    trained = [frame for frame in frames if not frame.get("picture")]
    return trained, next(frame["name"] for frame in frames if frame.get("picture"))


def missed_goals(predictions: Predictions, frames: Sequence[Mapping[str, Any]]) -> list[str]:
    """Descriptions of the goals that the predictions miss."""
    trained, picture = trained_and_picture(frames)
    largest = trained[-1]["name"]
    step, shown = (sum(predictions[SHAPE, GPU, name].values(), Stage()).both for name in (largest, picture))
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
    intel: Sequence[IntelBuilt] = (),
) -> dict[str, str]:
    """The page's tables, keyed by name. compilers: their versions. intel: empty to omit Intel's table."""
    trained, picture = trained_and_picture(frames)
    names, largest = [frame["name"] for frame in trained], trained[-1]["name"]
    tables = {
        "compilers": compilers,
        "kernels": kernel_table(rows),
        "pairs": pair_table(rows),
        "frames": frame_table(frames),
        "stages": stage_table(predictions, largest),
        "goals": goals(rows, predictions, trained[-1], picture),
        "steps": device_table(predictions, names, picture),
        "devices": gpu_table(),
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
        gpu.name: {part: stage.both for part, stage in parts_of(predictions[SHAPE, gpu.name, largest]).items()}
        for gpu in GPUS
    }
    plot_stacks(PLOT, bars, f"A training step, {largest}, {SHAPE}: predicted", "ms: issue and memory added up")

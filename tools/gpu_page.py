# SPDX-License-Identifier: Apache-2.0
"""The tables and the plot of docs/gpu-static.md, from the rows and predictions of `gpu_static.py`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gpu_devices import GPUS, occupancy
from gpu_intel import INTEL, IntelBuilt
from gpu_model import Stage
from plotting import plot_stacks

from clsplat.errors import ClsplatError
from clsplat.files import atomic_write

ROOT = Path(__file__).resolve().parents[1]
PAGE, PLOT = ROOT / "docs/gpu-static.md", ROOT / "docs/images/gpu-static.svg"
SHAPE, TARGET, GPU = "1x64", "sm_89", "RTX 4090"
"""Of the tables that show one of each."""
PARTS = {
    "blend": ("blend",),
    "blend_grad": ("blend_grad",),
    "lists and sorts": ("duplicate", "ranges"),
    "loss": ("loss",),
    "project_grad, Adam": ("project_grad", "adam"),
    "other": (),
}
"""Bars of the plot: stages by name; `other` has the rest."""

Predictions = Mapping[tuple[str, str, str], Mapping[str, Stage]]
"""Stages of a step by shape, GPU and frame."""


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; the first row is its head."""
    head, *body = rows
    lines = [head, ["---"] * len(head), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def kernel_table(rows: Sequence[Any]) -> str:
    """Each kernel of a step, for one target and shape."""
    lines = [
        ["kernel", "registers", "stack, B", "spills, B", "local memory, B", "occupancy", "instructions", "in loops"]
    ]
    for row in rows:
        built = row.built
        if (built.target, f"1x{row.source.items}") != (TARGET, SHAPE):
            continue
        told = row.told()
        loops = [sum(loop["instructions"].values()) for loop in told["loops"]]
        numbers = (built.registers, built.stack, built.spills, built.shared + row.more_shared)
        share = f"{occupancy(built, row.items, row.more_shared):.0%}"
        inner = ", ".join(map(str, loops)) or "none"
        lines.append([f"`{built.kernel}`", *map(str, numbers), share, str(told["instructions"]), inner])
    return markdown(lines)


def pair_table(rows: Sequence[Any]) -> str:
    """Instructions a pair, by shape and target, of the two kernels."""
    found = {(row.built.kernel, row.built.target, row.source.items): row for row in rows if row.pair or row.unknown}
    targets = list(dict.fromkeys(target for _, target, _ in found))
    lines = [["kernel", "shape", *targets]]
    for kernel in ("blend", "blend_grad"):
        for items in sorted({items for _, _, items in found}):
            cells = []
            for target in targets:
                row = found.get((kernel, target, items))
                number = "unknown" if row is None or row.a_pair is None else f"{row.a_pair:.0f}"
                stack = row.built.stack + row.built.spills if row else 0
                cells.append(f"{number}, {stack} B" if stack else number)
            lines.append([f"`{kernel}`", f"1x{items}", *cells])
    return markdown(lines)


def intel_table(built: Sequence[IntelBuilt]) -> str:
    """Items in step, and stack, by shape and device."""
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


def stage_table(predictions: Predictions, frame: str) -> str:
    """Milliseconds of each stage on one GPU."""
    stages = predictions[SHAPE, GPU, frame]
    lines = [["stage", "launches", "issue, ms", "memory, ms", "sum, ms"]]
    for name, stage in [*stages.items(), ("all", sum(stages.values(), Stage()))]:
        numbers = (f"{value:.2f}" for value in (stage.issue, stage.memory, stage.both))
        lines.append([name, str(stage.launches), *numbers])
    return markdown(lines)


def device_table(predictions: Predictions, frames: Sequence[str]) -> str:
    """Milliseconds of a step on every GPU: of the largest frame in every shape, of the others in one."""
    *smaller, largest = frames
    shapes = sorted({shape for shape, _, _ in predictions}, key=lambda shape: int(shape.partition("x")[2]))
    columns = [(SHAPE, frame) for frame in smaller] + [(shape, largest) for shape in shapes]
    lines = [["GPU", *(f"{frame}, {shape}" for shape, frame in columns)]]
    for gpu in GPUS:
        sums = [sum(predictions[shape, gpu.name, frame].values(), Stage()) for shape, frame in columns]
        lines.append([gpu.name, *(f"{each.issue:.1f} + {each.memory:.1f}" for each in sums)])
    return markdown(lines)


def frame_table(frames: Sequence[Mapping[str, Any]]) -> str:
    """The frames' counts."""
    lines = [["frame", "pixels", "Gaussians", "visible", "pairs listed", "pairs walked"]]
    for frame in frames:
        size = f"{frame['width']}x{frame['height']}"
        lines.append(
            [frame["name"], size, *(f"{frame[key]:,}" for key in ("gaussians", "visible", "listed", "walked"))]
        )
    return markdown(lines)


def gpu_table() -> str:
    """The devices' figures."""
    lines = [["GPU", "code for", "units", "instructions a cycle and unit", "GHz", "GB/s"]]
    lines += [[g.name, g.target, str(g.units), str(g.issue), f"{g.ghz:g}", f"{g.gb:g}"] for g in GPUS]
    return markdown(lines)


def fill_in(page: str, tables: Mapping[str, str]) -> str:
    """The page with its tables replaced: each stands between `<!-- NAME -->` and `<!-- end -->`. Raises ClsplatError
    where the page has no such place."""
    for name, text in tables.items():
        pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
        if not pattern.search(page):
            raise ClsplatError(
                f"{PAGE.name}: has no place for the table {name}, expected <!-- {name} --> and <!-- end -->"
            )
        page = pattern.sub(lambda match, text=text: f"{match[1]}{text}\n{match[2]}", page)
    return page


def write_page(
    rows: Sequence[Any], intel: Sequence[IntelBuilt], predictions: Predictions, frames: Sequence[Mapping[str, Any]]
) -> None:
    """Write the tables into the page, and the plot beside it. intel: empty leaves Intel's table as it is."""
    names = [frame["name"] for frame in frames]
    largest = names[-1]
    tables = {
        "kernels": kernel_table(rows),
        "pairs": pair_table(rows),
        "frames": frame_table(frames),
        "stages": stage_table(predictions, largest),
        "steps": device_table(predictions, names),
        "devices": gpu_table(),
    }
    if intel:
        tables["intel"] = intel_table(intel)
    atomic_write(PAGE, fill_in(PAGE.read_text("utf-8"), tables).encode())
    bars = {gpu.name: _parts(predictions[SHAPE, gpu.name, largest]) for gpu in GPUS}
    plot_stacks(PLOT, bars, f"A training step, {largest}, {SHAPE}: predicted", "ms: issue and memory added up")


def _parts(stages: Mapping[str, Stage]) -> dict[str, float]:
    known = {stage: part for part, members in PARTS.items() for stage in members}
    sums = dict.fromkeys(PARTS, 0.0)
    for name, stage in stages.items():
        sums[known.get(name, "other")] += stage.both
    return sums

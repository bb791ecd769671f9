# SPDX-License-Identifier: Apache-2.0
"""Plots of time against quality, by matplotlib, the optional extra `plot`. SVG or PNG by the file's name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from clsplat.errors import InputError
from clsplat.files import atomic_writer

EXTENSIONS = (".svg", ".png")
SAME_BITS = 1e-8
"""Where a difference of zero is drawn, on an axis that has none."""


def check_plot(path: Path) -> None:
    """Raise InputError where a plot cannot be written to `path`: call it before the work whose result is plotted."""
    if path.suffix.lower() not in EXTENSIONS:
        raise InputError(f"{path}: has the extension {path.suffix or 'none'!r}, expected .svg or .png")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder, expected one for the plot")
    try:
        import_module("matplotlib")
    except ImportError as error:
        message = f"{path}: matplotlib is needed for a plot ({error}), install it with: pip install 'clsplat[plot]'"
        raise InputError(message) from None


def plot_settings(path: Path, result: Mapping[str, Any], title: str) -> None:
    """What `clsplat.bench.settings.compare` found: milliseconds a frame against PSNR and against the largest
    difference."""
    points = result["points"]
    figure = _figure(title, 2)
    upper, lower = figure.axes
    same = [point["max_abs"] == 0 for point in points]
    numbers = range(1, len(points) + 1)
    for axes, key in ((upper, "psnr"), (lower, "max_abs")):
        values = [max(point[key], SAME_BITS) if key == "max_abs" else point[key] for point in points]
        best = sorted(
            (point["frame_ms"], value) for point, value in zip(points, values, strict=True) if point["on_front"]
        )
        axes.plot(*zip(*best, strict=True), color="tab:red", linewidth=1, label="Pareto front, by PSNR")
        for number, point, value, equal in zip(numbers, points, values, same, strict=True):
            colour = "tab:red" if point["on_front"] else "tab:blue"
            axes.plot(point["frame_ms"], value, marker="o" if equal else "s", color=colour, linestyle="none")
            axes.annotate(str(number), (point["frame_ms"], value), (4, 4), textcoords="offset points", fontsize=8)
        axes.set_xlabel("ms a frame, median")
        axes.grid(alpha=0.3)
    upper.set_ylabel("PSNR, dB (equal frames: 160)")
    lower.set_ylabel("largest absolute difference")
    lower.set_yscale("log")
    if any(same):
        lower.axhline(SAME_BITS, color="gray", linewidth=0.8, linestyle=":")
        lower.text(0.99, SAME_BITS, "0: the same bits", transform=lower.get_yaxis_transform(), ha="right", va="top")
    lines = [f"{number}  {point['name']}" for number, point in zip(numbers, points, strict=True)]
    figure.text(0.7, 0.88, "\n".join(lines), va="top", fontsize=8)
    x, y, width, height = result["crop"]
    known = result["exact_against_float64"]
    measured = f"PSNR {known['psnr']:.1f} dB, largest difference {known['max_abs']:.2g}"
    note = (
        f"Error against {result['error_is_against']}. "
        f"The exact preset against the float64 reference on {width}x{height} pixels at ({x}, {y}): {measured}."
    )
    figure.text(0.01, 0.01, note, fontsize=8)
    upper.legend(fontsize=8)
    figure.subplots_adjust(left=0.07, right=0.68, bottom=0.15, wspace=0.28)
    _save(figure, path)


def plot_training(path: Path, runs: Mapping[str, Sequence[tuple[float, float]]], title: str) -> None:
    """Of each run by name (seconds of training, held-out PSNR in dB)."""
    figure = _figure(title, 1)
    (axes,) = figure.axes
    for name, points in runs.items():
        axes.plot(*zip(*sorted(points), strict=True), marker="o", markersize=4, label=name)
    axes.set_xlabel("seconds of training")
    axes.set_ylabel("PSNR of the held-out views, dB")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    _save(figure, path)


Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Panel:
    """A pair of logarithmic axes, what they show, and by name what was measured and what was fitted to it."""

    x: str
    y: str
    measured: Mapping[str, Points]
    fitted: Mapping[str, Points] = field(default_factory=dict)


def plot_growth(path: Path, panels: Sequence[Panel], title: str) -> None:
    """How a time grows with a size: panels side by side."""
    figure = _figure(title, len(panels))
    for axes, panel in zip(figure.axes, panels, strict=True):
        for name, points in panel.measured.items():
            axes.plot(*zip(*points, strict=True), marker="o", markersize=4, label=name)
        for name, points in panel.fitted.items():
            axes.plot(*zip(*points, strict=True), color="gray", linewidth=0.8, linestyle="--", label=name)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel(panel.x)
        axes.set_ylabel(panel.y)
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    figure.subplots_adjust(wspace=0.28)
    _save(figure, path)


def plot_grid(path: Path, panels: Sequence[Panel], title: str, columns: int = 3) -> None:
    """Panels in rows with one scale of y, their lines without markers, one legend for all."""
    rows = -(-len(panels) // columns)
    figure = import_module("matplotlib.figure").Figure(figsize=(4.4 * columns, 2.9 * rows + 0.8), layout="constrained")
    figure.suptitle(title, fontsize=9)
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True).flat
    for axes, panel in zip(grid, panels, strict=False):
        for name, points in panel.measured.items():
            if points:
                axes.plot(*zip(*points, strict=True), linewidth=1.2, label=name)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel(panel.x, fontsize=8)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
    for axes in list(grid):
        axes.set_visible(False)
    first = figure.axes[0]
    figure.legend(*first.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    _save(figure, path)


def _figure(title: str, columns: int) -> Any:
    figure = import_module("matplotlib.figure").Figure(figsize=(6 + 4 * (columns - 1) + 2 * (columns > 1), 5))
    figure.subplots(1, columns)
    figure.suptitle(title, fontsize=10)
    return figure


def _save(figure: Any, path: Path) -> None:
    """Without the date and random names that matplotlib puts in an SVG, so that equal plots are equal files."""
    with import_module("matplotlib").rc_context({"svg.hashsalt": "clsplat"}):
        kind = path.suffix.lower()[1:]
        with atomic_writer(path) as file:
            figure.savefig(file, format=kind, dpi=150, metadata={"Date": None} if kind == "svg" else None)

# SPDX-License-Identifier: Apache-2.0
"""Plots of the tools: growth, errors, parts of a step. Like those of `bench`, they are legible 800 pixels wide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from textwrap import wrap
from typing import Any

from clsplat.bench.plots import (
    CHARACTERS_PER_LINE,
    FIGURE_WIDTH_INCHES,
    FONT_SIZE_POINTS,
    OKABE_ITO_COLOURS,
    PLOT_BLACK,
    PLOT_BLUE,
    PLOT_VERMILION,
    save_figure,
)

MARKERS = "os^DvP*X"
DASHES = ("-", "--", "-.", ":")
COLUMNS = 2
"""Number of panels in a row: three would be too narrow for their labels."""
NARROW = 44
"""Number of letters that fit under a panel."""

Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Panel:
    """A pair of logarithmic axes: their labels, and measured and fitted points keyed by name."""

    x: str
    y: str
    measured: Mapping[str, Points]
    fitted: Mapping[str, Points] = field(default_factory=dict)


def plot_growth(path: Path, panels: Sequence[Panel], title: str) -> None:
    """Plot how times grow with sizes, in panels side by side."""
    figure = _figure(4.4, title)
    alike = len({(*panel.measured, *panel.fitted) for panel in panels}) == 1
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False).flat, panels, strict=True):
        for number, (name, points) in enumerate(panel.measured.items()):
            axes.plot(*zip(*points, strict=True), **_style(number), markersize=6, label=name)
        for name, points in panel.fitted.items():
            axes.plot(*zip(*points, strict=True), color=PLOT_VERMILION, linewidth=1.2, linestyle="--", label=name)
        _logarithmic(axes)
        axes.set_xlabel(panel.x, fontsize=FONT_SIZE_POINTS)
        axes.set_ylabel(panel.y, fontsize=FONT_SIZE_POINTS)
        axes.grid(alpha=0.3)
        if not alike:
            place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0, 1), "borderaxespad": 0.2}
            axes.legend(fontsize=FONT_SIZE_POINTS, frameon=False, **place)
    if alike:
        _legend_below(figure, figure.axes[0], columns=4)
    save_figure(figure, path)


def plot_grid(path: Path, panels: Sequence[Panel], title: str, columns: int = COLUMNS) -> None:
    """Plot panels in rows with one scale of y, and one legend below all of them."""
    rows = -(-len(panels) // columns)
    figure = _figure(2.1 * rows + 1.0, title)
    grid = list(figure.subplots(rows, columns, squeeze=False, sharey=True).flat)
    for axes, panel in zip(grid, panels, strict=False):
        for (name, points), colour, dash in zip(
            panel.measured.items(), (PLOT_BLUE, PLOT_VERMILION, PLOT_BLACK), DASHES, strict=False
        ):
            if points:
                axes.plot(*zip(*points, strict=True), color=colour, linestyle=dash, linewidth=1.6, label=name)
        _logarithmic(axes)
        head, _, unit = panel.x.partition(": ")
        axes.set_title(head, fontsize=FONT_SIZE_POINTS, loc="left", weight="bold")
        axes.set_xlabel("\n".join(wrap(unit or panel.x, NARROW)), fontsize=FONT_SIZE_POINTS)
        axes.grid(alpha=0.3)
    for axes in grid[::columns]:
        axes.set_ylabel(panels[0].y, fontsize=FONT_SIZE_POINTS)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    _legend_below(figure, grid[0], columns=3)
    save_figure(figure, path)


def plot_stacks(path: Path, bars: Mapping[str, Mapping[str, float]], title: str, x: str) -> None:
    """Plot a horizontal bar for each name: its parts end to end, then the sum as text."""
    figure = _figure(0.42 * len(bars) + 1.6, title)
    axes = figure.subplots()
    names = list(bars)
    ends = [0.0] * len(names)
    for number, part in enumerate(next(iter(bars.values()))):
        widths = [bars[name][part] for name in names]
        colour = OKABE_ITO_COLOURS[number % len(OKABE_ITO_COLOURS)]
        axes.barh(names, widths, left=ends, color=colour, edgecolor="white", label=part)
        ends = [end + width for end, width in zip(ends, widths, strict=True)]
    for place, end in enumerate(ends):
        axes.text(end, place, f" {end:.1f}", va="center", fontsize=FONT_SIZE_POINTS)
    axes.set_xlim(0, 1.1 * max(ends))
    axes.invert_yaxis()
    axes.set_axisbelow(True)
    axes.set_xlabel(x, fontsize=FONT_SIZE_POINTS)
    axes.tick_params(labelsize=FONT_SIZE_POINTS)
    axes.grid(axis="x", alpha=0.3)
    _legend_below(figure, axes, columns=3)
    save_figure(figure, path)


def _figure(height: float, title: str) -> Any:
    figure = import_module("matplotlib.figure").Figure((FIGURE_WIDTH_INCHES, height), layout="constrained")
    figure.suptitle("\n".join(wrap(title, CHARACTERS_PER_LINE)), fontsize=FONT_SIZE_POINTS)
    return figure


def _style(number: int) -> dict[str, Any]:
    """Colour, marker and dashes of a line. Neighbouring lines differ in all three."""
    kinds = {"color": OKABE_ITO_COLOURS, "marker": MARKERS, "linestyle": DASHES}
    return {name: values[number % len(values)] for name, values in kinds.items()}


def _logarithmic(axes: Any) -> None:
    """Style both axes. Ticks are plain numbers if an axis spans few decades."""
    ticker = import_module("matplotlib.ticker")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.tick_params(labelsize=FONT_SIZE_POINTS)
    for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        axis.set_minor_formatter(ticker.NullFormatter())
        if high / low < 1e4 and low > 1e-3 and high < 2e4:
            axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5) if high / low < 100 else (1, 3)))


def _legend_below(figure: Any, axes: Any, columns: int) -> None:
    """Add a legend below all axes, where it covers no points."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=min(columns, len(labels)), fontsize=FONT_SIZE_POINTS
    )

# SPDX-License-Identifier: Apache-2.0
"""The two plots of `clsplat bench --plot`, by matplotlib, the optional extra `plot`. SVG or PNG by the file's name.

Each is legible at 800 pixels of width: fonts of 10 points and more on 8 inches. The colours are those of Okabe and Ito,
which colour-blind people tell apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from clsplat.bench.labels import place_labels
from clsplat.bench.settings import ALL_OFF, PSNR_MAX, front
from clsplat.errors import InputError
from clsplat.files import atomic_writer

EXTENSIONS = (".svg", ".png")
WIDTH, DPI = 8.0, 100
"""Inches, and pixels an inch of the layout."""
SIZE = 10
"""Of text, in points."""
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000", "#666666")
BLUE, ORANGE, _, VERMILION, _, _, BLACK, GREY = COLOURS
LETTERS = 92
"""Of a line over the whole width."""
ABOVE = {"loc": "lower right", "bbox_to_anchor": (1, 1), "ncols": 3, "frameon": False, "fontsize": SIZE}
"""Place of a legend over the axes, where it covers no point."""
PAD = 2.0
"""Pixels around a label."""

Point = tuple[float, float]


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


def plot_files(path: Path) -> tuple[Path, Path]:
    """The files that `plot_settings` writes beside `path`: of the exact switches, and of the approximate settings."""
    switches, error = (path.with_name(f"{path.stem}-{kind}{path.suffix}") for kind in ("switches", "error"))
    return switches, error


def plot_settings(path: Path, result: Mapping[str, Any], title: str) -> tuple[Path, Path]:
    """Draw what `clsplat.bench.settings.compare` measured into `plot_files(path)`, which are returned."""
    files = plot_files(path)
    for file, draw in zip(files, (_draw_switches, _draw_error), strict=True):
        save_figure(draw(result, title), file)
    return files


def _draw_switches(result: Mapping[str, Any], title: str) -> Any:
    """Bars of the time without each exact switch over the time with all of them, of a frame and of a step."""
    exact = _exact_point(result)
    rows = []
    if exact is not None:
        for point in result["points"]:
            if not point["approximate"] and point["name"] not in (exact["name"], ALL_OFF):
                ratios = [point[key] / exact[key] for key in ("frame_ms", "iteration_ms")]
                rows.append((ratios, point["name"]))
    rows.sort(key=lambda row: row[0][0])
    notes = ["Time without the switch over the time of exact, which has all of them. 1.00: no difference."]
    if (faster := result["exact_switches_faster"]) is not None:
        notes.append(f"All off: {faster['frame']:.2f} times for a frame, {faster['iteration']:.2f} times for a step.")
    inches = max(0.42 * len(rows) + 0.2, 1.0)
    figure, axes = _sheet(["What each exact switch is worth", title], notes, inches)
    for index, (key, colour) in enumerate((("a frame", BLUE), ("a training step", ORANGE))):
        values = [ratios[index] for ratios, _ in rows]
        places = [row + 0.2 - 0.4 * index for row in range(len(rows))]
        axes.barh(places, [value - 1 for value in values], 0.38, left=1, color=colour, label=key)
        for place, value in zip(places, values, strict=True):
            text = f"{value:.2f}"
            axes.annotate(text, (max(value, 1), place), (4, 0), textcoords="offset points", va="center", fontsize=SIZE)
    axes.axvline(1, color=BLACK, linewidth=1)
    axes.set_yticks(range(len(rows)), [name for _, name in rows], fontsize=SIZE)
    axes.set_ylim(-0.6, len(rows) - 0.4)
    ratios = [value for both, _ in rows for value in both]
    low, high = min([1.0, *ratios]), max([1.05, *ratios])
    axes.set_xlim(low - 0.02 * (high - low), high + 0.12 * (high - low))
    axes.set_xlabel("times as long without it", fontsize=SIZE)
    axes.grid(alpha=0.3, axis="x")
    if rows:
        axes.legend(**ABOVE)
    else:
        axes.text(0.5, 0.5, "no exact switch was measured", transform=axes.transAxes, ha="center", fontsize=SIZE)
    return figure


def _draw_error(result: Mapping[str, Any], title: str) -> Any:
    """Time a frame against PSNR of the approximate settings, with the exact preset as the reference."""
    exact = _exact_point(result)
    tried = [point for point in result["points"] if point["approximate"]]
    drawn = [point for point in tried if point["against_exact"]["max_abs"] > 0]
    same = [f"{point['name']} ({point['frame_ms']:.1f} ms)" for point in tried if point not in drawn]
    _, _, width, height = result["crop"]
    known = result["exact_against_float64"]
    reference = f"The exact preset against the float64 reference, {width}x{height} pixels in the middle"
    notes = [
        f"Error against {result['error_is_against']}; in brackets the largest absolute error.",
        f"{reference}: {known['psnr']:.1f} dB, largest error {known['max_abs']:.2g}.",
    ]
    if same:
        notes.append(f"Approximate, but the same bits as exact here: {', '.join(same)}.")
    figure, axes = _sheet(["Time against error of the approximate settings", title], notes, 5.0)
    axes.set_xlabel("ms a frame, median", fontsize=SIZE)
    axes.set_ylabel("PSNR, dB", fontsize=SIZE)
    axes.grid(alpha=0.3)
    if not drawn:
        axes.text(0.5, 0.5, "no approximate setting differs", transform=axes.transAxes, ha="center", fontsize=SIZE)
        return figure
    rivals = [*drawn, *([exact] if exact is not None else [])]
    best = front([(point["frame_ms"], point["psnr"]) for point in rivals])
    kinds = ((True, VERMILION, "on the Pareto front with exact"), (False, "white", "behind it"))
    for on, colour, label in kinds:
        chosen = [point for point, is_best in zip(drawn, best, strict=False) if is_best == on]
        x, y = ([point[key] for point in chosen] for key in ("frame_ms", "psnr"))
        style = {"markerfacecolor": colour, "markeredgecolor": VERMILION if on else BLUE, "markeredgewidth": 1.6}
        axes.plot(x, y, marker="o", markersize=7, linestyle="none", label=label, zorder=3, **style)
    axes.set_xlim(_around([point["frame_ms"] for point in rivals], 0.3))  # labels have room on the left, too
    axes.set_ylim(_around([point["psnr"] for point in drawn], 0.1))
    top = axes.get_ylim()[1]
    edges = [(point["frame_ms"], point["psnr"]) for point, is_best in zip(rivals, best, strict=True) if is_best]
    steps = _steps([(ms, min(psnr, top) if psnr >= PSNR_MAX else psnr) for ms, psnr in sorted(edges)])
    axes.plot(*zip(*steps, strict=True), color=VERMILION, linewidth=1.5, zorder=2)
    lines = list(pairwise(steps))
    if exact is not None:
        ms = exact["frame_ms"]
        axes.axvline(ms, color=GREY, linewidth=1.2, linestyle="--", zorder=1, label=f"exact: {ms:.1f} ms")
        lines.append(((ms, axes.get_ylim()[0]), (ms, top)))
    texts = [f"{point['name']} ({point['max_abs']:.2g})" for point in drawn]
    axes.legend(**ABOVE)
    figure.draw_without_rendering()  # the axes have their place now
    _label_points(figure, axes, [(point["frame_ms"], point["psnr"]) for point in drawn], texts, lines)
    return figure


def _exact_point(result: Mapping[str, Any]) -> Mapping[str, Any] | None:
    return next((point for point in result["points"] if point["name"] == result["exact"]), None)


def _around(values: Sequence[float], below: float) -> tuple[float, float]:
    """Limits of an axis: the values, a tenth of their span above them and the share `below` under them."""
    span = max(values) - min(values) or 1.0
    return min(values) - below * span, max(values) + 0.1 * span


def _steps(corners: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The best quality that each cost buys: level up to the next cost, then up."""
    path = list(corners[:1])
    for (_, quality), (cost, better) in pairwise(corners):
        path += [(cost, quality), (cost, better)]
    return path


def _label_points(
    figure: Any, axes: Any, points: Sequence[Point], texts: Sequence[str], lines: Sequence[tuple[Point, Point]]
) -> None:
    """Write a text beside each point, with a leader line where it lies apart; `lines` are better not crossed. The axes
    must have their place and limits."""
    to_pixels, to_figure = axes.transData.transform, figure.transFigure.inverted().transform
    bounds = axes.get_window_extent()
    frame = np.array([bounds.x0 + PAD, bounds.y0 + PAD, bounds.x1 - PAD, bounds.y1 - PAD])
    artists = [figure.text(0, 0, text, fontsize=SIZE) for text in texts]
    sizes = np.array([artist.get_window_extent().size for artist in artists]) + 2 * PAD
    segments = to_pixels(np.reshape(lines, (-1, 2))).reshape(-1, 2, 2)
    line = import_module("matplotlib.lines").Line2D
    for artist, place in zip(artists, place_labels(to_pixels(points), sizes, frame, segments), strict=True):
        artist.set(position=to_figure(place.box[:2] + PAD), ha="left", va="bottom")
        if place.leader is not None:
            figure.add_artist(line(*to_figure(place.leader).T, color=GREY, linewidth=0.8, zorder=1))


def _sheet(titles: Sequence[str], notes: Sequence[str], inches: float) -> tuple[Any, Any]:
    """A figure with one pair of axes of about so many inches, titles over it, the first in bold, and notes below."""
    head, below = ([line for text in texts for line in wrap(text, LETTERS)] for texts in (titles[1:], notes))
    height = inches + 0.2 * (len(head) + len(below)) + 1.3
    figure = import_module("matplotlib.figure").Figure((WIDTH, height), dpi=DPI, layout="constrained")
    figure.suptitle(titles[0], x=0.01, ha="left", weight="bold", fontsize=SIZE)
    figure.supxlabel("\n".join(below), x=0.01, ha="left", fontsize=SIZE)
    axes = figure.subplots()
    axes.set_title("\n".join(head) + "\n\n", loc="left", fontsize=SIZE)
    return figure, axes


def save_figure(figure: Any, path: Path) -> None:
    """Write it without the date and random names that matplotlib puts in an SVG: equal plots are equal files."""
    with import_module("matplotlib").rc_context({"svg.hashsalt": "clsplat"}):
        kind = path.suffix.lower()[1:]
        with atomic_writer(path) as file:
            figure.savefig(file, format=kind, dpi=150, metadata={"Date": None} if kind == "svg" else None)

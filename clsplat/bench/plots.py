# SPDX-License-Identifier: Apache-2.0
"""The two plots of `clsplat bench --plot`: gain of each exact switch, and time against error of approximate settings.

They need matplotlib, the optional extra `plot`.

The file name's ending selects SVG or PNG.
Plots are legible at a width of 800 pixels: fonts have at least 10 points, at a width of 8 inches.
The colours are the palette of Okabe and Ito, which colour-blind readers can tell apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from clsplat.bench.label_places import place_labels
from clsplat.bench.settings import ALL_EXACT_SWITCHES_OFF, MAX_PSNR_DB, front
from clsplat.errors import InputError
from clsplat.files.atomic import atomic_writer

PLOT_EXTENSIONS = (".svg", ".png")
FIGURE_WIDTH_INCHES, LAYOUT_DPI = 8.0, 100
"""Width of a figure in inches, and pixels per inch in its layout."""
FONT_SIZE_POINTS = 10
"""Font size in points."""
OKABE_ITO_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000", "#666666")
PLOT_BLUE, PLOT_ORANGE, _, PLOT_VERMILION, _, _, PLOT_BLACK, PLOT_GREY = OKABE_ITO_COLOURS
CHARACTERS_PER_LINE = 92
"""Number of characters in a line of text across a figure."""
LEGEND_ABOVE_AXES = {
    "loc": "lower right",
    "bbox_to_anchor": (1, 1),
    "ncols": 3,
    "frameon": False,
    "fontsize": FONT_SIZE_POINTS,
}
"""Settings of a legend above the axes, where it covers no point."""
LABEL_PADDING_PX = 2.0
"""Padding around a label in pixels."""

Point = tuple[float, float]


def check_plot(path: Path) -> None:
    """Raise InputError if a plot cannot be written to `path`. Call this before the measurements that the plot shows."""
    if path.suffix.lower() not in PLOT_EXTENSIONS:
        raise InputError(f"{path}: has the extension {path.suffix or 'none'!r}, expected .svg or .png")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: no such folder, expected an existing one for the plot")
    try:
        import_module("matplotlib")
    except ImportError as error:
        message = f"{path}: plots need matplotlib ({error}); install it with: pip install 'clsplat[plot]'"
        raise InputError(message) from None


def plot_files(path: Path) -> tuple[Path, Path]:
    """Return the paths of the two plots, next to `path`: exact switches, and approximate settings."""
    switches, error = (path.with_name(f"{path.stem}-{kind}{path.suffix}") for kind in ("switches", "error"))
    return switches, error


def plot_settings(path: Path, result: Mapping[str, Any], title: str) -> tuple[Path, Path]:
    """Draw a result of `clsplat.bench.settings.compare` into `plot_files(path)`, and return these paths."""
    files = plot_files(path)
    for file, draw in zip(files, (_draw_switches, _draw_error), strict=True):
        save_figure(draw(result, title), file)
    return files


def _draw_switches(result: Mapping[str, Any], title: str) -> Any:
    """Draw a bar chart of each exact switch's gain: time without the switch, divided by time with all of them."""
    exact = _exact_point(result)
    rows = []
    if exact is not None:
        for point in result["points"]:
            if not point["approximate"] and point["name"] not in (exact["name"], ALL_EXACT_SWITCHES_OFF):
                ratios = [point[key] / exact[key] for key in ("frame_ms", "iteration_ms")]
                rows.append((ratios, point["name"]))
    rows.sort(key=lambda row: row[0][0])
    notes = ["Time without the switch divided by the time of exact, which has all of them. 1.00: no difference."]
    if (faster := result["exact_switches_faster"]) is not None:
        notes.append(f"With all switches off: {faster['frame']:.2f} for a frame, {faster['iteration']:.2f} for a step.")
    inches = max(0.42 * len(rows) + 0.2, 1.0)
    figure, axes = _sheet(["Gain of each exact switch", title], notes, inches)
    for index, (key, colour) in enumerate((("a frame", PLOT_BLUE), ("a training step", PLOT_ORANGE))):
        values = [ratios[index] for ratios, _ in rows]
        places = [row + 0.2 - 0.4 * index for row in range(len(rows))]
        axes.barh(places, [value - 1 for value in values], 0.38, left=1, color=colour, label=key)
        for place, value in zip(places, values, strict=True):
            text = f"{value:.2f}"
            axes.annotate(
                text, (max(value, 1), place), (4, 0), textcoords="offset points", va="center", fontsize=FONT_SIZE_POINTS
            )
    axes.axvline(1, color=PLOT_BLACK, linewidth=1)
    axes.set_yticks(range(len(rows)), [name for _, name in rows], fontsize=FONT_SIZE_POINTS)
    axes.set_ylim(-0.6, len(rows) - 0.4)
    ratios = [value for both, _ in rows for value in both]
    low, high = min([1.0, *ratios]), max([1.05, *ratios])
    axes.set_xlim(low - 0.02 * (high - low), high + 0.12 * (high - low))
    axes.set_xlabel("time without the switch / time with it", fontsize=FONT_SIZE_POINTS)
    axes.grid(alpha=0.3, axis="x")
    if rows:
        axes.legend(**LEGEND_ABOVE_AXES)
    else:
        axes.text(
            0.5, 0.5, "no exact switch was measured", transform=axes.transAxes, ha="center", fontsize=FONT_SIZE_POINTS
        )
    return figure


def _draw_error(result: Mapping[str, Any], title: str) -> Any:
    """Plot the frame time against PSNR for the approximate settings, with the exact preset as reference."""
    exact = _exact_point(result)
    tried = [point for point in result["points"] if point["approximate"]]
    drawn = [point for point in tried if point["against_exact"]["max_abs"] > 0]
    same = [f"{point['name']} ({point['frame_ms']:.1f} ms)" for point in tried if point not in drawn]
    _, _, width, height = result["crop"]
    known = result["exact_against_float64"]
    reference = f"The exact preset against the float64 reference, {width}x{height} pixels in the middle"
    notes = [
        f"Error against {result['error_is_against']}. The largest absolute error is in brackets.",
        f"{reference}: {known['psnr']:.1f} dB, largest error {known['max_abs']:.2g}.",
    ]
    if same:
        notes.append(f"Approximate settings whose frame has the same bits as the exact preset's: {', '.join(same)}.")
    figure, axes = _sheet(["Time against error of the approximate settings", title], notes, 5.0)
    axes.set_xlabel("ms per frame, median", fontsize=FONT_SIZE_POINTS)
    axes.set_ylabel("PSNR, dB", fontsize=FONT_SIZE_POINTS)
    axes.grid(alpha=0.3)
    if not drawn:
        axes.text(
            0.5, 0.5, "no approximate setting differs", transform=axes.transAxes, ha="center", fontsize=FONT_SIZE_POINTS
        )
        return figure
    rivals = [*drawn, *([exact] if exact is not None else [])]
    best = front([(point["frame_ms"], point["psnr"]) for point in rivals])
    kinds = ((True, PLOT_VERMILION, "on the Pareto front with exact"), (False, "white", "behind it"))
    for on, colour, label in kinds:
        chosen = [point for point, is_best in zip(drawn, best, strict=False) if is_best == on]
        x, y = ([point[key] for point in chosen] for key in ("frame_ms", "psnr"))
        axes.plot(
            x,
            y,
            marker="o",
            markersize=7,
            markerfacecolor=colour,
            markeredgecolor=PLOT_VERMILION if on else PLOT_BLUE,
            markeredgewidth=1.6,
            linestyle="none",
            label=label,
            zorder=3,
        )
    axes.set_xlim(_around([point["frame_ms"] for point in rivals], 0.3))  # leave room for labels on the left
    axes.set_ylim(_around([point["psnr"] for point in drawn], 0.1))
    top = axes.get_ylim()[1]
    edges = [(point["frame_ms"], point["psnr"]) for point, is_best in zip(rivals, best, strict=True) if is_best]
    steps = _steps([(ms, min(psnr, top) if psnr >= MAX_PSNR_DB else psnr) for ms, psnr in sorted(edges)])
    axes.plot(*zip(*steps, strict=True), color=PLOT_VERMILION, linewidth=1.5, zorder=2)
    lines = list(pairwise(steps))
    if exact is not None:
        ms = exact["frame_ms"]
        axes.axvline(ms, color=PLOT_GREY, linewidth=1.2, linestyle="--", zorder=1, label=f"exact: {ms:.1f} ms")
        lines.append(((ms, axes.get_ylim()[0]), (ms, top)))
    texts = [f"{point['name']} ({point['max_abs']:.2g})" for point in drawn]
    axes.legend(**LEGEND_ABOVE_AXES)
    figure.draw_without_rendering()  # compute the final position of the axes
    _label_points(figure, axes, [(point["frame_ms"], point["psnr"]) for point in drawn], texts, lines)
    return figure


def _exact_point(result: Mapping[str, Any]) -> Mapping[str, Any] | None:
    return next((point for point in result["points"] if point["name"] == result["exact"]), None)


def _around(values: Sequence[float], below: float) -> tuple[float, float]:
    """Return the limits of an axis for these values: their range, extended at both ends.

    The range is extended by 0.1 times its length at the upper end, and by `below` times its length at the lower end.
    """
    span = max(values) - min(values) or 1.0
    return min(values) - below * span, max(values) + 0.1 * span


def _steps(corners: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Turn points (cost, quality) of a Pareto front into a staircase: horizontal to the next cost, then vertical."""
    path = list(corners[:1])
    for (_, quality), (cost, better) in pairwise(corners):
        path += [(cost, quality), (cost, better)]
    return path


def _label_points(
    figure: Any, axes: Any, points: Sequence[Point], texts: Sequence[str], lines: Sequence[tuple[Point, Point]]
) -> None:
    """Write a text near each point, with a leader line if the text is not next to the point.

    points: the points in the coordinates of `axes`, which must already have its final position and limits.
    lines: both ends of each line that texts should not cross, in the same coordinates.
    """
    to_pixels, to_figure = axes.transData.transform, figure.transFigure.inverted().transform
    bounds = axes.get_window_extent()
    frame = np.array(
        [
            bounds.x0 + LABEL_PADDING_PX,
            bounds.y0 + LABEL_PADDING_PX,
            bounds.x1 - LABEL_PADDING_PX,
            bounds.y1 - LABEL_PADDING_PX,
        ]
    )
    artists = [figure.text(0, 0, text, fontsize=FONT_SIZE_POINTS) for text in texts]
    sizes = np.array([artist.get_window_extent().size for artist in artists]) + 2 * LABEL_PADDING_PX
    segments = to_pixels(np.reshape(lines, (-1, 2))).reshape(-1, 2, 2)
    line = import_module("matplotlib.lines").Line2D
    for artist, place in zip(artists, place_labels(to_pixels(points), sizes, frame, segments), strict=True):
        artist.set(position=to_figure(place.box[:2] + LABEL_PADDING_PX), ha="left", va="bottom")
        if place.leader is not None:
            figure.add_artist(line(*to_figure(place.leader).T, color=PLOT_GREY, linewidth=0.8, zorder=1))


def _sheet(titles: Sequence[str], notes: Sequence[str], inches: float) -> tuple[Any, Any]:
    """Make a figure with, from top to bottom, the titles (the first in bold), axes of `inches` height, and the notes.

    Returns the figure and the axes.
    """
    head, below = (
        [line for text in texts for line in wrap(text, CHARACTERS_PER_LINE)] for texts in (titles[1:], notes)
    )
    height = inches + 0.2 * (len(head) + len(below)) + 1.3
    figure = import_module("matplotlib.figure").Figure(
        (FIGURE_WIDTH_INCHES, height), dpi=LAYOUT_DPI, layout="constrained"
    )
    figure.suptitle(titles[0], x=0.01, ha="left", weight="bold", fontsize=FONT_SIZE_POINTS)
    figure.supxlabel("\n".join(below), x=0.01, ha="left", fontsize=FONT_SIZE_POINTS)
    axes = figure.subplots()
    axes.set_title("\n".join(head) + "\n\n", loc="left", fontsize=FONT_SIZE_POINTS)
    return figure, axes


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure to a file. SVG files have no date and no random ids, so that equal plots give equal files."""
    with import_module("matplotlib").rc_context({"svg.hashsalt": "clsplat"}):
        kind = path.suffix.lower()[1:]
        with atomic_writer(path) as file:
            figure.savefig(file, format=kind, dpi=150, metadata={"Date": None} if kind == "svg" else None)

# SPDX-License-Identifier: Apache-2.0
"""Charts of the HTML reports, as inline SVG: lines, dots, stacked areas and histograms.

The page's style sheet defines the colours. Text is escaped. SVG elements also contain the values of their points, which
the page's script displays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain
from typing import Any, Literal

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

CHART_WIDTH_PX, CHART_HEIGHT_PX = 420, 250
PLOT_LEFT_PX, PLOT_RIGHT_PX, PLOT_TOP_PX, PLOT_BOTTOM_PX = 52, 412, 22, 214
MAX_LINE_POINTS = 400
"""Maximum number of points of a line. Longer lines are thinned."""
SERIES_COLOUR_COUNT = 8
"""Number of colour classes in the style sheet, c0 to c7."""

FILLED_KINDS = ("area", "bars")
"""Kinds of series that are drawn as filled shapes, down to zero."""

Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class ChartSeries:
    """A series of a chart: points sorted by x, and `kind`, the way in which they are drawn.

    color: number of the colour, from 0 to SERIES_COLOUR_COUNT - 1.
    The kinds are:
    line: a line.
    faint: a faint line behind the others.
    dots: a line with dots.
    area: stacked areas, the first series lowest; all series have the same x.
    bars: bars of a histogram; x is the lower edge of a bin, and the last point is the end of the last bin.
    """

    name: str
    points: Points
    kind: Literal["line", "faint", "dots", "area", "bars"] = "line"
    color: int = 0


@dataclass(frozen=True)
class Axis:
    """Axis that maps values in [low, high] to pixels in [start, end].

    ticks: value and label of each tick.
    """

    low: float
    high: float
    start: float
    end: float
    ticks: tuple[tuple[float, str], ...]

    def __call__(self, value: float) -> float:
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)


def chart(
    title: str,
    series: Sequence[ChartSeries],
    x: str,
    y: str,
    *,
    log_y: bool = False,
    from_zero: bool = False,
    powers: bool = False,
    note: str = "",
) -> Markup:
    """Draw series as an HTML figure with title, legend and axis labels; "" if there are no points to draw.

    x, y: labels of the axes.
    log_y: logarithmic y axis. Values that are not positive are left out.
    from_zero: the y axis includes zero.
    powers: True if the x values are exponents of ten.
    note: remark below the chart. Values replace it while the pointer is over the chart.
    """
    drawn = [replace(curve, points=_kept(curve, log_y)) for curve in series]
    drawn = [curve for curve in drawn if curve.points]
    if not drawn:
        return Markup("")
    heights = _heights(drawn, log_y)
    xs, ys = [x for curve in drawn for x, _ in curve.points], list(chain(*heights))
    if from_zero or any(curve.kind in FILLED_KINDS for curve in drawn):
        ys.append(0.0)
    across, up = (
        _axis(xs, PLOT_LEFT_PX, PLOT_RIGHT_PX, powers=powers),
        _axis(ys, PLOT_BOTTOM_PX, PLOT_TOP_PX, powers=log_y),
    )
    shapes = [
        _shape(curve, [(across(x), up(y)) for (x, _), y in zip(curve.points, tops, strict=True)], up(0.0))
        for curve, tops in zip(drawn, heights, strict=True)
    ]
    html = (
        templates()
        .get_template("chart.html")
        .render(
            title=title,
            legend=shapes,
            across=across,
            up=up,
            x=x,
            y=y,
            powers=powers,
            note=note,
            label=f"{title}: {y} against {x}. "
            + " ".join(_described(curve) for curve in drawn if curve.kind != "faint"),
            # later shapes are drawn over earlier ones: mean curves over faint ones, lower areas of a stack over higher
            shapes=sorted(shapes[:: -1 if drawn[0].kind == "area" else 1], key=lambda shape: shape["kind"] != "faint"),
            width=CHART_WIDTH_PX,
            height=CHART_HEIGHT_PX,
        )
    )
    return Markup(html)  # noqa: S704  # escaped by the template


@cache
def templates() -> Environment:
    """Jinja environment of the page templates. It escapes everything that is not Markup."""
    return Environment(
        loader=PackageLoader("clsplat.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def short(value: float) -> str:
    """Format a number as a short text: 235k, 1.2M, 0.025."""
    size = abs(value)
    for limit, factor, unit in ((1e9, 1e-9, "G"), (1e6, 1e-6, "M"), (1e4, 1e-3, "k")):
        if size >= limit:
            return f"{value * factor:.4g}{unit}"
    return f"{value:.4g}"


def thinned(points: Points, limit: int = MAX_LINE_POINTS) -> Points:
    """Reduce points to about `limit`. The lowest and highest point of each interval stay, so that peaks are kept."""
    if len(points) <= limit:
        return points
    stretch = math.ceil(2 * len(points) / limit)
    kept = {0, len(points) - 1}
    for start in range(0, len(points), stretch):
        part = range(start, min(start + stretch, len(points)))
        kept |= {pick(part, key=lambda index: points[index][1]) for pick in (min, max)}
    return [points[index] for index in sorted(kept)]


def _kept(curve: ChartSeries, log_y: bool) -> Points:
    """Return the points that can be drawn. Long lines are thinned."""
    points = [point for point in curve.points if all(map(math.isfinite, point)) and (not log_y or point[1] > 0)]
    return points if curve.kind in FILLED_KINDS else thinned(points)


def _heights(drawn: Sequence[ChartSeries], log_y: bool) -> list[list[float]]:
    """Return the y values of each series, as logarithms if `log_y`. The values of stacked areas are summed from the
    lowest area up."""
    heights = [[math.log10(y) if log_y else y for _, y in curve.points] for curve in drawn]
    stacked: list[list[float]] = np.cumsum(heights, axis=0).tolist() if drawn[0].kind == "area" else heights
    return stacked


def _axis(values: Sequence[float], start: float, end: float, *, powers: bool) -> Axis:
    low, high = min(values), max(values)
    if high - low <= 1e-12 * max(abs(low), abs(high)):
        pad = 0.05 * abs(high) or 1.0
        low, high = low - (pad if low else 0), high + pad
    step = _step(high - low, 5)
    if powers:
        step = max(1.0, math.ceil(step))
        if math.floor(high) - math.ceil(low) < 1:  # within a decade
            low, high = math.floor(low), math.ceil(high)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    ticks = [number * step for number in range(first, last + 1)]
    return Axis(low, high, start, end, tuple((tick, _power(tick) if powers else short(tick)) for tick in ticks))


def _power(value: float) -> str:
    return short(10.0**value) if -4 <= value <= 9 else f"1e{value:g}"


def _step(span: float, count: int) -> float:
    """Distance between about `count` ticks in the span: 1, 2 or 5 times a power of ten."""
    rough = span / count
    power = 10.0 ** math.floor(math.log10(rough))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * 0.999)


def _shape(curve: ChartSeries, pixels: Points, floor: float) -> dict[str, Any]:
    """Return the data of a series for the template chart.html.

    pixels: positions x, y of the series' points in the chart.
    floor: position y of zero.
    In the result, `shown` has the values that the page's script displays, and `places` their positions x.
    """
    step = "H{:.1f}V{:.1f}" if curve.kind == "bars" else "L{:.1f} {:.1f}"
    path = "M{:.1f} {:.1f}".format(*pixels[0]) + "".join(step.format(*pixel) for pixel in pixels[1:])
    if curve.kind in FILLED_KINDS:
        path += f"V{floor:.1f}H{pixels[0][0]:.1f}Z"
    return {
        "name": curve.name,
        "kind": curve.kind,
        "color": curve.color % SERIES_COLOUR_COUNT,
        "path": path,
        "shown": " ".join(f"{x:.7g} {y:.7g}" for x, y in curve.points),
        "places": " ".join(f"{x:.1f}" for x, _ in pixels),
        "dots": pixels if curve.kind == "dots" or len(pixels) == 1 else [],
    }


def _described(curve: ChartSeries) -> str:
    if curve.kind == "bars":
        top = max(curve.points, key=lambda point: point[1])
        return f"{curve.name}: the largest bin counts {short(top[1])} and begins at {short(top[0])}."
    return f"{curve.name}: {short(curve.points[0][1])} at first, {short(curve.points[-1][1])} at the end."

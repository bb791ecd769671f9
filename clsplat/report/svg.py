# SPDX-License-Identifier: Apache-2.0
"""Charts as inline SVG, coloured by the page's style sheet. Text is escaped; lines carry the figures they are drawn by,
for the page's script to show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from markupsafe import Markup

WIDTH, HEIGHT = 420, 250
LEFT, RIGHT, TOP, BOTTOM = 52, 412, 22, 214
MAX_POINTS = 400
COLORS = 8
"""Classes c0 to c7 of the style sheet."""

Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Series:
    """Points by x, and how they are drawn: line, faint (a line behind others), dots (a line with dots), area (points
    are tops of a stack, the first series lowest), bars (x is a bin's lower edge; the last point ends the last bin)."""

    name: str
    points: Points
    kind: Literal["line", "faint", "dots", "area", "bars"] = "line"
    color: int = 0


@dataclass(frozen=True)
class Axis:
    """The axis from values low to high, to pixels from start to end; ticks: value and label. power: values are powers
    of ten of what the labels say."""

    low: float
    high: float
    start: float
    end: float
    ticks: tuple[tuple[float, str], ...]

    def __call__(self, value: float) -> float:
        return self.start + (value - self.low) / (self.high - self.low) * (self.end - self.start)


def chart(
    title: str,
    series: Sequence[Series],
    x: str,
    y: str,
    *,
    log_y: bool = False,
    from_zero: bool = False,
    powers: bool = False,
    note: str = "",
) -> Markup:
    """A figure with a legend: title, labels of both axes. log_y: a logarithmic axis, values that are not positive are
    left out; from_zero: y begins there; powers: x are powers of ten. "" where there are no points at all."""
    drawn = [Series(each.name, _kept(each.points, log_y), each.kind, each.color) for each in series]
    drawn = [each for each in drawn if each.points]
    if not drawn:
        return Markup("")
    xs = [point[0] for each in drawn for point in each.points]
    ys = [_y(point[1], log_y) for each in drawn for point in each.points]
    if from_zero or any(each.kind in ("area", "bars") for each in drawn):
        ys.append(0.0)
    across, up = _axis(xs, LEFT, RIGHT, powers=powers), _axis(ys, BOTTOM, TOP, powers=log_y)
    parts = [_grid(across, up, x, y)]
    parts += [_shape(each, drawn, across, up, log_y=log_y) for each in _back_to_front(drawn)]
    legend = Markup("").join(
        Markup('<li class="c{} {}"><i></i>{}</li>').format(each.color % COLORS, each.kind, each.name) for each in drawn
    )
    described = f"{title}: {y} by {x}. " + " ".join(_described(each) for each in drawn if each.kind != "faint")
    return Markup(
        '<figure class="chart"><figcaption>{title}</figcaption><ul class="legend">{legend}</ul>'
        '<svg viewBox="0 0 {w} {h}" role="img" aria-label="{label}" data-x="{x}" data-powers="{powers}">'
        '{parts}<line class="cross" x1="0" x2="0" y1="{top}" y2="{bottom}"/></svg>'
        '<output class="values" aria-hidden="true">{note}</output></figure>'
    ).format(
        title=title,
        legend=legend,
        w=WIDTH,
        h=HEIGHT,
        label=described,
        x=x,
        powers=int(powers),
        parts=Markup("").join(parts),
        top=TOP,
        bottom=BOTTOM,
        note=note,
    )


def short(value: float) -> str:
    """A short number for people: 235k, 1.2M, 0.025."""
    size = abs(value)
    for limit, factor, unit in ((1e9, 1e-9, "G"), (1e6, 1e-6, "M"), (1e4, 1e-3, "k")):
        if size >= limit:
            return f"{value * factor:.4g}{unit}"
    return f"{value:.4g}"


def thinned(points: Points, limit: int = MAX_POINTS) -> Points:
    """At most about `limit` of the points: of each stretch the lowest and the highest, so that no peak is lost."""
    if len(points) <= limit:
        return points
    stretch = math.ceil(2 * len(points) / limit)
    found = [points[0]]
    for start in range(0, len(points), stretch):
        part = range(start, min(start + stretch, len(points)))
        ends = {min(part, key=lambda index: points[index][1]), max(part, key=lambda index: points[index][1])}
        found += [points[index] for index in sorted(ends)]
    return [*found, points[-1]]


def _kept(points: Points, log_y: bool) -> Points:
    return [point for point in points if all(map(math.isfinite, point)) and (not log_y or point[1] > 0)]


def _y(value: float, log_y: bool) -> float:
    return math.log10(value) if log_y else value


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
    """1, 2 or 5 times a power of ten, about `count` of them in the span."""
    rough = span / count
    power = 10.0 ** math.floor(math.log10(rough))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * 0.999)


def _grid(across: Axis, up: Axis, x: str, y: str) -> Markup:
    parts = []
    for value, label in up.ticks:
        at = up(value)
        line = Markup('<path class="grid" d="M{} {:.1f}H{}"/><text class="tick end" x="{}" y="{:.1f}">{}</text>')
        parts.append(line.format(LEFT, at, RIGHT, LEFT - 5, at + 4, label))
    for value, label in across.ticks:
        at = across(value)
        side = " end" if at > RIGHT - 10 else " middle"
        line = Markup('<path class="grid" d="M{:.1f} {}v4"/><text class="tick{}" x="{:.1f}" y="{}">{}</text>')
        parts.append(line.format(at, BOTTOM, side, at, BOTTOM + 17, label))
    labels = Markup('<text class="end" x="{}" y="{}">{}</text><text x="{}" y="{}">{}</text>')
    parts.append(labels.format(RIGHT, HEIGHT - 3, x, 4, 12, y))
    parts.append(Markup('<path class="axis" d="M{} {}H{}"/>').format(LEFT, BOTTOM, RIGHT))
    return Markup("").join(parts)


def _back_to_front(drawn: Sequence[Series]) -> list[Series]:
    """Areas from the highest, faint lines, then the rest as they come."""
    areas = [each for each in drawn if each.kind == "area"]
    faint = [each for each in drawn if each.kind == "faint"]
    return [*reversed(areas), *faint, *(each for each in drawn if each.kind not in ("area", "faint"))]


def _shape(each: Series, drawn: Sequence[Series], across: Axis, up: Axis, *, log_y: bool) -> Markup:
    points = each.points if each.kind == "bars" else thinned(each.points)
    at = [(across(x), up(_y(y, log_y))) for x, y in points]
    color, shown = each.color % COLORS, points
    if each.kind == "area":
        below = _below(each, drawn)
        shown = [(x, y - low) for (x, y), low in zip(each.points, below, strict=True)]
        at = [(across(x), up(y)) for x, y in each.points]
        back = [(across(x), up(low)) for (x, _), low in zip(each.points, below, strict=True)]
        path = _line([*at, *reversed(back)]) + "Z"
    elif each.kind == "bars":
        floor = f"{up(0.0):.1f}"
        tops = [f"V{y:.1f}H{end:.1f}" for (_, y), (end, _) in pairwise(at)]
        path = f"M{at[0][0]:.1f} {floor}{''.join(tops)}V{floor}Z"
    else:
        path = _line(at)
    values = " ".join(f"{x:.7g} {y:.7g}" for x, y in shown)
    name = Markup('<path class="c{} {}" d="{}" data-name="{}" data-values="{}" data-at="{}"/>')
    places = " ".join(f"{x:.1f}" for x, _ in at)
    parts = [name.format(color, each.kind, path, each.name, values, places)]
    if each.kind == "dots" or len(at) == 1:
        dot = Markup('<circle class="c{} dot" cx="{:.1f}" cy="{:.1f}" r="3.5"/>')
        parts += [dot.format(color, x, y) for x, y in at]
    return Markup("").join(parts)


def _below(each: Series, drawn: Sequence[Series]) -> list[float]:
    areas = [other for other in drawn if other.kind == "area"]
    index = areas.index(each)
    return [y for _, y in areas[index - 1].points] if index else [0.0] * len(each.points)


def _line(at: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in at)


def _described(each: Series) -> str:
    if each.kind == "bars":
        top = max(each.points, key=lambda point: point[1])
        return f"{each.name}: most, {short(top[1])}, from {short(top[0])} on."
    return f"{each.name}: {short(each.points[0][1])} at first, {short(each.points[-1][1])} at last."

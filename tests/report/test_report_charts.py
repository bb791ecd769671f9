# SPDX-License-Identifier: Apache-2.0
"""Charts: points where the axes say, figures kept, text escaped."""

from __future__ import annotations

import math
import re

import pytest
from pages import Element, parse

from clsplat.report.charts import (
    MAX_LINE_POINTS,
    PLOT_BOTTOM_PX,
    PLOT_LEFT_PX,
    PLOT_RIGHT_PX,
    PLOT_TOP_PX,
    ChartSeries,
    chart,
    short,
    thinned,
)


def drawn(*series: ChartSeries, **options: object) -> Element:
    return parse(chart("a title", series, "across", "up", **options))  # type: ignore[arg-type]


def places(path: Element) -> list[tuple[float, float]]:
    numbers = list(map(float, re.findall(r"[-\d.]+", path.attributes["d"])))
    return list(zip(numbers[::2], numbers[1::2], strict=True))


def path_of(page: Element, name: str) -> Element:
    return next(each for each in page.all("path") if each.attributes.get("data-name") == name)


def test_points_are_where_the_ticks_say() -> None:
    page = drawn(ChartSeries("one", [(0, 0), (50, 30), (100, 10)]))
    labels = {each.text: each.attributes for each in page.all("text") if "tick" in each.attributes.get("class", "")}
    (left, bottom), (middle, top), (right, _) = places(path_of(page, "one"))
    assert (left, bottom, right, top) == (PLOT_LEFT_PX, PLOT_BOTTOM_PX, PLOT_RIGHT_PX, PLOT_TOP_PX)
    assert float(labels["40"]["x"]) < middle < float(labels["60"]["x"])
    assert float(labels["100"]["x"]) == right
    # a tick's text is 4 lower than its line
    assert float(labels["30"]["y"]) - 4 == pytest.approx(top, abs=0.06)


def test_a_logarithmic_axis() -> None:
    page = drawn(ChartSeries("one", [(0, 0.1), (1, 1.0), (2, 10.0), (3, 0.0), (4, -1.0)]), log_y=True)
    at = places(path_of(page, "one"))
    assert len(at) == 3, "what is not positive has no place"
    assert [y for _, y in at] == pytest.approx(
        [PLOT_BOTTOM_PX, (PLOT_BOTTOM_PX + PLOT_TOP_PX) / 2, PLOT_TOP_PX], abs=0.06
    )


def test_areas_are_stacked_and_say_their_own_height() -> None:
    page = drawn(ChartSeries("low", [(0, 1.0), (1, 2.0)], "area"), ChartSeries("high", [(0, 2.0), (1, 4.0)], "area", 1))
    (_, bottom), (_, top) = places(path_of(page, "high"))[:2]
    assert (bottom, top) == (pytest.approx((PLOT_BOTTOM_PX + PLOT_TOP_PX) / 2, abs=0.06), PLOT_TOP_PX)
    assert path_of(page, "high").attributes["data-values"] == "0 2 1 4"
    names = [each.attributes["data-name"] for each in page.all("path") if "data-name" in each.attributes]
    assert names == ["high", "low"], "the lower one is drawn over the higher one"


def test_bars_stand_on_the_axis_with_the_height_of_their_count() -> None:
    page = drawn(ChartSeries("one", [(0, 2.0), (1, 4.0), (2, 0.0)], "bars"))
    path = path_of(page, "one").attributes["d"]
    half = (PLOT_BOTTOM_PX + PLOT_TOP_PX) / 2
    middle = (PLOT_LEFT_PX + PLOT_RIGHT_PX) / 2
    rise = f"M{PLOT_LEFT_PX}.0 {half:.1f}H{middle:.1f}V{PLOT_TOP_PX}.0H{PLOT_RIGHT_PX}.0"
    assert path == f"{rise}V{PLOT_BOTTOM_PX}.0V{PLOT_BOTTOM_PX}.0H{PLOT_LEFT_PX}.0Z"


@pytest.mark.parametrize("values", [[5.0], [0.0, 0.0], [1e-12, 1e-12], [-3.0, -3.0], [1e30, -1e30], [7.0, 7.0 + 1e-15]])
@pytest.mark.parametrize("log_y", [False, True])
def test_any_numbers_have_axes(values: list[float], log_y: bool) -> None:
    markup = chart("a", [ChartSeries("one", list(enumerate(values)))], "x", "y", log_y=log_y)
    assert "nan" not in markup
    assert "inf" not in markup


def test_nothing_is_drawn_of_nothing() -> None:
    assert chart("a", [ChartSeries("one", [])], "x", "y") == ""
    assert chart("a", [ChartSeries("one", [(0, math.nan), (1, math.inf)])], "x", "y") == ""


def test_text_is_escaped() -> None:
    bad = "<script>\"'&"
    markup = chart(bad, [ChartSeries(bad, [(0, 1), (1, 2)])], bad, bad, note=bad)
    assert "<script" not in markup
    page = parse(markup)
    assert page.one("figcaption").text == bad
    assert page.one("output").text == bad
    assert path_of(page, bad)


def test_thinning_keeps_the_ends_and_every_peak() -> None:
    points = [(float(index), math.sin(index / 50)) for index in range(10_000)]
    points[1234] = (1234.0, 99.0)
    points[7777] = (7777.0, -99.0)
    kept = thinned(points)
    assert len(kept) <= MAX_LINE_POINTS + 2
    assert {points[0], points[-1], points[1234], points[7777]} <= set(kept)
    assert [x for x, _ in kept] == sorted(x for x, _ in kept)
    assert thinned(points[:300]) == points[:300]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (7000, "7000"), (235_303, "235.3k"), (1_200_000, "1.2M"), (0.0254788, "0.02548"), (-50_000, "-50k")],
)
def test_numbers_for_people(value: float, text: str) -> None:
    assert short(value) == text

# SPDX-License-Identifier: Apache-2.0
"""Pages of clsplat.report in a real browser: from a file, without a network, wide and on a phone."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import kept, watched_page
from quick import quick
from test_report import SCRIPT

from clsplat.cli.main import main

WIDE, PHONE = {"width": 1280, "height": 900}, {"width": 390, "height": 800}


@pytest.fixture(scope="module")
def pages(reported: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A report with names that would be scripts, and a comparison."""
    run = Path(shutil.copytree(reported, tmp_path_factory.mktemp("pages") / "run"))
    evaluation = json.loads((run / "eval.json").read_text())
    evaluation["views"].append({"name": SCRIPT, "psnr": 1.0, "ssim": 0.5})
    (run / "eval.json").write_text(json.dumps(evaluation))
    assert main(["report", str(run)]) == 0
    assert main(["compare", str(run), str(reported), "-o", str(run / "compare.html")]) == 0
    return {"report": run / "report.html", "compare": run / "compare.html"}


@pytest.fixture
def opened(browser: Any, pages: dict[str, Path]) -> Iterator[Any]:
    """Opens a page by its kind; at the end nothing has gone wrong in it, and nothing been asked of a network."""
    made: list[tuple[Any, list[str], list[str]]] = []

    def go(kind: str, **options: Any) -> Any:
        page, trouble = watched_page(browser, **options)
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.on("dialog", lambda dialog: (trouble.append(dialog.message), dialog.dismiss()))
        page.context.set_offline(True)
        page.goto(pages[kind].as_uri())
        made.append((page, trouble, asked))
        return page

    yield go
    for page, trouble, asked in made:
        page.close()
        assert trouble == []
        assert [url for url in asked if not url.startswith(("file://", "data:"))] == []
        assert len([url for url in asked if url.startswith("file://")]) == 1, "the page itself"


@pytest.mark.parametrize("kind", quick(["report", "compare"], "report"))
@pytest.mark.parametrize(("size", "scheme"), [(WIDE, "light"), (PHONE, "dark")], ids=["wide", "phone"])
def test_it_fits_and_is_coloured_as_asked(opened: Any, kind: str, size: Any, scheme: str, tmp_path: Path) -> None:
    page = opened(kind, viewport=size, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") == size["width"], "nothing to scroll to the side"
    red = int(page.evaluate("getComputedStyle(document.body).backgroundColor").split("(")[1].split(",")[0])
    assert red > 200 if scheme == "light" else red < 60
    broken = "[...document.images].filter(image => !image.complete || !image.naturalWidth).length"
    assert page.evaluate(broken) == 0
    assert page.evaluate("document.images.length") == (12 if kind == "report" else 0)
    charts = page.locator(".chart svg")
    assert charts.count() >= 6
    assert charts.first.bounding_box()["width"] > 250
    picture = kept(tmp_path, f"{kind}-{size['width']}.png")
    page.screenshot(path=picture, full_page=True)
    assert picture.stat().st_size > 10_000


def cut(page: Any) -> float:
    """Pixels of the first view's photograph that are not covered by the render, as a share."""
    style = page.locator(".wipe .over").first.evaluate("image => getComputedStyle(image).clipPath")
    return float(style.split()[-1].strip("inset()%")) / 100


def test_the_slider_moves_by_keys_and_by_dragging(opened: Any) -> None:
    page = opened("report", viewport=WIDE)
    slider, stack = page.locator(".wipe input").first, page.locator(".wipe .stack").first
    assert cut(page) == 0.5
    slider.focus()
    for _ in range(10):
        page.keyboard.press("ArrowRight")
    assert cut(page) == pytest.approx(0.6)
    assert slider.get_attribute("aria-valuetext") == "photograph 60 %, render the rest"
    page.keyboard.press("Home")
    assert cut(page) == 0
    stack.scroll_into_view_if_needed()
    box = stack.bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 30)
    page.mouse.up()
    assert cut(page) == pytest.approx(0.25, abs=0.011)  # a step of the slider is a hundredth
    other = page.locator(".wipe .over").nth(1).evaluate("image => getComputedStyle(image).clipPath")
    assert "50%" in other, "each view has a slider of its own"


def test_tab_reaches_every_slider(opened: Any) -> None:
    page = opened("report", viewport=WIDE)
    reached = set()
    for _ in range(12):
        page.keyboard.press("Tab")
        label = page.evaluate("document.activeElement.getAttribute('aria-label')")
        reached.add(label)
    assert {"Photograph against render of 00.png", "Photograph against render of 08.png"} <= reached


def test_a_chart_says_the_figures_under_the_pointer(opened: Any, pages: dict[str, Path]) -> None:
    page = opened("report", viewport=WIDE)
    figure = page.locator(".chart", has_text="Number of Gaussians")
    box = figure.locator("svg").bounding_box()
    page.mouse.move(box["x"] + 0.97 * box["width"], box["y"] + 0.5 * box["height"])
    records = [json.loads(line) for line in (pages["report"].parent / "metrics.jsonl").read_text().splitlines()]
    assert figure.locator("output").inner_text() == f"step 40: Gaussians {records[-1]['gaussians']:,}"
    page.mouse.move(0, 0)
    assert figure.locator("output").inner_text() == ""

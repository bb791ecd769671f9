# SPDX-License-Identifier: Apache-2.0
"""The plots of `clsplat bench`: their files, and the places of their labels."""

from __future__ import annotations

import html
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from benched import SMALL
from calls import Capture, printed, refuses, rejected
from quick import quick

from clsplat.bench import plots
from clsplat.bench import settings as tradeoff
from clsplat.bench.label_places import LEADER_LINE_DISTANCE_PX, crossed, place_labels, shared
from clsplat.cli.main import main
from clsplat.config.presets import RASTERIZER_PRESETS


def a_point(name: str, ms: float, psnr: float, error: float, *, approximate: bool = True) -> dict[str, object]:
    """As `compare` has them, with steps of twice the time."""
    against = {"psnr": psnr, "max_abs": error}
    settings = {"name": name, "approximate": approximate, "frame_ms": ms, "iteration_ms": 2 * ms}
    return {**settings, "against_exact": against, **against}


@pytest.fixture
def result() -> dict[str, object]:
    points = [
        a_point("exact", 40.0, 160.0, 0.0, approximate=False),
        a_point("no early-stop", 42.0, 160.0, 0.0, approximate=False),
        a_point("tile-test square", 60.0, 160.0, 0.0, approximate=False),
        a_point(tradeoff.ALL_EXACT_SWITCHES_OFF, 170.0, 160.0, 0.0, approximate=False),
        a_point("fast", 30.0, 50.0, 0.02),
        a_point("fast again", 30.1, 50.1, 0.021),
        a_point("slow", 80.0, 40.0, 0.03),
        a_point("in vain", 41.0, 160.0, 0.0),
    ]
    return {
        "exact": "exact",
        "exact_switches_faster": {"frame": 4.25, "iteration": 4.126},
        "error_is_against": "the exact preset's frame",
        "crop": [1, 2, 3, 4],
        "exact_against_float64": {"psnr": 120.0, "max_abs": 1e-6},
        "points": points,
    }


def words_of(path: Path) -> list[str]:
    """The texts of an SVG, from top to bottom as they were written; letters are outlines, the text is beside them."""
    return [html.unescape(text) for text in re.findall(r"<!-- (.*?) -->", path.read_text("utf-8"))]


@pytest.mark.needs("matplotlib")
@pytest.mark.parametrize("name", quick(["plot.svg", "plot.PNG"], "plot.svg"))
def test_plots_are_written(tmp_path: Path, result: dict[str, object], name: str) -> None:
    path, again = tmp_path / name, tmp_path / f"again_{name}"
    first, second = (plots.plot_settings(file, result, "a title") for file in (path, again))
    kind = path.suffix
    assert first == plots.plot_files(path) == (tmp_path / f"plot-switches{kind}", tmp_path / f"plot-error{kind}")
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes().startswith(b"\x89PNG" if kind == ".PNG" else b"<?xml")
        assert one.read_bytes() == other.read_bytes()
    assert not path.exists()
    if kind == ".PNG":
        return
    switches, error = map(words_of, first)
    names = [
        word
        for word in switches
        if word in ("no early-stop", "tile-test square", tradeoff.ALL_EXACT_SWITCHES_OFF, "fast")
    ]
    assert names == ["no early-stop", "tile-test square"]  # the axis runs upwards: what is worth most is on top
    assert {"1.05", "1.50", "a frame", "a training step", "a title"} <= set(switches)
    assert "With all switches off: 4.25 for a frame, 4.13 for a step." in switches
    assert {"fast (0.02)", "fast again (0.021)", "slow (0.03)", "exact: 40.0 ms", "a title"} <= set(error)
    notes = " ".join(error)
    for words in (
        "Error against the exact preset's frame",
        "3x4 pixels in the middle: 120.0 dB, largest error 1e-06",
        "the same bits as the exact preset's: in vain (41.0 ms)",
    ):
        assert words in notes
    assert not any("early-stop" in word for word in error)


@pytest.mark.needs("matplotlib")
def test_plots_of_little(tmp_path: Path, result: dict[str, object]) -> None:
    """Of the exact preset alone, and of settings without it."""
    points = result["points"]
    assert isinstance(points, list)
    switches, error = plots.plot_settings(tmp_path / "a.svg", {**result, "points": points[:1]}, "a title")
    assert "no exact switch was measured" in words_of(switches)
    assert "no approximate setting differs" in words_of(error)
    others = {**result, "exact": None, "exact_switches_faster": None, "points": points[4:]}
    switches, error = plots.plot_settings(tmp_path / "b.svg", others, "a title")
    assert "no exact switch was measured" in words_of(switches)
    assert not any(word.startswith("exact: ") for word in words_of(error))


def test_labels_cover_nothing() -> None:
    rng = np.random.default_rng(5)
    frame = np.array([0.0, 0.0, 700.0, 450.0])
    crowds = [rng.uniform((50, 50), (650, 400), (20, 2)), rng.normal((300, 100), (12, 40), (12, 2))]
    for points in [*crowds, np.full((4, 2), 200.0), np.array([[1.0, 1.0], [699.0, 449.0]])]:
        sizes = np.array([(rng.uniform(60, 170), 16.0) for _ in points])
        line = np.array([[(300.0, 0.0), (300.0, 450.0)]])
        places, again = place_labels(points, sizes, frame, line), place_labels(points, sizes, frame, line)
        boxes = np.array([place.box for place in places])
        leaders = np.array([place.leader for place in places if place.leader is not None]).reshape(-1, 2, 2)
        np.testing.assert_array_equal(boxes, [place.box for place in again])
        np.testing.assert_allclose(boxes[:, 2:] - boxes[:, :2], sizes)
        assert ((boxes[:, :2] >= frame[:2]) & (boxes[:, 2:] <= frame[2:])).all()
        np.testing.assert_array_equal(shared(boxes, boxes) > 0, np.eye(len(points), dtype=bool))
        inside = (boxes[:, None, :2] < points) & (points < boxes[:, None, 2:])
        assert not inside.all(axis=2).any()
        assert not crossed(boxes, leaders).any()
        apart = np.linalg.norm(points.clip(boxes[:, :2], boxes[:, 2:]) - points, axis=1) > LEADER_LINE_DISTANCE_PX
        assert [place.leader is not None for place in places] == apart.tolist()


def test_too_many_labels_have_a_place_each() -> None:
    points, sizes = np.full((6, 2), (50.0, 20.0)), np.full((6, 2), (60.0, 16.0))
    places = place_labels(points, sizes, np.array([0.0, 0.0, 100.0, 40.0]), np.zeros((0, 2, 2)))
    assert len(places) == 6


@pytest.mark.parametrize(
    ("segment", "goes_through"),
    [
        (((0, 0), (4, 3)), True),
        (((0, 2), (5, 2)), True),
        (((2, 2), (2.5, 2.5)), True),
        (((0, 0), (0, 9)), False),
        (((0, 0), (1, 1)), False),  # ends at the corner
        (((0, 3), (5, 3)), False),  # along the edge
        (((0, 3), (3, 6)), False),
    ],
)
def test_segments_through_a_box(segment: tuple[tuple[float, float], ...], goes_through: bool) -> None:
    assert crossed(np.array([[1.0, 1.0, 4.0, 3.0]]), np.array([segment], float)).item() is goes_through


@pytest.mark.slow
@pytest.mark.needs("matplotlib")
@pytest.mark.usefixtures("_quick")
def test_verb_plots(tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    some = {"exact": RASTERIZER_PRESETS["exact"], "fast": RASTERIZER_PRESETS["fast"]}
    monkeypatch.setattr(tradeoff, "settings", lambda: some)
    path = tmp_path / "plot.svg"
    files = tmp_path / "plot-switches.svg", tmp_path / "plot-error.svg"
    told = printed(capsys, ["bench", *SMALL, "--plot", path, "--json"])
    result = json.loads(told.out)["settings"]
    assert [(point["name"], point["approximate"]) for point in result["points"]] == [("exact", False), ("fast", True)]
    assert result["exact"] == "exact"
    for file in files:
        assert file.exists()
        assert f"plot in {file}\n" in told.err
    assert not path.exists()
    for file, other in (files, files[::-1]):
        other.unlink(missing_ok=True)
        file.write_bytes(b"precious")
        assert main(["bench", *SMALL, "--plot", str(path)]) == 2
        said = f"clsplat: error: {file}: exists already; name another file, or give --overwrite to replace it\n"
        assert capsys.readouterr() == ("", said)
        assert file.read_bytes() == b"precious"
        assert not other.exists()
    assert main(["bench", *SMALL, "--plot", str(path), "--overwrite"]) == 0
    assert all(file.read_bytes().startswith(b"<?xml") for file in files)


def test_plot_without_matplotlib(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    refuses(r"pip install 'clsplat\[plot\]'", plots.check_plot, tmp_path / "a.svg")
    rejected(capsys, ["bench", *SMALL, "--plot", tmp_path / "a.svg"])

# SPDX-License-Identifier: Apache-2.0
"""`clsplat compare`: the figures of several runs, in a table, a page and JSON."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, printed, train
from pages import charts_of, figures_of, parse, rows_of
from tiny import short

from clsplat.cli.main import main
from clsplat.report.compare import _labels
from clsplat.runs.run import Run


@pytest.fixture(scope="module")
def runs(reported: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three of one name: a finished one, a shorter one with other settings, one that has no evaluation yet."""
    folder = tmp_path_factory.mktemp("compared")
    first = shutil.copytree(reported, folder / "a" / "run")
    second = folder / "b" / "run"
    assert train(scene, second, short(iterations=20, eval_at=(10,), density={"split_factor": 2.0})) == 0
    third = shutil.copytree(reported, folder / "c" / "run")
    (third / "eval.json").unlink()
    lines = (third / "metrics.jsonl").read_text().splitlines(keepends=True)
    (third / "metrics.jsonl").write_text("".join(lines[:2]))
    return [first, second, third]


def compare(runs: list[Path], path: Path) -> str:
    assert main(["compare", *map(str, runs), "-o", str(path)]) == 0
    return path.read_text("utf-8")


def evaluation(run: Path) -> dict:
    return json.loads((run / "eval.json").read_text())


def test_the_page_has_the_runs_figures(runs: list[Path], tmp_path: Path) -> None:
    root = parse(compare(runs, tmp_path / "page.html"))
    rows = rows_of(root, "runs")
    assert [row.one("th").words for row in rows] == ["a/run", "b/run", "c/run"]
    for row, run in zip(rows[:2], runs[:2], strict=True):
        of = evaluation(run)
        expected = [of["step"], of["mean"]["psnr"], of["mean"]["ssim"], of["gaussians"], of["seconds"]]
        assert row.values == list(map(repr, expected))
    last = Run.open(runs[2]).read_metrics()[-1]
    assert rows[2].values == ["20", str(last["gaussians"]), repr(last["seconds"])]
    best = max(runs[:2], key=lambda run: evaluation(run)["mean"]["psnr"])
    marked = [row.one("th").words for row in rows if "best" in row.all("td")[1].attributes["class"]]
    assert marked == [f"{best.parent.name}/run"]
    assert "c/run: Not finished: the run is at step 20 of 40" in root.one("ul", id="notes").words
    assert [each["run"] for each in figures_of(root)["runs"]] == ["a/run", "b/run", "c/run"]
    views = {row.all("td")[0].words: row.values for row in rows_of(root, "views")}
    for index, name in enumerate(("00.png", "08.png")):
        assert views[name] == [repr(evaluation(run)["views"][index]["psnr"]) for run in runs[:2]]


def test_a_page_that_is_there_is_replaced_only_if_asked(runs: list[Path], tmp_path: Path, capsys: Capture) -> None:
    page = tmp_path / "page.html"
    page.write_bytes(b"precious")
    call = ["compare", *map(str, runs), "-o", str(page)]
    assert main(call) == 2
    said = f"clsplat: error: {page}: exists already; name another file, or give --overwrite to replace it\n"
    assert capsys.readouterr() == ("", said)
    assert page.read_bytes() == b"precious"
    assert main([*call, "--overwrite"]) == 0
    assert page.read_text("utf-8").startswith("<!DOCTYPE html>")


def test_curves_are_overlaid(runs: list[Path], tmp_path: Path) -> None:
    charts = charts_of(parse(compare(runs, tmp_path / "page.html")))
    for label, run in zip(("a/run", "b/run", "c/run"), runs, strict=True):
        records = Run.open(run).read_metrics()
        grown = [(each["step"], each["gaussians"]) for each in records]
        np.testing.assert_allclose(charts["Number of Gaussians"][label], grown, rtol=1e-6)  # seven digits are written
        measured = [each["eval"] for each in records if "eval" in each]
        measured += [evaluation(run)] if (run / "eval.json").exists() else []
        against = [(each["seconds"], each["mean"]["psnr"]) for each in measured]
        np.testing.assert_allclose(charts["Time against error"][label], against, rtol=1e-6)


def test_settings_that_differ_and_no_others(runs: list[Path], tmp_path: Path, capsys: Capture) -> None:
    root = parse(compare(runs, tmp_path / "page.html"))
    rows = {row.all("td")[0].words: [cell.words for cell in row.all("td")[1:]] for row in rows_of(root, "settings")}
    assert rows["--density.split-factor"] == ["1.6", "2", "1.6"]
    assert set(rows) == {"--iterations", "--eval-at", "--stages-every", "--density.split-factor"}
    table = capsys.readouterr().out
    assert table.splitlines()[0].split() == ["run", "steps", "PSNR", "SSIM", "Gaussians", "training"]
    assert f"{evaluation(runs[0])['mean']['psnr']:.2f}" in table
    assert "--density.split-factor" in table
    compare([runs[0], runs[0]], tmp_path / "same.html")
    assert "None." in (tmp_path / "same.html").read_text()


def test_json(runs: list[Path], capsys: Capture) -> None:
    said = json.loads(printed(capsys, ["compare", *runs, "--json"]).out)
    assert [each["mean"] for each in said["runs"][:2]] == [evaluation(run)["mean"] for run in runs[:2]]
    assert said["runs"][2]["mean"] is None
    assert said["settings"]["--density.split-factor"] == [1.6, 2.0, 1.6]


def test_what_cannot_be_compared_is_said(runs: list[Path], tmp_path: Path, capsys: Capture) -> None:
    other = shutil.copytree(runs[0], tmp_path / "other")
    of = evaluation(other)
    of["views"][0]["name"] = "else.png"
    (other / "eval.json").write_text(json.dumps(of))
    text = (other / "config.toml").read_text()
    text = text.replace("/scene", "/another").replace("resolution = 0", "resolution = 20")
    (other / "config.toml").write_text(text)
    metrics = (other / "metrics.jsonl").read_text()
    (other / "metrics.jsonl").write_text(metrics.replace('"device": "', '"device": "another '))
    said = printed(capsys, ["compare", runs[0], other]).err
    for text in ("different scenes: another, scene", "same views", "--resolution differs", "different devices"):
        assert text in said


def test_runs_have_names_that_tell_them_apart() -> None:
    assert _labels([Path("/x/a"), Path("/x/b")]) == ["a", "b"]
    assert _labels([Path("/x/a/run"), Path("/x/b/run")]) == ["a/run", "b/run"]
    assert _labels([Path("/x/a"), Path("/x/a")]) == ["1 a", "2 a"]

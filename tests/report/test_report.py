# SPDX-License-Identifier: Apache-2.0
"""report.html: its figures are those of the run's files, it needs nothing else, and says what is missing."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import Capture, raising, rejected, train
from pages import charts_of, figures_of, outside_of, parse, rows_of
from systems import links
from tiny import CONFIG, run_steps, short

from clsplat.cli.main import main
from clsplat.device.context import Device
from clsplat.errors import ClsplatError
from clsplat.gaussians import Gaussians
from clsplat.images.writing import write_image
from clsplat.reference.render import render_grad
from clsplat.report import page as report_page
from clsplat.report import thumbnails
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.training import telemetry
from clsplat.training.trainer import Trainer

SCRIPT = "<script>alert(1)</script>"


@pytest.fixture
def copied(reported: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(reported, tmp_path / "run"))


def report(run: Path, *more: str) -> str:
    """The page that the command line writes."""
    assert main(["report", str(run), *more]) == 0
    return (run / "report.html").read_text("utf-8")


def notes(html: str) -> str:
    found = parse(html).all("ul", id="notes")
    return found[0].words if found else ""


# What it says


def test_figures_are_those_of_the_files(reported: Path) -> None:
    html = (reported / "report.html").read_text("utf-8")
    root, run = parse(html), Run.open(reported)
    evaluation, records = json.loads(run.eval_path.read_text()), run.read_metrics()
    rows = [[each.all("td")[0].words, *each.values] for each in rows_of(root, "views")]
    expected = [[view["name"], repr(view["psnr"]), repr(view["ssim"])] for view in evaluation["views"]]
    assert rows == [*expected, ["mean", repr(evaluation["mean"]["psnr"]), repr(evaluation["mean"]["ssim"])]]
    shown = root.one("dl", id="summary").values
    wanted = [*evaluation["mean"].values(), evaluation["gaussians"], evaluation["step"], evaluation["seconds"]]
    assert shown == list(map(repr, wanted))

    figures = figures_of(root)
    assert figures["evaluation"] == evaluation
    for name, values in figures["curves"].items():
        assert values == [record[name] for record in records]
    assert [each["ms"] for each in figures["stages"]] == [record["stages"] for record in records]
    assert figures["model"]["sha256"] == hashlib.sha256(run.model_path.read_bytes()).hexdigest()
    assert notes(html) == ""


def test_another_evaluation_is_in_it(copied: Path, capfd: Capture) -> None:
    """`clsplat eval RUN` writes eval.json anew, here of every second view; a run without a report gets none."""
    assert main(["eval", str(copied), "--test-every", "2"]) == 0
    evaluation = json.loads((copied / "eval.json").read_text())
    assert figures_of(parse((copied / "report.html").read_text("utf-8")))["evaluation"] == evaluation
    assert len(evaluation["views"]) > 2
    (copied / "report.html").unlink()
    assert main(["eval", str(copied)]) == 0
    assert not (copied / "report.html").exists()


def test_curves_are_drawn_by_those_figures(reported: Path) -> None:
    charts = charts_of(parse((reported / "report.html").read_text("utf-8")))
    records = Run.open(reported).read_metrics()
    evaluation = json.loads((reported / "eval.json").read_text())
    steps = [record["step"] for record in records]
    for title, series, name in (
        ("Loss", "training view", "loss"),
        ("PSNR", "training view", "psnr"),
        ("Number of Gaussians", "Gaussians", "gaussians"),
    ):
        expected = [(record["step"], record[name]) for record in records]
        np.testing.assert_allclose(charts[title][series], expected, rtol=1e-6)  # seven digits are written
    held_out = [(r["step"], r["eval"]["mean"]["psnr"]) for r in records if "eval" in r]
    held_out.append((evaluation["step"], evaluation["mean"]["psnr"]))
    np.testing.assert_allclose(charts["PSNR"]["held-out views"], held_out, rtol=1e-6)
    against = [(r["eval"]["seconds"], r["eval"]["mean"]["psnr"]) for r in records if "eval" in r]
    against.append((evaluation["seconds"], evaluation["mean"]["psnr"]))
    np.testing.assert_allclose(charts["Time against PSNR"]["held-out views"], against, rtol=1e-6)
    stacked = charts["Time per stage"]
    for index, record in enumerate(records):
        total = sum(points[index][1] for points in stacked.values())
        assert total == pytest.approx(record["stages"]["all"], rel=1e-4)  # differences of seven digits
    assert {points[0][0] for points in stacked.values()} == {steps[0]}


def test_histograms_count_every_gaussian(reported: Path) -> None:
    charts = charts_of(parse((reported / "report.html").read_text("utf-8")))
    model = Gaussians.load(reported / "model.ply")
    contributions = Run.open(reported).read_metrics()[-1]["contributions"]
    for title, name in (("Scales", "largest scale"), ("Scales", "smallest scale"), ("Opacity", "opacity")):
        assert sum(y for _, y in charts[title][name][:-1]) == len(model)
    assert sum(contributions["counts"]) + contributions["none"] == len(model)
    assert [y for _, y in charts["Contribution"]["contribution"][:-1]] == contributions["counts"]
    edges, counts = (np.array(each) for each in zip(*charts["Opacity"]["opacity"], strict=True))
    middle = np.average(edges[:-1] + 0.0125, weights=counts[:-1])
    assert middle == pytest.approx(np.mean(1 / (1 + np.exp(-model.opacity_logits))), abs=0.0125)  # half a bin


def test_settings_that_differ_are_listed_by_themselves(reported: Path) -> None:
    root = parse((reported / "report.html").read_text("utf-8"))
    changed = {row.all("td")[0].words: [cell.words for cell in row.all("td")[1:]] for row in rows_of(root, "changed")}
    assert changed["--iterations"] == ["40", "30000"]
    assert changed["--density.every"] == ["5", "100"]
    assert changed["--eval-at"] == ["10, 30", "none"]
    assert "--seed" not in changed
    every = {row.all("td")[0].words: row.attributes.get("class") for row in rows_of(root, "settings")}
    assert {name for name, kind in every.items() if kind == "differs"} == set(changed)
    assert every["--seed"] is None


def test_it_says_where_and_with_what(reported: Path, default_device: Device) -> None:
    rows = rows_of(parse((reported / "report.html").read_text("utf-8")), "machine")
    table = {row.one("th").words: row.one("td").words for row in rows}
    assert default_device.name in table["device"]
    assert table["driver"] in default_device.driver
    assert f"numpy {np.__version__}" in table["versions"]
    assert table["seed"] == "0"
    assert table["its SHA-256"] == hashlib.sha256((reported / "model.ply").read_bytes()).hexdigest()


def test_pictures_are_the_photograph_and_the_render(reported: Path, scene: Path) -> None:
    root = parse((reported / "report.html").read_text("utf-8"))
    first = root.all("figure", class_="view")[0]
    photo, render, error = (image.attributes["src"] for image in first.all("img"))
    view = load_scene(scene).test_views[0]
    assert photo == thumbnails.data_uri(view.load())
    assert render == thumbnails.data_uri(thumbnails.read_image(reported / "test" / "00.png"))
    difference = np.abs(view.load() - thumbnails.read_image(reported / "test" / "00.png")).mean(axis=2)
    assert error == thumbnails.data_uri(thumbnails.error_colors(difference))


# That it needs nothing else


@pytest.mark.needs("html5lib")
@pytest.mark.parametrize("kind", ["report", "compare"])
def test_it_is_one_valid_file_for_everybody(kind: str, reported: Path, tmp_path: Path) -> None:
    import html5lib

    path = tmp_path / "page.html"
    runs = [str(reported)] * (2 if kind == "compare" else 1)
    assert main([kind, *runs, "-o", str(path)]) == 0
    html = path.read_text("utf-8")
    html5lib.HTMLParser(strict=True).parse(html)  # raises what is no HTML
    assert outside_of(html) == []
    root = parse(html)
    ids = re.findall(r'\bid="([^"]*)"', html)
    assert len(ids) == len(set(ids))
    for image in root.all("img"):
        assert image.attributes["alt"]
    for labelled in [*root.all("input"), *root.all("svg")]:
        assert labelled.attributes["aria-label"]
    assert root.one("html").attributes["lang"] == "en"
    assert "prefers-color-scheme: dark" in html
    assert str(Path.home()) not in html
    assert str(reported.parent) not in html, "a report is sent to others"


def test_what_files_say_is_escaped(copied: Path, scene: Path) -> None:
    evil = copied.with_name("<b>&\"'")
    copied.rename(evil)
    evaluation = json.loads((evil / "eval.json").read_text())
    evaluation["views"][0]["name"] = f"../{SCRIPT}.png"
    evaluation["views"][1]["name"] = f"{SCRIPT}\ud800.png"
    (evil / "eval.json").write_text(json.dumps(evaluation))
    lines = (evil / "metrics.jsonl").read_text().splitlines()
    record = json.loads(lines[0])
    record["session"] = dict.fromkeys(("device", "driver", "started", "shape", "system", "kind"), SCRIPT)
    record["session"]["versions"] = {SCRIPT: SCRIPT, "</script>": "<!--"}
    record["stages"] = {SCRIPT: 1.0, "all": 2.0}
    (evil / "metrics.jsonl").write_text("\n".join([json.dumps(record), *lines[1:]]))
    for html in (report(evil), compared(evil, evil)):
        assert "<script>alert" not in html
        assert "<b>" not in html
        assert html.count("<script") == html.count("</script>") == 2
        parse(html)
    assert SCRIPT in parse(report(evil)).words


def compared(*runs: Path) -> str:
    path = runs[0] / "compare.html"
    assert main(["compare", *map(str, runs), "-o", str(path)]) == 0
    return path.read_text("utf-8")


@links
def test_no_picture_outside_of_the_run_is_shown(copied: Path) -> None:
    write_image(copied / "secret.png", np.ones((40, 48, 3), np.float32))
    (copied / "test" / "link.png").symlink_to(copied / "secret.png")
    evaluation = json.loads((copied / "eval.json").read_text())
    for name in ("../secret.png", str(copied / "secret.png"), "link.png", "", "..", "a\0b.png"):
        evaluation["views"] = [{"name": name, "psnr": 1.0}]
        (copied / "eval.json").write_text(json.dumps(evaluation))
        html = report(copied)
        assert "<img" not in html, name
        assert "1 renders of held-out views are missing in test/" in notes(html)


# What is missing


@links
def test_the_plan_of_blocks_is_an_image_without_scripts(copied: Path, tmp_path: Path) -> None:
    assert parse(report(copied)).all("figure", id="plan") == []
    svg = f'<svg xmlns="http://www.w3.org/2000/svg">{SCRIPT}</svg>'
    (copied / "plan.svg").write_text(svg, "utf-8")
    html = report(copied)
    assert SCRIPT not in html
    source = re.search(r'<figure class="plan" id="plan"><img src="data:image/svg\+xml;base64,([^"]*)"', html)
    assert source is not None and base64.b64decode(source[1]).decode() == svg
    (copied / "plan.svg").rename(tmp_path / "away.svg")
    (copied / "plan.svg").symlink_to(tmp_path / "away.svg")
    assert 'id="plan"' not in report(copied)


def test_views_beyond_the_limit_are_counted(copied: Path) -> None:
    html = report(copied, "--views", "1")
    assert html.count('<figure class="view') == 1
    assert "1 of 2 views are left out" in html
    assert len(rows_of(parse(html), "views")) == 3
    assert "<img" not in report(copied, "--views", "0")


def test_the_worst_and_the_best_views_are_shown() -> None:
    scores = [30.0, 20.0, None, 35.0, 25.0, 28.0]
    assert thumbnails.chosen(scores, 2) == [1, 2], "no score is the last"
    assert thumbnails.chosen([30.0, 20.0, 35.0, 25.0, 28.0, 29.0], 3) == [1, 2, 4], (
        "of six the lowest, third and highest"
    )
    assert thumbnails.chosen([5.0, 1.0, 9.0, 3.0, 7.0], 3) == [0, 1, 2]
    assert thumbnails.chosen(scores, 6) == list(range(6))


def test_an_unfinished_run_has_a_report(scene: Path, tmp_path: Path, copied: Path, capfd: Capture) -> None:
    run = Run.create(tmp_path / "new", CONFIG, scene=scene)
    said = notes(report(run.path))
    for text in (
        "Not finished: the run is at step 0 of 40",
        "eval.json is missing",
        "model.ply is missing",
        "no records",
    ):
        assert text in said
    assert "Not finished: the run is at step 0 of 40" in capfd.readouterr().err
    (copied / "eval.json").unlink()
    (copied / "model.ply").unlink()
    lines = (copied / "metrics.jsonl").read_text().splitlines(keepends=True)
    (copied / "metrics.jsonl").write_text("".join(lines[:2]) + '{"step": 30, "lo')
    html = report(copied)
    assert "Not finished: the run is at step 20 of 40" in notes(html)
    assert figures_of(parse(html))["curves"]["step"] == [10, 20]


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"views": 3}', '{"views": [{"name": 4}]}', "[" * 100_000])
def test_a_damaged_evaluation_is_said_and_left_out(text: str, copied: Path) -> None:
    (copied / "eval.json").write_text(text)
    html = report(copied)
    assert "eval.json is damaged" in notes(html)
    assert 'id="views"' not in html


def test_figures_that_are_none_are_left_out(copied: Path) -> None:
    record = {"step": 50, "loss": 0.1, "psnr": 9.0, "gaussians": 5, "seconds": 9.0}
    bad: list[Any] = ["x", None, True, 10**400, float("nan"), float("inf"), [], {}]
    odd = [{**record, name: value} for name in list(record)[1:] for value in bad]
    shapes = [*bad, {"all": "x"}, {"views": [{}]}, {"edges": [2, 1], "counts": [1], "versions": 3}]
    keys = ("stages", "eval", "session", "contributions", "elapsed")
    odd += [{**record, "step": 50 + index, key: shape} for key in keys for index, shape in enumerate(shapes)]
    with open(copied / "metrics.jsonl", "a") as file:
        file.writelines(json.dumps(each) + "\n" for each in odd)
    figures = figures_of(parse(report(copied)))
    assert figures["curves"]["step"][:5] == [10, 20, 30, 40, 50]
    assert np.isfinite([figures["curves"][name] for name in record]).all()
    model = json.loads((copied / "eval.json").read_text())
    model["mean"] = {"psnr": "high", "ssim": 1e999}
    (copied / "eval.json").write_text(json.dumps(model))
    assert figures_of(parse(report(copied)))["evaluation"]["mean"] == {}


def test_without_the_scene_there_are_renders_alone(copied: Path) -> None:
    text = (copied / "config.toml").read_text()
    (copied / "config.toml").write_text(re.sub(r"(?m)^scene = .*$", 'scene = "/nowhere/gone"', text))
    html = report(copied)
    assert "shown without photographs: the scene cannot be read (gone: no such folder" in notes(html)
    assert len(parse(html).all("img")) == 2
    assert "nowhere" not in html


def test_json_and_another_file(copied: Path, tmp_path: Path, capfd: Capture) -> None:
    before = (copied / "report.html").read_bytes()
    path = tmp_path / "sent.html"
    capfd.readouterr()
    assert main(["report", str(copied), "-o", str(path), "--json"]) == 0
    said = json.loads(capfd.readouterr().out)
    assert said["evaluation"] == json.loads((copied / "eval.json").read_text())
    assert said["settings"]["iterations"] == 40
    assert said["curves"]["step"] == [10, 20, 30, 40]
    assert path.read_text("utf-8").startswith("<!DOCTYPE html>")
    assert (copied / "report.html").read_bytes() == before


def test_a_page_that_is_there_is_replaced_only_if_asked(copied: Path, tmp_path: Path, capsys: Capture) -> None:
    page, own = tmp_path / "sent.html", copied / "report.html"
    for output in (page, own, copied / "model.ply"):
        output.write_bytes(b"precious")
        assert main(["report", str(copied), "-o", str(output)]) == 2
        said = f"clsplat: error: {output}: exists already; name another file, or give --overwrite to replace it\n"
        assert capsys.readouterr().err == said
        assert output.read_bytes() == b"precious"
    assert main(["report", str(copied), "-o", str(page), "--overwrite"]) == 0
    assert main(["report", str(copied)]) == 0, "the run's own, which nobody named"
    assert page.read_text("utf-8").startswith("<!DOCTYPE html>")
    assert own.read_text("utf-8").startswith("<!DOCTYPE html>")


def test_wrong_calls_are_one_line(reported: Path, tmp_path: Path, capsys: Capture) -> None:
    for call, words in (
        (["report", str(tmp_path)], "not a run"),
        (["report", str(tmp_path / "none")], "no such folder, expected a run"),
        (["report", str(reported / "model.ply")], "no such folder, expected a run"),
        (["report", str(reported), "-o", str(tmp_path / "a" / "b.html")], "expected an existing one for b.html"),
        (["report", str(reported), "-o", str(tmp_path)], "is a folder, expected the name of a file"),
        (
            ["report", str(reported), "-o", str(tmp_path / "x.txt")],
            "x.txt: its ending is .txt, expected .html or .htm for a web page",
        ),
        (["report", str(reported), "-o", str(tmp_path / "page")], "page: its ending is none, expected .html or .htm"),
        (
            ["compare", str(reported), str(reported), "-o", str(tmp_path / "x.json")],
            "x.json: its ending is .json, expected .html or .htm",
        ),
        (["report", str(reported), "--views", "-1"], "--views -1: expected at least 0"),
        (["compare", str(reported)], "expected at least two runs"),
        (["compare", str(reported), str(tmp_path)], "not a run"),
    ):
        assert words in rejected(capsys, call)
    assert not list(tmp_path.iterdir())


# What training does for it


def test_training_is_the_same_with_it_and_without(
    scene: Path, reported: Path, trained: Path, tmp_path: Path, capfd: Capture
) -> None:
    assert (reported / "model.ply").read_bytes() == (trained / "model.ply").read_bytes()
    run = tmp_path / "run"  # contributions of step 20, and then on
    assert train(scene, run, short(iterations=20, stages_every=0)) == 0
    assert main(["train", "-o", str(run), "--resume", "--iterations", "40", "--no-report"]) == 0
    assert (run / "model.ply").read_bytes() == (trained / "model.ply").read_bytes()
    records = Run.open(run).read_metrics()
    assert [each["session"]["from_step"] for each in records if "session" in each] == [0, 20]
    assert ["contributions" in each for each in records] == [False, True, False, False]
    assert not any("stages" in each for each in records)
    capfd.readouterr()


def test_a_report_that_fails_does_not_fail_the_training(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Capture
) -> None:
    monkeypatch.setattr(report_page, "write_report", raising(ClsplatError("no room")))
    assert train(scene, tmp_path / "run", short(iterations=5)) == 0
    assert "warning: report.html was not written (no room); try again with: clsplat report" in capfd.readouterr().err
    assert (tmp_path / "run" / "eval.json").exists()


def test_contributions_are_the_references(scene: Path, device: Device) -> None:
    trainer = Trainer(load_scene(scene), short(stages_every=0), device)
    run_steps(12, trainer)
    found, looked = telemetry.largest_contributions(trainer, 1e9)
    assert looked == len(trainer.views) == 8
    model = trainer.gaussians()
    expected = np.zeros(len(model))
    for view in trainer.views:
        camera = view.camera
        gradients = render_grad(model, camera, np.zeros((camera.height, camera.width, 3)))
        expected = np.maximum(expected, gradients.contributions)
    # sums of up to 1920 weights in float32, and alphas near the threshold of 1/255 that fall to either side of it
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=0.01)
    counted = telemetry.contributions(trainer, 1e9)
    assert sum(counted["counts"]) + counted["none"] == len(model)


def test_views_are_looked_at_far_apart_first() -> None:
    assert telemetry._spread(8) == [0, 4, 2, 6, 1, 5, 3, 7]
    assert telemetry._spread(1) == [0]
    assert sorted(telemetry._spread(11)) == list(range(11))

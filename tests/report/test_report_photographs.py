# SPDX-License-Identifier: Apache-2.0
"""The report's part about the photographs: masks drawn over them, and the exposures that were learnt."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import train
from pages import charts_of, parse
from tiny import HEIGHT, VIEWS, WIDTH, short, write_scene

from clsplat.cli.main import main
from clsplat.config.masks import MaskUse
from clsplat.evaluation.depths import DEPTH_PICTURE_VIEWS, FARTHEST_DEPTH_GREY, coloured, depth_picture, keep_depths
from clsplat.gaussians import Gaussians
from clsplat.images.writing import write_image
from clsplat.report.photographs import MAX_MASKED_PHOTOGRAPHS, masked_photographs
from clsplat.runs.run import Run, owned_files
from clsplat.scenes.analysis.mask_overlay import (
    IGNORED_OVERLAY_RGB,
    MASK_OVERLAY_OPACITY,
    TRANSPARENT_OVERLAY_RGB,
    masked,
)
from clsplat.scenes.loading import load_scene


def with_masks(folder: Path) -> Path:
    """The tiny scene with masks whose left half is black, for all views but the first."""
    scene = write_scene(folder)
    (scene / "masks").mkdir()
    mask = np.ones((HEIGHT, WIDTH, 3), np.float32)
    mask[:, : WIDTH // 2] = 0
    for index in range(1, VIEWS):
        write_image(scene / "masks" / f"{index:02d}.png", mask)
    return scene


@pytest.mark.parametrize(
    ("meaning", "colour"), [("ignore", IGNORED_OVERLAY_RGB), ("transparent", TRANSPARENT_OVERLAY_RGB)]
)
def test_what_is_left_out_is_coloured(tmp_path: Path, meaning: str, colour: tuple[float, float, float]) -> None:
    scene = with_masks(tmp_path / "scene")
    plain = load_scene(scene).views[1].load()
    picture = masked(load_scene(scene, masks=MaskUse(meaning)).views[1], WIDTH, HEIGHT)  # type: ignore[arg-type]
    assert picture.left_out == 0.5
    drawn, half = picture.drawn(), WIDTH // 2
    assert (drawn[:, half:] == plain[:, half:]).all()
    wanted = plain[:, :half] + MASK_OVERLAY_OPACITY * (np.array(colour, np.float32) - plain[:, :half])
    assert np.abs(drawn[:, :half] - wanted).max() < 1e-6


def test_some_are_shown_and_all_are_counted(tmp_path: Path) -> None:
    scene = load_scene(with_masks(tmp_path / "scene"), masks=MaskUse("ignore"))
    shown, count = masked_photographs(scene, only_files=True)
    assert count == VIEWS - 1
    assert len(shown) == min(MAX_MASKED_PHOTOGRAPHS, count)
    assert all(each.left_out == 0.5 and each.name != "00.png" for each in shown)
    assert masked_photographs(load_scene(tmp_path / "scene"), only_files=True) == ([], 0)


def test_a_run_with_masks_shows_them(tmp_path: Path) -> None:
    scene, run = with_masks(tmp_path / "scene"), tmp_path / "run"
    assert train(scene, run, short(iterations=2), "--masks", "ignore") == 0
    root = parse((run / "report.html").read_text("utf-8"))
    figures = root.one("div", id="masks").all("figure")
    assert len(figures) == min(MAX_MASKED_PHOTOGRAPHS, VIEWS - 1)
    assert "50 % left out" in figures[0].words
    assert "red is ignored" in root.words
    assert "blue is transparent" not in root.words


def test_exposures_are_a_chart(reported: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(reported, tmp_path / "run"))
    gains = {f"{index:02d}.png": {"log2_gains": [0.5 * index, 0.0, -0.25]} for index in range(3)}
    (run / "appearance.json").write_text(json.dumps({"kind": "exposure", "photographs": gains}))
    assert main(["report", str(run)]) == 0
    drawn = charts_of(parse((run / "report.html").read_text("utf-8")))["Exposure of the photographs"]
    assert drawn["red"] == [(1.0, 0.0), (2.0, 0.5), (3.0, 1.0)]
    assert drawn["blue"] == [(1.0, -0.25), (2.0, -0.25), (3.0, -0.25)]
    assert "Corners get" not in (run / "report.html").read_text("utf-8")
    gains["00.png"]["vignette"] = [-0.5, 0.0, -0.5]
    (run / "appearance.json").write_text(json.dumps({"kind": "ppisp", "photographs": gains}))
    assert main(["report", str(run)]) == 0
    assert "Corners get 50% of the light in the middle" in (run / "report.html").read_text("utf-8")
    gains["00.png"]["vignette"] = [0.0, 0.0, 0.0]  # of a panorama
    (run / "appearance.json").write_text(json.dumps({"kind": "ppisp", "photographs": gains}))
    assert main(["report", str(run)]) == 0
    assert "Corners get" not in (run / "report.html").read_text("utf-8")
    bad = '{"photographs": {"a": {"log2_gains": [1, 2, 3], "vignette": 1}}}'
    for text in ("{}", '{"photographs": {"a": {"log2_gains": [1, 2]}}}', bad, "no JSON"):
        (run / "appearance.json").write_text(text)
        assert main(["report", str(run)]) == 0
        assert "Exposure of the photographs" not in charts_of(parse((run / "report.html").read_text("utf-8")))


def test_depth_is_light_where_it_is_near() -> None:
    depth = np.array([[1.0, 2.0, 3.0, 9.0]])
    picture = depth_picture(depth, np.array([[1.0, 1.0, 1.0, 0.2]]))[0, :, 0]
    assert picture[0] == 1
    assert 1 > picture[1] > picture[2] >= FARTHEST_DEPTH_GREY
    assert picture[3] == 0
    assert not depth_picture(depth, np.zeros((1, 4))).any()


def test_the_worst_views_have_photograph_render_and_depth(reported: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(reported, tmp_path / "run"))
    records = json.loads((run / "eval.json").read_text())["views"]
    assert len(list((run / "depth").glob("*.png"))) == min(DEPTH_PICTURE_VIEWS, len(records))
    figures = parse((run / "report.html").read_text("utf-8")).one("div", id="worst").all("figure")
    assert [len(figure.all("img")) for figure in figures] == [3] * min(DEPTH_PICTURE_VIEWS, len(records))
    least = min(records, key=lambda record: record["psnr"])["name"]
    assert figures[0].words.strip().startswith(least)
    model = Gaussians.load(run / "model.ply")
    camera = load_scene(Run.open(reported).scene or Path()).test_views[0].camera
    greys = coloured(model, camera).sh[:, 0, 0]
    depths = (model.means + model.origin - camera.position) @ camera.rotation[2]
    assert (np.diff(greys[np.argsort(depths)]) >= 0).all()
    around = replace(camera, projection="equirectangular")  # what is behind is as far as it is away
    greys = coloured(model, around).sh[:, 0, 0]
    distances = np.linalg.norm(model.means + model.origin - camera.position, axis=1)
    assert (np.diff(greys[np.argsort(distances)]) >= 0).all()
    keep_depths(lambda *_: (np.ones((2, 2, 3)), np.ones((2, 2))), model, [], [], run / "depth")
    assert not list((run / "depth").glob("*.png"))
    assert main(["report", str(run)]) == 0
    assert not parse((run / "report.html").read_text("utf-8")).all("div", id="worst")
    assert run / "depth" not in owned_files(reported)
    assert set((reported / "depth").glob("*.png")) <= set(owned_files(reported))

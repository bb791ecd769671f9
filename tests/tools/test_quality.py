# SPDX-License-Identifier: Apache-2.0
"""`tools/quality/run.py`: the scenes and settings of its experiments, and its answer to a scene that is none."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from calls import printed, python, refuses
from quality import camera_choices, experiments, made_scenes
from quality.experiments import EXPERIMENTS
from quality.run import main
from quality.tables import AUTO
from quality.trainings import words_of
from tiny import HEIGHT, VIEWS, WIDTH, write_scene

from clsplat.cli.main import parse
from clsplat.cli.train import TrainVerb
from clsplat.config.presets import scheduled
from clsplat.config.training import TrainConfig
from clsplat.demo.ray_caster import Floor, Wall, cameras, still_life
from clsplat.images.reading import read_image
from clsplat.scenes.analysis.photo_findings import Finding
from clsplat.scenes.analysis.recommendations import answered
from clsplat.scenes.loading import load_scene
from clsplat.scenes.sfm.captured_files import SFM_RECORD_FILE
from clsplat.scenes.sfm.reconstruct import SfmSettings

ROOT = Path(__file__).resolve().parents[2]
LEVEL = 1 / 255
"""The largest distance of two 8 bit pictures of the same values."""


def test_a_block_is_where_the_mask_is_and_other_pixels_stay(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    made = made_scenes.with_block(scene, tmp_path / "block", 1)
    other = made_scenes.with_block(scene, tmp_path / "other", 2)
    places = set()
    for index in range(VIEWS):
        name = f"{index:06d}.png"
        before = read_image(scene / "images" / f"{index:02d}.png")
        after = read_image(made / "images" / name)
        if index % 8 == 0:
            np.testing.assert_allclose(after, before, atol=LEVEL)
            assert not (made / "masks" / name).exists(), "a photograph that is held out"
            continue
        mask = read_image(made / "masks" / name)[:, :, 0] > 0.5
        assert (~mask).sum() == (WIDTH // 3) * (HEIGHT // 4)
        np.testing.assert_allclose(after[mask], before[mask], atol=LEVEL)
        again = read_image(other / "images" / name)
        assert np.abs(after - again)[~mask].mean() > 0.1, "other pixels of the block"
        np.testing.assert_array_equal(after[mask], again[mask])
        places.add(tuple(np.argwhere(~mask)[0]))
    assert len(places) == VIEWS - 2, "it moves"
    assert [view.name for view in load_scene(made).test_views] == ["000000.png", "000008.png"]


def test_things_are_cut_out_of_their_surroundings() -> None:
    things = [surface for surface in still_life() if not isinstance(surface, Floor | Wall)]
    for thing in things:
        thing.texture = np.full((thing.rows, thing.columns, 3), 0.5, np.float32)
    picture = made_scenes.cut_out(things, cameras(40, 32, 24, 0)[0])
    alpha = picture[:, :, 3]
    assert picture.shape == (24, 32, 4)
    assert set(np.unique(alpha)) == {0, 0.25, 0.5, 0.75, 1}, "four rays a pixel"
    inside = picture[alpha == 1][:, :3]
    ends = picture[(alpha > 0) & (alpha < 1)][:, :3]
    assert ends.min() >= inside.min() - 1e-5, "straight: no darker than inside, but for float32's products of alpha"
    assert not picture[alpha == 0].any()


def parsed(words: Sequence[str]) -> TrainConfig:
    verb = parse(["train", "scene", "-o", "run", *words])
    assert isinstance(verb, TrainVerb)
    return verb.config


def test_settings_of_a_row() -> None:
    assert parsed(words_of("", iterations=7000, resolution=None)) == scheduled("paper", 7000)
    settings = "schedule=short,iterations=2000,thinning=0.2,density.growth=budget,density.max-gaussians=100"
    short = scheduled("short", 2000)
    density = replace(short.density, growth="budget", max_gaussians=100)
    assert parsed(words_of(settings, iterations=7000)) == replace(short, thinning=0.2, density=density)
    assert words_of("antialiased=true,masks=ignore") == ["--antialiased", "--masks", "ignore"]


def test_the_table_tries_what_auto_takes() -> None:
    _, config = answered([Finding("few views", "few")], TrainConfig(iterations=7000))
    assert parsed(words_of(AUTO[1].removeprefix("auto:"), iterations=7000)) == config


SMALL_TOWN = ("--town", "1x1", "--town-photos", "16", "--town-size", "64x40", "--gaussians", "900")


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_an_experiment_makes_its_table(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(experiments, "PHOTOS", 9)
    monkeypatch.setattr(experiments, "WIDTH", 32)
    monkeypatch.setattr(experiments, "LEAST", 2)
    monkeypatch.setattr(camera_choices, "reconstruct", recorded)  # the tiny pictures have no features
    scenes = [str(write_binary(tmp_path / "scene"))] if EXPERIMENTS[name].scenes in (1, "+") or name == "poses" else []
    more = {
        "views": ["--views", "2,3"],
        "exposure": ["--appearance", "ppisp", "--mixes", "0.1"],
        "poses": ["--width", "40"],
        "towns": ["--towns", "1x1", "--scaled", "1x1", "--town-photos", "9", "--town-size", "32x20", "--own-block"],
        "blocks": [*SMALL_TOWN, "--blocks", "2"],
        "borders": [*SMALL_TOWN, "--blocks", "4", "--seeds", "0,1"],
    }
    words = [name, str(tmp_path / "out"), *scenes, "--iterations", "2", *more.get(name, ())]
    status = main(words)
    table = capsys.readouterr().out
    assert status == 0 or name == "units", table
    assert table.count("|---") >= 2
    assert printed(capsys, words, call=main, status=status).out == table, "runs that are there are not made again"


def recorded(_images: Path, scene: Path, settings: SfmSettings, *, threads: int | None) -> None:
    """Write the record of a reconstruction that placed eight of nine photographs."""
    seconds = {stage: {"wall": 2.0, "processor": 3.0} for stage in ("features", "matches", "cameras", "undistorting")}
    found = {"registered": ["a"] * 8, "photos": 9, "points": 7, "mean_reprojection_error": 0.5}
    scene.mkdir(parents=True, exist_ok=True)
    record = {**found, "matching": settings.matching, "pairs": 4 + (threads or 0), "seconds": seconds}
    (scene / SFM_RECORD_FILE).write_text(json.dumps(record))


def test_choices_of_cameras_are_settings() -> None:
    asked = camera_choices.settings_of("mapper=auto,matching=exhaustive", 3)
    assert asked == SfmSettings(mapper="auto", matching="exhaustive", seed=3)
    assert camera_choices.settings_of("auto", 0) == SfmSettings()
    assert camera_choices.settings_of("max_features=100", 0).max_features == 100
    refuses("'mappers' is no setting", camera_choices.settings_of, "mappers=global", 0)
    refuses("expected a number of features", camera_choices.settings_of, "max_features=all", 0)


def write_binary(folder: Path) -> Path:
    """The tiny scene with its COLMAP model in binary files."""
    sparse = write_scene(folder) / "sparse" / "0"
    pycolmap.Reconstruction(sparse).write_binary(sparse)
    for path in sparse.glob("*.txt"):
        path.unlink()
    return folder


def test_a_scene_that_is_none(tmp_path: Path) -> None:
    done = python(ROOT / "tools/quality/run.py", "masks", tmp_path / "out", tmp_path / "none")
    folder = tmp_path / "none" / "sparse" / "0"
    said = f"quality masks: error: {folder}: no such folder, expected a COLMAP scene\n"
    assert (done.returncode, done.stdout, done.stderr) == (2, "", said)

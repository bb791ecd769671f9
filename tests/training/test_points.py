# SPDX-License-Identifier: Apache-2.0
"""Trainings that start from a cloud, or with a sky."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, refuses, rejected, warned
from ring import write_cloud
from tiny import CONFIG, FEW, hidden_model, write_scene

from clsplat.cli.main import main
from clsplat.device.context import Device
from clsplat.runs.run import Run
from clsplat.scenes.loading import load_scene
from clsplat.training.preparation import begin
from clsplat.training.trainer import Trainer

WORDS = ("--iterations", "4", "--density.every", "0", "--resolution", "24")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("points") / "tiny")


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Means without colours."""
    path = tmp_path_factory.mktemp("cloud") / "cloud.ply"
    write_cloud(path, hidden_model(300).means)
    return path


def test_a_run_starts_from_the_cloud_and_goes_on(
    scene: Path, cloud: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(cloud.parent)
    points = ("--points", cloud.name, "--points-limit", "100")
    assert main(["train", str(scene), "-o", str(tmp_path / "whole"), *points, *WORDS]) == 0
    assert main(["train", str(scene), "-o", str(tmp_path / "two"), *points, *WORDS, "--iterations", "2"]) == 0
    monkeypatch.chdir(tmp_path)
    assert main(["train", "-o", str(tmp_path / "two"), "--resume", "--iterations", "4"]) == 0
    whole, two = (Run.open(tmp_path / name) for name in ("whole", "two"))
    assert 50 < whole.model_record()["gaussians"] <= 100
    assert whole.model_path.read_bytes() == two.model_path.read_bytes()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--points", "gone.ply"), "gone.ply: no such file, expected a cloud of points"),
        (("--points-use", "join"), "--points-use join: no points are given, expected --points FILE too"),
        (("--points-limit", "-1"), "--points-limit -1: expected at least 0"),
        (("--depth-unit", "0.01"), "--depth-unit 0.01: no depth maps are used, expected --depth maps too"),
        (("--pose-reach", "3"), "--pose-reach 3.0: poses are not refined, expected --refine-poses too"),
        (("--lens-reach", "3"), "--lens-reach 3.0: lenses are not refined, expected --refine-lenses too"),
        (("--appearance-rate", "0.1"), "--appearance-rate 0.1: no appearance is learnt, expected --appearance too"),
        (("--sky", "-1"), "--sky -1: expected at least 0"),
    ],
)
def test_calls_that_make_no_sense(
    scene: Path, tmp_path: Path, capsys: Capture, words: tuple[str, ...], said: str
) -> None:
    assert said in rejected(capsys, ["train", scene, "-o", tmp_path / "run", *words, *WORDS])
    assert not (tmp_path / "run").exists()


def test_a_cloud_that_changes_is_refused(scene: Path, tmp_path: Path, capsys: Capture) -> None:
    cloud, run = tmp_path / "cloud.ply", tmp_path / "run"
    hidden_model(50).save(cloud)
    assert main(["train", str(scene), "-o", str(run), "--points", str(cloud), *WORDS]) == 0
    hidden_model(60).save(cloud)
    capsys.readouterr()
    assert "other points (50 before, 60 now)" in rejected(capsys, ["train", "-o", run, "--resume", "--iterations", "5"])


def test_colours_come_from_the_photographs(scene: Path, cloud: Path) -> None:
    config = replace(FEW, points=str(cloud), points_use="join")
    read = load_scene(scene)
    got = warned("have no colours", begin, read, config, None, resume=False)
    assert len(got.points) == len(read.points) + 300
    assert np.ptp(got.point_colors[len(read.points) :], axis=0).min() > 0.05
    refuses(r"lost\.ply", begin, read, replace(FEW, points="lost.ply"), None, resume=False)


@pytest.mark.parametrize("unit", [1.0, 0.1])
def test_a_sky_is_not_pruned_for_its_size(default_device: Device, scene: Path, unit: float) -> None:
    """Its size follows the extent, and not the length unit, which is given here as a fraction of the extent."""
    read = load_scene(scene)
    read.unit = unit * read.extent
    config = replace(CONFIG, sky=2000, iterations=30)
    prepared = begin(read, config, None, resume=False)
    trainer = Trainer(prepared, config, default_device)
    while trainer.step < 30:  # with an opacity reset at 20
        trainer.train_step()
    far = np.linalg.norm(trainer.gaussians().means, axis=1) > 3 * prepared.extent
    sky = len(prepared.points) - len(read.points)
    assert sky > 100
    assert far.sum() >= 0.9 * sky, "some are transparent"

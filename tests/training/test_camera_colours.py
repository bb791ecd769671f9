# SPDX-License-Identifier: Apache-2.0
"""Gains and mixes of photographs and vignettes of lenses, learnt with the model."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from compare import assert_close
from tiny import CONFIG, write_scene

from clsplat.api import train
from clsplat.cli.main import main
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.models.edit import exposed
from clsplat.reference.ppisp import light, spread, unmixing
from clsplat.runs.appearance import gains_of
from clsplat.runs.checkpoints import Checkpoint
from clsplat.runs.run import Run
from clsplat.scenes.scene import Scene, load_scene
from clsplat.training.photographs import Photographs
from clsplat.training.ppisp import PpispOfAll
from clsplat.training.trainer import Trainer

OF_CAMERAS = replace(CONFIG, appearance="ppisp")
MIXES = np.array([0.15, 0.0, 0.0, 0.15, 0.15, 0.0])
CORNERS = -1.0
"""Octaves of light in the corners, along s."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return load_scene(write_scene(tmp_path_factory.mktemp("tiny") / "scene"))


def taken_otherwise(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> None:
    """Let photographs be float, mixed by MIXES and against them by turns, and dark in the corners."""
    plain = Photographs.load

    def load(self: Photographs, index: int, factor: float) -> np.ndarray:
        image = plain(self, index, factor)
        values = image / np.float32(255) if image.dtype == np.uint8 else image
        height, width, _ = values.shape
        camera = scene.train_views[index].camera
        centre = camera.cx / camera.width * width, camera.cy / camera.height * height
        values = values @ np.linalg.inv(unmixing(MIXES * (1 if index % 2 else -1))).T
        values = values * light(np.array([CORNERS, 0, 0]), spread(width, height, centre))[:, :, None]
        return np.ascontiguousarray(values, np.float32)

    monkeypatch.setattr(Photographs, "load", load)


@pytest.fixture(scope="module")
def learnt(scene: Scene, default_device: Device, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of such photographs."""
    density = replace(CONFIG.density, every=0)
    config = replace(OF_CAMERAS, iterations=400, density=density, warmup=())
    run = Run.create(tmp_path_factory.mktemp("runs") / "run", config)
    with pytest.MonkeyPatch.context() as patch:
        taken_otherwise(patch, scene)
        train(scene, config, device=default_device, run=run)
    return run


def test_mixes_and_vignettes_are_learnt(scene: Scene, learnt: Run) -> None:
    record = json.loads(learnt.appearance_path.read_text("utf-8"))
    assert record["kind"] == "ppisp"
    rows = [record["photographs"][view.name] for view in scene.train_views]
    vignettes = {tuple(row["vignette"]) for row in rows}
    assert len(vignettes) == 1, "one lens took all"
    assert abs(sum(next(iter(vignettes))) - CORNERS) < 0.4  # in the corners; all views look at one place
    mixes = np.array([row["mixes"] for row in rows])
    along = (np.where(np.arange(len(rows)) % 2, 1.0, -1.0)[:, None] * mixes)[:, MIXES > 0]
    assert along.mean(axis=0).min() > 0.03  # of 0.15; so few steps
    for view in scene.test_views:
        assert tuple(record["held_out"][view.name]["vignette"]) in vignettes


def test_a_model_with_the_colours_of_a_photograph(scene: Scene, learnt: Run, tmp_path: Path) -> None:
    """`render --appearance` has the matrix of the photograph, which is the inverse of what developing does."""
    name = scene.train_views[1].name
    row = json.loads(learnt.appearance_path.read_text("utf-8"))["photographs"][name]
    matrix = np.array(gains_of(learnt.path, name)).reshape(3, 3)
    developing = unmixing(np.array(row["mixes"])) @ np.diag(2.0 ** -np.array(row["log2_gains"]))
    assert_close(matrix @ developing, np.eye(3), absolute=1e-12)
    model = Gaussians.load(learnt.model_path)
    half, dc = 0.5, 0.28209479177387814
    colours, seen = (half + dc * each.sh[:, 0].astype(float) for each in (model, exposed(model, matrix.ravel())))
    assert_close(seen, colours @ matrix.T, absolute=5e-6)  # roundings of coefficients up to 8
    cameras, pattern = str(scene.train_views[1].path.parents[1]), f"{tmp_path}/{{name}}.png"
    assert main(["render", str(learnt.path), "--cameras", cameras, "-o", pattern, "--appearance", name]) == 0
    assert list(tmp_path.rglob("*.png"))


def test_held_out_views_are_seen_through_their_lens(scene: Scene, learnt: Run) -> None:
    """By `eval` as at the end of training, though nothing is learnt of these views."""
    before = json.loads(learnt.eval_path.read_text("utf-8"))["mean"]
    record = learnt.appearance_path.read_text("utf-8")
    folder = str(scene.train_views[0].path.parents[1])
    assert main(["eval", str(learnt.path), "--scene", folder]) == 0
    again = json.loads(learnt.eval_path.read_text("utf-8"))["mean"]
    assert again["psnr"] == pytest.approx(before["psnr"], abs=1e-3)  # of a model in a file, activated once more
    learnt.appearance_path.write_text(record.replace("vignette", "of another version"), "utf-8")
    assert main(["eval", str(learnt.path), "--scene", folder]) == 0
    without = json.loads(learnt.eval_path.read_text("utf-8"))["mean"]
    learnt.appearance_path.write_text(record, "utf-8")
    assert abs(without["psnr"] - before["psnr"]) > 0.03  # little, as the corners are nearly black


@pytest.mark.parametrize(
    "change", [{"mixes": [0.0] * 5}, {"mixes": [0.3] * 6}, {"vignette": [1.0, "x", 0.0]}, {"vignette": None}]
)
def test_a_damaged_row(tmp_path: Path, change: dict[str, object]) -> None:
    run = Run.create(tmp_path / "run", OF_CAMERAS)
    row = {"log2_gains": [0.0] * 3, "mixes": [0.0] * 6, "vignette": [0.0] * 3} | change
    run.write_appearance({"kind": "ppisp", "photographs": {"a.jpg": row}, "held_out": {}})
    with pytest.raises(InputError, match=r"appearance.json: .*expected what clsplat train --appearance"):
        gains_of(run.path, "a.jpg")


def test_lenses_move_by_themselves(default_device: Device, scene: Scene) -> None:
    """A photograph's step moves its own lens's vignette alone."""
    first, *others = scene.train_views
    focal, *rest = first.lens.params
    other = replace(first.lens, params=(np.nextafter(focal, 0), *rest))
    views = [replace(view, lens=other) for view in others]
    held = [view for view in scene.views if view.split == "test"]
    scene = replace(scene, views=[first, *views, *held])
    trainer = Trainer(scene, replace(OF_CAMERAS, batch=1), default_device)
    appearance = trainer.appearance
    assert isinstance(appearance, PpispOfAll)
    assert appearance.arrays()["appearance/lenses_logs"].shape == (2, 3)
    trainer.train_step()
    assert appearance.arrays()["appearance/lenses_first"].any(axis=1).sum() == 1


def test_a_checkpoint_of_other_lenses_is_refused(default_device: Device, scene: Scene) -> None:
    trainer = Trainer(scene, replace(CONFIG, appearance="exposure"), default_device)
    trainer.train_step()
    with pytest.raises(InputError, match="appearance/lenses_logs"):
        Trainer(scene, OF_CAMERAS, default_device).restore(Checkpoint(1, *trainer.checkpoint()))


def test_photographs_that_are_alike_are_left_so(default_device: Device, scene: Scene) -> None:
    """What photographs have in common is the model's: the mean of all is 0 after each step, and no mix is large."""
    trainer = Trainer(scene, replace(OF_CAMERAS, appearance_rate=1e-4), default_device)
    for _ in range(40):
        trainer.train_step()
    arrays = trainer.checkpoint()[0]
    assert_close(arrays["appearance/logs"].mean(axis=0), np.zeros(9), absolute=1e-6)
    assert np.abs(arrays["appearance/logs"][:, 3:]).max() < 0.05  # of 0.2, the bound
    assert arrays["appearance/lenses_logs"].shape == (1, 3)

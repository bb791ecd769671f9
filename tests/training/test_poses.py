# SPDX-License-Identifier: Apache-2.0
"""Poses that are refined in training: they come back, two are held, and what a run has of them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import Capture, no_warnings, refuses
from same_bytes import trained_run
from tiny import run_steps, short, trained_to

from clsplat.api import train
from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.config.training import TrainConfig
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.runs.appearance import held_out_looks
from clsplat.scenes.geography.georeference import GEOREFERENCE_FILE, Georeference
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene, View
from clsplat.training.cameras.export import doubt_poses
from clsplat.training.cameras.poses import Poses, axes_of, descend
from clsplat.training.cameras.validation_gate import drift
from clsplat.training.held_out_alignment import aligned
from clsplat.training.trainer import Trainer

CONFIG = short(iterations=40, refine_poses=True)


def disturbed(scene: Scene, degrees: float, shift: float) -> Scene:
    """The scene with training poses turned and shifted at random, but for the two that are held."""
    rng = np.random.default_rng(3)
    held = {scene.train_views[index].name for index in Poses(CONFIG, scene.train_views, scene.extent).held}

    def off(view: View) -> View:
        turn, move = (each / np.linalg.norm(each) for each in rng.standard_normal((2, 3)))
        motion = np.concatenate([np.radians(degrees) * turn, shift * scene.extent * move])
        kept = view.name in held or view.split == "test"
        return view if kept else replace(view, camera=view.camera.moved(motion))

    return replace(scene, views=[off(view) for view in scene.views])


def pixels_off(found: Camera, true: Camera, points: np.ndarray) -> float:
    """Mean distance in pixels between the images of points: a turn stands for a shift in some part."""
    images = []
    for camera in (found, true):
        x, y, z = (points @ camera.rotation.T + camera.translation).T
        images.append(np.stack([camera.fx * x / z, camera.fy * y / z], axis=1))
    return float(np.linalg.norm(images[0] - images[1], axis=1).mean())


@pytest.mark.slow
def test_poses_come_back(scene: Scene, default_device: Device) -> None:
    """At 48 x 40 pixels, where a degree is a pixel, from some pixels to under one."""
    off = disturbed(scene, 3.0, 0.03)
    trainer = Trainer(off, replace(CONFIG, iterations=600, pose_reach=10.0), default_device)
    held = [off.train_views[index] for index in trainer.cameras.poses.held]

    def away() -> float:
        pairs = zip(trainer.cameras.poses.cameras, scene.train_views, strict=True)
        return float(np.mean([pixels_off(camera, view.camera, scene.points) for camera, view in pairs]))

    before = away()
    run_steps(600, trainer)
    assert before > 1.5
    assert away() < 0.3 * before
    assert len(held) == 2
    for view, index in zip(held, trainer.cameras.poses.held, strict=True):
        assert trainer.cameras.poses.cameras[index] is view.camera
    moved = trainer.cameras.poses.motions()[0] > 0
    assert moved.sum() == len(moved) - 2


def test_a_held_out_view_is_aligned(scene: Scene, default_device: Device) -> None:
    """From two pixels off to under a third of one, with the model as it was."""
    trainer = trained_to(300, scene, replace(CONFIG, iterations=300, refine_poses=False), default_device)
    before = trainer.gaussians().arrays()
    view = scene.test_views[0]
    away = replace(view, camera=view.camera.moved(np.array([0.02, 0.02, 0.02, 0, 0, 0])))
    found = aligned(trainer, away, held_out_looks(None))
    still = {name: np.array_equal(values, before[name]) for name, values in trainer.gaussians().arrays().items()}
    assert all(still.values()), still
    assert pixels_off(away.camera, view.camera, scene.points) > 1
    assert pixels_off(found, view.camera, scene.points) < 0.33


def test_what_a_run_has_of_them(folder: Path, scene: Scene, default_device: Device, tmp_path: Path) -> None:
    """refined/ is a COLMAP model of the same pictures: training views have moved, but for two, and held-out ones and
    the points as they have on average."""
    placed = replace(scene, georeference=Georeference(32632))
    run = trained_run(placed, CONFIG, default_device, tmp_path / "run")
    result = json.loads(run.eval_path.read_text())
    assert result["mean"]["psnr_aligned"] >= result["mean"]["psnr"] - 0.05  # the loss is not the PSNR alone
    again = load_scene(
        shutil.copytree(run.refined_path, tmp_path / "again" / "sparse").parent, images=folder / "images"
    )
    assert [view.name for view in again.views] == [view.name for view in scene.views]
    cameras = {view.name: view.camera for view in again.views}
    given = [view.camera for view in scene.train_views]
    along = drift(given, [cameras[view.name] for view in scene.train_views], scene.extent)
    np.testing.assert_allclose(again.points, along.points(scene.points), atol=1e-9)  # cameras are text
    for view in scene.views:
        found, wanted = cameras[view.name], view.camera if view.split == "train" else along.taken_along(view.camera)
        same = np.allclose(found.rotation, wanted.rotation, atol=1e-9)
        assert same == (view.split == "test" or view.name in (scene.train_views[0].name, _second(scene)))
        assert (found.fx, found.cx) == (view.camera.fx, view.camera.cx)
    names = {"cameras.txt", "images.txt", "points3D.txt", GEOREFERENCE_FILE}
    assert {path.name for path in run.refined_path.iterdir()} == names
    assert again.georeference is not None
    assert again.georeference.epsg == 32632


def test_a_call_that_is_refused_leaves_the_run_as_it_is(folder: Path, tmp_path: Path, capfd: Capture) -> None:
    few, run = Path(shutil.copytree(folder, tmp_path / "few")), tmp_path / "run"
    images = few / "sparse" / "0" / "images.txt"
    images.write_text("".join(images.read_text().splitlines(keepends=True)[:6]))  # three, of which one is held out
    call = ["train", str(few), "-o", str(run), "--iterations", "2", "--no-report"]
    assert main(call) == 0
    model = (run / "model.ply").read_bytes()
    capfd.readouterr()
    assert main([*call, "--overwrite", "--refine-poses"]) == 2
    assert "--refine-poses: 2 training views, expected 3 or more" in capfd.readouterr().err
    assert (run / "model.ply").read_bytes() == model
    assert main([*call[:3], str(tmp_path / "new"), *call[4:], "--refine-poses"]) == 2
    assert not (tmp_path / "new").exists()


def test_a_model_that_has_moved_away_is_told_of() -> None:
    with pytest.warns(UserWarning, match=r"20\.00 dB at their given poses and 21\.50 dB at the poses that"):
        doubt_poses({"psnr": 20.0, "psnr_aligned": 21.5}, 1.0)
    with no_warnings():
        doubt_poses({"psnr": 20.0, "psnr_aligned": 20.9}, 1.0)
        doubt_poses({"psnr": 20.0, "psnr_aligned": 21.5}, 0.0)
        doubt_poses({"psnr": 20.0}, 1.0)


def _second(scene: Scene) -> str:
    return scene.train_views[Poses(CONFIG, scene.train_views, scene.extent).held[1]].name


@pytest.mark.parametrize(
    ("name", "spoilt", "text"),
    [
        ("rotations", lambda array: 2 * array, "has poses/rotations that are not rotation matrices"),
        ("visits", lambda array: array[1:], "has no poses/visits of shape"),
        ("first", lambda array: array * np.nan, "has no poses/first of shape"),
    ],
)
def test_a_checkpoint_that_is_damaged(
    scene: Scene, default_device: Device, name: str, spoilt: Callable[[np.ndarray], np.ndarray], text: str
) -> None:
    poses = Trainer(scene, CONFIG, default_device).cameras.poses
    arrays = {key.removeprefix("poses/"): values for key, values in poses.arrays().items()}
    poses.load(arrays)
    refuses(text, poses.load, {**arrays, name: spoilt(arrays[name])}, error=ValueError)


def test_settings_that_make_no_sense(scene: Scene, default_device: Device, tmp_path: Path) -> None:
    for config, text in (
        (replace(CONFIG, batch=2), "--refine-poses: not supported with --batch 2 or several devices"),
        (replace(CONFIG, pose_reach=0.0), "--pose-reach 0.0: expected over 0"),
    ):
        refuses(text, config.check)
    refuses("--refine-poses: not supported with 2 devices", CONFIG.on_devices, 2, explicit=False)
    few = replace(scene, views=[*scene.train_views[:2], *scene.test_views])
    refuses("--refine-poses: 2 training views, expected 3 or more", Trainer, few, CONFIG, default_device)
    run = trained_run(scene, replace(CONFIG, iterations=3), default_device, tmp_path / "run")
    with pytest.raises(InputError, match="refine_poses is True, a resumed run"):
        train(scene, replace(CONFIG, refine_poses=False), device=default_device, run=run, resume=True)


def test_rates_are_the_reach_in_all() -> None:
    config = TrainConfig(iterations=7000, refine_poses=True, pose_reach=5.0)
    views = load_like(35)
    poses = Poses(config, views, 1.0)
    visited = [poses.rate(step) for step in range(501, 7001) if step % 35 == 0]
    assert np.degrees(sum(visited)) == pytest.approx(5.0, rel=0.02)  # a sum for an integral
    assert not poses.moves(1, 500)
    assert poses.moves(1, 501)
    assert not poses.moves(0, 501)


def test_axes_are_those_of_lapack() -> None:
    rng = np.random.default_rng(0)
    for scale in (1.0, 1e-12, 1e9):
        rows = rng.standard_normal((6, 6)) * np.geomspace(1, 1e-5, 6)
        matrix = scale * (rows @ rows.T)
        values, axes = axes_of(matrix)
        # what rounding is of the largest value
        np.testing.assert_allclose(np.sort(values), np.linalg.eigvalsh(matrix), rtol=0, atol=1e-14 * values.max())
        np.testing.assert_allclose(axes.T * values @ axes, matrix, rtol=0, atol=1e-14 * values.max())
        np.testing.assert_allclose(axes @ axes.T, np.eye(6), rtol=0, atol=1e-14)
    values, _ = axes_of(np.zeros((6, 6)))
    assert not values.any()


def test_steps_turn_with_the_axes() -> None:
    """However the six motions are mixed, the step is the same motion; the first one has length 1."""
    rng = np.random.default_rng(1)
    turn, _ = np.linalg.qr(rng.standard_normal((6, 6)))
    moments = [(np.zeros(6), np.zeros((6, 6))) for _ in range(2)]
    for visit in range(1, 30):
        by = rng.standard_normal(6) * [1, 2, 3, 0.1, 0.5, 30]
        one, other = (descend(*own, given, visit) for own, given in zip(moments, (by, turn @ by), strict=True))
        np.testing.assert_allclose(other, turn @ one, rtol=0, atol=1e-10)  # the axes' own rounding, times some hundred
        assert visit > 1 or np.linalg.norm(one) == pytest.approx(1)
    assert not descend(np.zeros(6), np.zeros((6, 6)), np.zeros(6), 1).any()


def load_like(count: int) -> list[View]:
    """Views of which only the cameras are asked for."""
    from scenes import tilted_camera

    return [View(f"{k}.png", tilted_camera(8, 8), Path(), "train", None) for k in range(count)]  # type: ignore[arg-type]

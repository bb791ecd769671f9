# SPDX-License-Identifier: Apache-2.0
"""Models and cameras of a job at the same times: over a shutter, and beyond the ends of their shot."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import Capture, error_line
from cg import write_flat
from needs import require
from rendered import camera_file, pixels_of
from tiny import HEIGHT, WIDTH, hidden_model

from clsplat.arrays import Float32
from clsplat.cli.main import main
from clsplat.config.pictures import PictureConfig, SamplingConfig
from clsplat.images.frame_files import camera_matrices
from clsplat.models import edit
from clsplat.models.formats import usd
from clsplat.models.instances import Placement, extrapolated, rows_of
from clsplat.sequence.job_models import load_job_models
from clsplat.sequence.shot_tasks import make_tasks
from clsplat.sequence.task import RenderOptions, Task, camera_after, camera_before, header, model_times
from clsplat.shots import Shot, read_shot
from clsplat.shots.shot_file import AnimatedProperty, KeyedTrack, Within

KEY = {"world_from_cam": [1, 0, 0, 0], "fov_x": 60}
LATE = SamplingConfig(shutter_open=0.0, shutter_close=0.5, samples=2)
SHUTTERS = (SamplingConfig(), LATE, SamplingConfig(shutter_angle=360, samples=4))
BOTH_WAYS = ("motion", "backward")


def cameras(folder: Path, *places: float, first: int = 1) -> Path:
    """A shot of a camera at these x, frame by frame."""
    return camera_file(folder / "cameras.json", dict(enumerate(places, first)))


def layout(folder: Path, **of_it: Any) -> Path:
    """A shot of one model with these properties."""
    models = [{"name": "model", "path": "model.ply"} | of_it]
    (folder / "shot.json").write_text(json.dumps({"clsplat_shot": 1, "models": models}))
    return folder / "shot.json"


def render(folder: Path, model: Path, shot: Path, flags: str) -> int:
    out = ["-o", str(folder / "####.exr"), "--progress", "none"]
    return main(["render", str(model), "--cameras", str(shot), *out, *flags.split()])


def pixels(folder: Path, frame: int) -> Float32:
    return pixels_of(folder / f"{frame:04d}.exr")


def assert_goes_along(model: Path, shot: Shot, sampling: SamplingConfig) -> None:
    """The model stands still before the camera: at all samples of each frame's shutter, and where motion goes to."""
    options = RenderOptions(BOTH_WAYS, pictures=PictureConfig(sampling=sampling))
    tasks = make_tasks(shot, shot, "#.exr", lambda camera: camera, BOTH_WAYS, sampling)
    wanted = None
    for task in load_job_models(model).seen(tasks, options.pictures, options.channels):
        middle = sampling.middle
        cameras = {time: task.at(time) for time in (middle, *(sampling.sample_times if sampling.moves else ()))}
        around = camera_before(task, options.pictures), camera_after(task, options.pictures)
        assert around[0] and around[1] and task.placed
        for time, camera in (*cameras.items(), (middle - 1, around[0]), (middle + 1, around[1])):
            cam_from_model = np.eye(4)
            cam_from_model[:3] = np.column_stack([camera.rotation, camera.translation])
            cam_from_model = cam_from_model @ task.placed[time][0].transform
            wanted = cam_from_model if wanted is None else wanted
            np.testing.assert_allclose(cam_from_model, wanted, atol=1e-6)  # stages round their quaternions to float32


@pytest.mark.parametrize("handles", [0, 2])
def test_a_model_of_the_cameras_rig_never_moves_in_the_picture(
    handles: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the ends of the stage's range too, with samples beyond them or none. The rig speeds up and turns."""
    require("pxr")
    from pxr import Gf, Usd, UsdGeom

    monkeypatch.setattr(usd, "_lives", lambda *_: True)  # this stage does not end the process
    usd.write(tmp_path / "model.usdc", hidden_model())
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(3)
    rig = UsdGeom.Xform.Define(stage, "/Rig")
    shift, turn = rig.AddTranslateOp(), rig.AddRotateYOp()
    for frame in range(1 - handles, 4 + handles):
        shift.Set(Gf.Vec3d(0.1 * frame**2, 0, 0), frame)
        turn.Set(5.0 * frame, frame)
    camera = UsdGeom.Camera.Define(stage, "/Rig/Camera")
    camera.CreateFocalLengthAttr(20.0)
    UsdGeom.Xformable(camera).AddTranslateOp().Set(Gf.Vec3d(0, 0, 5))
    UsdGeom.Xform.Define(stage, "/Rig/Asset").GetPrim().GetReferences().AddReference("model.usdc")
    stage.GetRootLayer().Save()
    for sampling in SHUTTERS:
        assert_goes_along(tmp_path / "shot.usda", read_shot(tmp_path / "shot.usda", size=(WIDTH, HEIGHT)), sampling)


def test_a_model_that_keys_move_with_the_camera(tmp_path: Path) -> None:
    hidden_model().save(tmp_path / "model.ply")
    shot = read_shot(cameras(tmp_path, 0, 0.5, 1.0))
    model = layout(tmp_path, keys=[{"frame": f, "translate": [x, 0, 0]} for f, x in ((1, 0), (3, 1))])
    for sampling in SHUTTERS:
        assert_goes_along(model, shot, sampling)


def test_where_keys_go_on_they_count(tmp_path: Path) -> None:
    """Beyond the camera's last frame a model is where its own keys say."""
    hidden_model().save(tmp_path / "model.ply")
    shot = read_shot(cameras(tmp_path, 0, 0.5))
    keys = [{"frame": 1, "translate": [0, 0, 0]}, {"frame": 2, "translate": [0, 0, 0]}]
    options = RenderOptions(("motion",))
    tasks = make_tasks(shot, shot, "#.exr", lambda camera: camera, options.channels)
    for further, wanted in (([], 0.0), ([{"frame": 4, "translate": [2, 0, 0]}], 1.0)):
        job_models = load_job_models(layout(tmp_path, keys=keys + further))
        placed = job_models.seen(tasks, options.pictures, options.channels)[1].placed
        assert placed[1][0].transform[0, 3] == wanted


def spinning(frame: float) -> Any:
    """A turn of 20 degrees and a growth of a tenth each frame, about a place of its own."""
    there = edit.shifting([1.0, 2.0, 0.5])
    return there @ edit.turning([0, 20 * frame, 0]) @ edit.scaling(1.1**frame) @ np.linalg.inv(there)


def test_a_turntable_turns_on() -> None:
    """Three frames beyond either end, and at times between them: the same motion goes on."""
    frames = np.arange(0, 3.125, 0.125)
    rows = np.array([spinning(frame).ravel() for frame in frames])
    track = KeyedTrack("here", {"matrix": AnimatedProperty(frames, rows)})
    for end, beyond in ((3, (3.25, 4, 4.5, 6)), (0, (-0.25, -1, -1.5, -3))):
        for frame in beyond:
            np.testing.assert_allclose(extrapolated(track, frame, end).transform, spinning(frame), atol=1e-12)
    assert extrapolated(track, 2.5, 2) == track.at(2.5)  # its keys say more
    still = KeyedTrack("here", {"matrix": AnimatedProperty(np.array([0.0, 1.0]), rows[[5, 5]])})
    assert extrapolated(still, 7, 3) == Placement(rows_of(spinning(frames[5])))
    held = replace(track, held=True)
    assert extrapolated(held, 3.5, 3) == held.at(3)
    both = Within(KeyedTrack("here", {"translate": AnimatedProperty(np.array([-2.0, 1.0]), np.zeros((2, 3)))}), track)
    assert (both.reach, Within(KeyedTrack(""), KeyedTrack("")).reach) == ((-2, 3), None)


def test_each_sample_has_the_near_plane_of_its_time(tmp_path: Path) -> None:
    """A model that is small and near before and after the frame is not cut where the large one of its middle is."""
    replace(hidden_model(), near=0.5).save(tmp_path / "model.ply")
    small = {"scale": 0.05, "translate": [0, 0, -3.8]}
    keys = [{"frame": 0.5, **small}, {"frame": 1, "scale": 1, "translate": [0, 0, 0]}, {"frame": 1.5, **small}]
    model, light = layout(tmp_path, keys=keys), []
    for places in ((0,), (0, 0)):  # a shot of one frame, and a camera that stands still
        shot = cameras(tmp_path, *places)
        flags = "--frames 1 --alpha --shutter-open -1 --shutter-close 1 --samples 2"
        assert render(tmp_path, model, shot, flags) == 0
        light.append(pixels(tmp_path, 1))
    assert light[0][:, :, 3].max() > 0.5
    np.testing.assert_array_equal(light[0], light[1])


@pytest.mark.parametrize("places", [(0,), (0, 0)])
def test_the_header_has_the_near_plane_of_the_middle(places: tuple[float, ...], tmp_path: Path) -> None:
    replace(hidden_model(), near=0.25).save(tmp_path / "model.ply")
    shot = read_shot(cameras(tmp_path, *places))
    options = RenderOptions(pictures=PictureConfig(sampling=LATE))
    keys = [{"frame": 1, "scale": 1}, {"frame": 2, "scale": 5}]
    made = make_tasks(shot, shot, "#.exr", lambda camera: camera, options.channels, LATE)
    for model, near in ((tmp_path / "model.ply", 0.25), (layout(tmp_path, keys=keys), 0.5)):  # a quarter of a frame on
        task = load_job_models(model).seen(made[:1], options.pictures, options.channels)[0]
        wanted = camera_matrices(replace(task.camera, near=near))["worldToNDC"]
        np.testing.assert_allclose(header(task, options).matrices["worldToNDC"], wanted, rtol=1e-12, atol=1e-12)


def test_holdouts_of_a_model_along_rays_with_an_open_shutter(tmp_path: Path) -> None:
    """Depths of the holdout become the distances that such a model has, at each sample as in a picture without."""
    replace(hidden_model(), by_rays=True).save(tmp_path / "model.ply")
    shot, held = cameras(tmp_path, 0, 0), write_flat(tmp_path / "z.exr", {"Z": np.full((HEIGHT, WIDTH), 4.0)})
    found = []
    for shutter in ("", "--shutter-angle 180 --samples 2"):
        assert render(tmp_path, tmp_path / "model.ply", shot, f"--alpha --frames 1 --holdout {held} {shutter}") == 0
        found.append(pixels(tmp_path, 1))
    np.testing.assert_allclose(found[1][:, :, 3], found[0][:, :, 3], atol=1e-6)


def test_a_shutter_that_is_an_instant_off_the_frame(tmp_path: Path, capsys: Capture) -> None:
    """Camera, motion and models are all of that instant. The flags are for shutters that stay open."""
    shot, late = read_shot(cameras(tmp_path, 0, 1, 2, 3)), SamplingConfig(shutter_open=0.25, shutter_close=0.25)
    options = RenderOptions(BOTH_WAYS, pictures=PictureConfig(sampling=late))
    tasks = make_tasks(shot, shot, "#.exr", lambda camera: camera, BOTH_WAYS, late)

    def places(task: Task) -> list[float]:
        around = camera_before(task, options.pictures), task.at(late.middle), camera_after(task, options.pictures)
        return [float(camera.position[0]) for camera in around if camera]

    for task in tasks:
        x = task.number - 1 + 0.25
        np.testing.assert_allclose(places(task), [x - 1, x, x + 1], atol=1e-12)
        assert model_times(task, options.pictures, options.channels)[0] == 0.25
    hidden_model().save(tmp_path / "model.ply")
    flags = "--shutter-open 0.25 --shutter-close 0.25"
    assert render(tmp_path, tmp_path / "model.ply", tmp_path / "cameras.json", flags) == 2
    assert "expected two times, the second after the first" in error_line(capsys)

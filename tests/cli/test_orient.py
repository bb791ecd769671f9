# SPDX-License-Identifier: Apache-2.0
"""`train --orient up --scale`: the run, its evaluation, its turntable and the way back have one frame each."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny import write_scene

from clsplat.cli.main import main
from clsplat.cli.render.flags import RenderVerb
from clsplat.cli.render.shots import shots_asked
from clsplat.gaussians import Gaussians
from clsplat.images.reading import read_image
from clsplat.runs.run import Run
from clsplat.runs.scene_record import own_cameras
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers.colmap import read_cameras
from clsplat.shots import Shot, choose_shot, shot_around

STEPS = ("--iterations", "30", "--test-every", "8", "--sh-degree", "1", "--no-report")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A scene, a run in its own frame, and a run that is turned upright and scaled."""
    folder = tmp_path_factory.mktemp("orient")
    scene = write_scene(folder / "scene")
    assert main(["train", str(scene), "-o", str(folder / "plain"), *STEPS]) == 0
    names = sorted(read_cameras(scene))
    scale = f"{names[0]},{names[5]}=10"
    assert main(["train", str(scene), "-o", str(folder / "up"), *STEPS, "--orient", "up", "--scale", scale]) == 0
    return scene, folder / "plain", folder / "up"


def test_the_run_keeps_the_transform(runs: tuple[Path, Path, Path]) -> None:
    scene, plain, up = runs
    assert Run.open(plain).frame is None
    frame = Run.open(up).frame
    assert frame is not None
    assert frame.upright
    assert frame.metres
    loaded = load_scene(scene, frame=frame)
    views = {view.name: view.camera.position for view in loaded.views}
    names = sorted(views)
    assert np.linalg.norm(views[names[0]] - views[names[5]]) == pytest.approx(10)
    record = json.loads((up / "scene.json").read_text())
    pose = record["views"][names[0]]["pose"]
    assert pose == [*np.ravel(loaded.views[0].camera.rotation), *loaded.views[0].camera.translation]


def test_eval_and_resume_use_the_runs_frame(runs: tuple[Path, Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    _, plain, up = runs
    scores = {run: json.loads((run / "eval.json").read_text())["mean"]["psnr"] for run in (plain, up)}
    # the same pictures; the models differ by float32 rounding, which a training amplifies
    assert scores[up] == pytest.approx(scores[plain], abs=1.0)
    assert main(["eval", str(up), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["mean"]["psnr"] == pytest.approx(scores[up], abs=1e-6)
    assert main(["train", "-o", str(up), "--resume", "--iterations", "31"]) == 0
    assert main(["train", "-o", str(up), "--resume", "--orient", "none"]) == 2
    assert "orient is up, a resumed run cannot change it to none" in capsys.readouterr().err


def test_frames_of_the_scenes_cameras_are_the_same_pictures(runs: tuple[Path, Path, Path], tmp_path: Path) -> None:
    scene, _, up = runs
    name = min(read_cameras(scene))
    assert main(["render", str(up), "--cameras", str(scene), "-o", str(tmp_path / "{name}.png")]) == 0
    (shown,) = (read_image(path) for path in tmp_path.glob(f"{Path(name).stem}*"))
    held_out = read_image(up / "test" / name)
    # the model went on by a step after its evaluation
    assert np.abs(shown[:, :, :3] - held_out[:, :, :3]).mean() < 0.02


def level(shot: Shot) -> None:
    """Assert that the cameras of a shot go round -y: at one height, with level x axes."""
    heights = [frame.camera.position[1] for frame in shot.frames]
    assert np.ptp(heights) < 1e-9 * max(map(abs, heights))
    assert all(abs(frame.camera.rotation[0, 1]) < 1e-12 for frame in shot.frames)


def test_a_turntable_goes_round_the_vertical(runs: tuple[Path, Path, Path]) -> None:
    """With the cameras of the run, and with those of its scene."""
    scene, plain, up = runs
    of_run = shot_around(Gaussians.load(up / "model.ply"), "turntable", own=own_cameras(Run.open(up)), level=True)
    level(of_run)
    flags = RenderVerb(up, "####.png", path="turntable", count=120, cameras=scene)
    of_scene = shots_asked(flags, lambda: pytest.fail("the models are not needed"))[""]
    level(of_scene)
    for one, other in zip(of_run.frames, of_scene.frames, strict=True):
        np.testing.assert_allclose(one.camera.position, other.camera.position, atol=1e-6)
    # the other run has the scene's frame, in which up is estimated
    shot = shots_asked(replace(flags, model=plain), lambda: pytest.fail("not needed"))[""]
    estimated = choose_shot(scene, path="turntable", count=120)
    np.testing.assert_array_equal(shot.frames[7].camera.rotation, estimated.frames[7].camera.rotation)


def test_convert_goes_back_to_the_scenes_own_frame(
    runs: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, plain, up = runs
    target = tmp_path / "back.ply"
    assert main(["convert", str(up), str(target), "--frame", "source"]) == 0
    frame = Run.open(up).frame
    assert frame is not None
    scale = np.linalg.det(frame.world_from_source[:3, :3]) ** (1 / 3)
    there, here = Gaussians.load(target), Gaussians.load(up / "model.ply")
    inverse = np.linalg.inv(frame.world_from_source)
    np.testing.assert_allclose(there.means, here.means @ inverse[:3, :3].T + inverse[:3, 3], atol=1e-5)
    np.testing.assert_allclose(there.log_scales, here.log_scales - math.log(scale), atol=1e-5)
    capsys.readouterr()
    assert main(["eval", str(target), "--scene", str(scene), "--json"]) == 0
    back = json.loads(capsys.readouterr().out)["mean"]["psnr"]
    own = json.loads((up / "eval.json").read_text())["mean"]["psnr"]
    assert back == pytest.approx(own, abs=0.02)  # the same pictures, up to float32 rounding
    same = tmp_path / "same.ply"
    assert main(["convert", str(plain), str(same), "--frame", "source"]) == 0
    np.testing.assert_array_equal(Gaussians.load(same).means, Gaussians.load(plain / "model.ply").means)
    assert main(["convert", str(target), str(tmp_path / "x.ply"), "--frame", "source"]) == 2
    assert "is not in a run" in capsys.readouterr().err


def test_wrong_values_end_before_anything_is_written(
    runs: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = runs[0]
    for flags, match in (
        (("--scale", "a,b=1"), "the scene has no photograph a and no b"),
        (("--scale", "gps"), "photographs have a GPS position in their EXIF"),
        (("--scale", "a,b=0"), "the length is 0, expected metres, a number over 0"),
        (("--scale", "fast"), "expected NAME,NAME=METRES"),
        (("--orient", "down"), "--orient"),
    ):
        assert main(["train", str(scene), "-o", str(tmp_path / "run"), *STEPS, *flags]) == 2, flags
        assert match in capsys.readouterr().err
        assert not (tmp_path / "run" / "config.toml").exists()

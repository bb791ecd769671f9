# SPDX-License-Identifier: Apache-2.0
"""Stereo pairs: cameras, names of files, parts of an EXR, cameras of a stage, and the disparity in pictures."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import scenes
from calls import Capture, error_line, fails, printed, ran, refuses, rejected
from cg import write_flat, write_samples
from headers import exr_attributes
from needs import require
from rendered import camera_file, pixels_of

from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.cli.render.job import check_warps
from clsplat.config.pictures import HoldoutConfig, PictureConfig, WarpConfig
from clsplat.config.stereo import EYES, StereoConfig
from clsplat.errors import InputError
from clsplat.images.stmap import write_stmap
from clsplat.reference.cameras import pixel_from_world
from clsplat.rendering.renderer import Renderer
from clsplat.sequence.frame_renderer import FrameRenderer
from clsplat.sequence.task import RenderOptions, Task
from clsplat.shots.stereo import for_eye, pair_of_stage, seen_by
from clsplat.stages.holdout import HELD_PIXEL_BYTES

DISTANCE, CONVERGENCE = 0.2, 4.0
KEY = {"world_from_cam": [1, 0, 0, 0], "fov_x": 40}
STAGE = """#usda 1.0
(
    startTimeCode = 1
    endTimeCode = 2
)
def Xform "rig"
{
    double3 xformOp:translate = (0, 0, 4)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Camera "one"
    {
        uniform token stereoRole = "left"
        float focalLength = 35
        double3 xformOp:translate = (-0.1, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Camera "two"
    {
        uniform token stereoRole = "right"
        float focalLength = 35
        double3 xformOp:translate = (0.1, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
def Camera "single"
{
    float focalLength = 35
}
"""


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A small opaque Gaussian 5 before the camera, and two frames."""
    folder = tmp_path_factory.mktemp("shot")
    gaussians = scenes.make_gaussians(
        np.array([[0.05, 0.02, 1.0]]),
        np.array([[1.0, 0.0, 0.0, 0.0]]),
        np.log([[0.03, 0.03, 0.03]]),
        np.array([0.99]),
        np.ones((1, 1, 3)),
    )
    gaussians.save(folder / "model.ply")
    cameras = camera_file(folder / "cameras.json", {1: 0, 2: 0.01}, size=(96, 64), fov_x=40)
    return [str(folder / "model.ply"), "--cameras", str(cameras)]


def render(shot: list[str], pattern: Path, flags: str = "") -> int:
    return main(["render", *shot, "-o", str(pattern), "--progress", "none", *flags.split()])


def centroid(pixels: np.ndarray) -> np.ndarray:
    """Place of the light's middle, x and y in pixels."""
    weight = pixels[:, :, 0].astype(np.float64)
    y, x = np.indices(weight.shape) + 0.5
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


def test_disparity_of_cameras() -> None:
    """f d (1/z - 1/c) pixels, and nothing in y: neither is turned."""
    camera = replace(scenes.tilted_camera(60, 40), cx=31.0, cy=19.0)
    rng = np.random.default_rng(2)
    points = (rng.uniform(-1, 1, (50, 3)) + np.array([0, 0, 4.0]) - camera.translation) @ camera.rotation
    depths = (points @ camera.rotation.T + camera.translation)[:, 2]
    for convergence in (math.inf, 3.0):
        left, right = (seen_by(camera, eye, DISTANCE, convergence) for eye in ("left", "right"))
        assert (left.rotation == camera.rotation).all()
        apart = pixel_from_world(left, points)[0] - pixel_from_world(right, points)[0]
        np.testing.assert_allclose(apart[:, 0], camera.fx * DISTANCE * (1 / depths - 1 / convergence), atol=1e-10)
        np.testing.assert_allclose(apart[:, 1], 0, atol=1e-10)
        np.testing.assert_allclose(left.position - right.position, -DISTANCE * camera.rotation[0], atol=1e-12)


def test_two_files_show_the_disparity(shot: list[str], tmp_path: Path) -> None:
    flags = f"--stereo {DISTANCE} --convergence {CONVERGENCE} --frames 1"
    assert render(shot, tmp_path / "a.{eye}.%v.##.exr", flags) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.left.l.01.exr", "a.right.r.01.exr"]
    left, right = (centroid(pixels_of(tmp_path / f"a.{eye}.{eye[0]}.01.exr")) for eye in ("left", "right"))
    focal = 48 / math.tan(math.radians(20))
    # a Gaussian's tails under 1/255 are cut, at other pixels for each eye
    np.testing.assert_allclose(left - right, [focal * DISTANCE * (1 / 5 - 1 / CONVERGENCE), 0], atol=0.02)
    assert exr_attributes(tmp_path / "a.left.l.01.exr")["view"][1] == b"left"


@pytest.mark.parametrize("parts", ["one", "several"])
def test_one_file_has_both_views(shot: list[str], tmp_path: Path, parts: str) -> None:
    flags = f"--stereo {DISTANCE} --channels rgb,alpha,depth --parts {parts}"
    assert render(shot, tmp_path / "a.##.exr", flags) == 0
    assert render(shot, tmp_path / "%V.##.exr", flags) == 0
    source = oiio.ImageInput.open(str(tmp_path / "a.01.exr"))
    count = 1 if parts == "one" else 2
    names = []
    for part in range(2 * count):
        assert source.seek_subimage(part, 0)
        eye = "left" if part < count else "right"
        assert source.spec().getattribute("view") == eye
        names.append(source.spec().getattribute("oiio:subimagename"))
        alone = pixels_of(tmp_path / f"{eye}.01.exr", part % count)
        np.testing.assert_array_equal(pixels_of(tmp_path / "a.01.exr", part), alone)
    assert not source.seek_subimage(2 * count, 0)
    wanted = ["left", "right"] if parts == "one" else ["rgba.left", "depth.left", "rgba.right", "depth.right"]
    assert names == wanted
    stamps = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    for pattern in ("a.##.exr", "%V.##.exr"):
        assert render(shot, tmp_path / pattern, f"{flags} --skip-existing") == 0
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == stamps
    assert render(shot, tmp_path / "a.##.exr", f"{flags} --convergence 7 --skip-existing") == 0
    assert (tmp_path / "a.01.exr").stat().st_mtime_ns != stamps[tmp_path / "a.01.exr"]


def test_records_tell_the_eyes_apart(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    records = json.loads(ran(capsys, render, shot, tmp_path / "{eye}.##.png", "--stereo 0.1 --json").out)
    assert [(record["frame"], record["eye"]) for record in records] == [
        *((1, "left"), (1, "right"), (2, "left"), (2, "right"))
    ]
    assert render(shot, tmp_path / "{eye}.##.png", "--stereo 0.1 --skip-existing --dry-run --json") == 0
    assert all(frame["skipped"] for frame in json.loads(capsys.readouterr().out)["frames"])
    plan = ran(capsys, render, shot, tmp_path / "{eye}.##.png", "--stereo 0.1 --skip-existing --dry-run").out
    assert "frames    4: 1-2;" in plan
    assert "skipped   4: 1-2" in plan
    assert render(shot, tmp_path / "one.##.png", "--stereo 0.1 --eye right --frames 2") == 0
    assert (tmp_path / "one.02.png").read_bytes() == (tmp_path / "right.02.png").read_bytes()


@pytest.mark.parametrize(
    ("pattern", "flags", "message"),
    [
        ("a.##.png", "--stereo 0.1", "has no {eye} in it"),
        ("a.mp4", "--stereo 0.1", "a video holds one eye, expected --eye left or right"),
        ("{eye}.mp4", "--stereo 0.1", "a video holds one eye"),
        ("{eye}.##.exr", "", "has a field for the eye, expected --stereo"),
        ("a.##.exr", "--stereo 0", "--stereo 0: expected the distance of the eyes above 0, or stage"),
        ("a.##.exr", "--stereo wide", "--stereo wide: expected the distance"),
        ("a.##.exr", "--stereo 0.1 --convergence -3", "--convergence -3.0: expected a depth above 0"),
        ("a.##.exr", "--convergence 3", "--convergence: applies only to stereo pairs, expected --stereo"),
        ("a.##.exr", "--eye left", "--eye: applies only to stereo pairs"),
        ("a.##.exr", "--stereo stage", "--stereo stage: expected a USD stage in --cameras"),
        ("a.##.exr", "--stereo 0.1 --deep", "--deep: "),
    ],
)
def test_errors_are_one_line(
    shot: list[str], tmp_path: Path, capsys: Capture, pattern: str, flags: str, message: str
) -> None:
    if pattern.endswith(".mp4"):
        require("av")
    assert message in fails(capsys, render, shot, tmp_path / pattern, flags)
    assert not list(tmp_path.iterdir())


def test_other_projections_are_refused() -> None:
    camera: Any = replace(scenes.tilted_camera(60, 40), projection="orthographic")
    refuses("--stereo: a frame is orthographic, expected perspective", seen_by, camera, "left", 0.1)


def test_names_and_settings() -> None:
    assert for_eye("{eye}/%V.%v.####.exr", "right") == "right/right.r.####.exr"
    assert for_eye("%v.exr", "") == "%v.exr"
    assert StereoConfig("0.1", eye="right").eyes == ("right",)
    assert StereoConfig().eyes == ()
    refuses("the cameras of --stereo stage have their own", StereoConfig("stage", convergence=2.0).check)


def test_a_pair_of_a_stage(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    require("pxr")
    stage = tmp_path / "shot.usda"
    stage.write_text(STAGE)
    assert (
        pair_of_stage(stage) == pair_of_stage(stage, "rig") == pair_of_stage(stage, "two") == ("/rig/one", "/rig/two")
    )
    with pytest.raises(InputError, match="--usd-camera single: belongs to no pair, expected --usd-camera with one of"):
        pair_of_stage(stage, "single")
    call = ["render", shot[0], "--cameras", str(stage), "--width", "64", "--progress", "none"]
    assert "stereoRole" not in printed(capsys, [*call, "-o", f"{tmp_path}/%V.##.exr", "--stereo", "stage"]).err
    cameras = {eye: f"/rig/{name}" for eye, name in (("left", "one"), ("right", "two"))}
    for eye, name in cameras.items():
        assert main([*call, "-o", f"{tmp_path}/{eye}.alone.##.exr", "--usd-camera", name]) == 0
        assert f"not applied: stereoRole ({eye})" in capsys.readouterr().err
        pair, alone = (pixels_of(tmp_path / f"{name}.02.exr") for name in (eye, f"{eye}.alone"))
        np.testing.assert_array_equal(pair, alone)
    stage.write_text(STAGE.replace('"right"', '"mono"'))
    assert main([*call, "-o", f"{tmp_path}/%V.##.exr", "--stereo", "stage"]) == 2
    assert "no prim has one camera of stereoRole left and one of right" in error_line(capsys)


RENDER = """def RenderSettings "Render"
{
    rel camera = </rig/one>
    uniform int2 resolution = (64, 48)
    uniform token aspectRatioConformPolicy = "adjustPixelAspectRatio"
}
"""


@pytest.mark.parametrize(
    ("flags", "settings", "message"),
    [
        ("--width 64", "", "--stereo: frame 1 has the size 64x48 for the left, 64x32 for the right eye; "),
        ("--width 64 --region 0,30,8,8", "", "--region 0,30,8,8: ends at 8,38, beyond the frame's size 64,32"),
        ("", RENDER, "--stereo: frame 1 has the pixel aspect ratio 1.0 for the left, 1.5 for the right eye; "),
    ],
)
def test_eyes_that_are_not_alike(
    flags: str, settings: str, message: str, shot: list[str], tmp_path: Path, capsys: Capture
) -> None:
    """One file has one window and one shape of pixels: told before anything is rendered. Two files may have two."""
    require("pxr")
    stage = STAGE
    for name, height in (("left", 15), ("right", 10)):
        aperture = f"float horizontalAperture = 20\n        float verticalAperture = {height}"
        stage = stage.replace(f'stereoRole = "{name}"', f'stereoRole = "{name}"\n        {aperture}')
    if settings:
        stage = stage.replace("endTimeCode = 2", 'endTimeCode = 2\n    renderSettingsPrimPath = "/Render"')
    (tmp_path / "shot.usda").write_text(stage + settings)
    call = ["render", shot[0], "--cameras", str(tmp_path / "shot.usda"), "--stereo", "stage", *flags.split()]
    assert message in rejected(capsys, [*call, "-o", tmp_path / "a.##.exr", "--dry-run"])
    if "--region" not in flags:
        assert main([*call, "-o", str(tmp_path / "{eye}.##.exr"), "--dry-run"]) == 0


def test_each_eye_has_a_holdout(shot: list[str], tmp_path: Path, capsys: Capture) -> None:
    """A missing one, or one of another size, is told before anything is rendered, in one file as in two."""
    whole = np.full((64, 96), 4.0)
    for names in ("a.##.exr", "{eye}.##.exr"):
        folder = tmp_path / names[:2].strip("{.")
        folder.mkdir()
        flags = f"--stereo 0.1 --frames 1 --alpha --holdout {folder}/z.{{eye}}.exr"
        write_flat(folder / "z.left.exr", {"Z": whole})
        assert f"{folder}/z.right.exr: no such holdout" in fails(capsys, render, shot, folder / names, flags)
        write_flat(folder / "z.right.exr", {"Z": whole[:, 1:]})
        assert render(shot, folder / names, flags) == 2
        assert "z.right.exr: has a display window of 95x64 pixels, expected 96x64" in error_line(capsys)
        write_flat(folder / "z.right.exr", {"Z": np.inf * whole})
        assert not list(folder.glob("*01.exr"))
        assert render(shot, folder / names, flags) == 0
        paths = [(folder / "a.01.exr", part) for part in (0, 1)]
        if "eye" in names:
            paths = [(folder / f"{eye}.01.exr", 0) for eye in ("left", "right")]
        assert [bool(pixels_of(*path)[:, :, 3].max() > 0.5) for path in paths] == [False, True]


def test_a_map_is_looked_at_for_both_eyes(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(96.0), np.arange(64.0))
    write_stmap(tmp_path / "map.exr", np.stack([x, y], axis=2), 96, 64)
    options = RenderOptions(pictures=PictureConfig(warp=WarpConfig(stmap=str(tmp_path / "map.exr"))))
    camera = scenes.tilted_camera(96, 64)
    right = Task(1, "1", replace(camera, projection="equirectangular"), tmp_path / "a.exr", eye="right")
    with pytest.raises(InputError, match="frame 1 is a panorama"):
        check_warps([Task(1, "1", camera, tmp_path / "a.exr", eye="left", right=right)], options.pictures)


def test_a_pair_in_strips_is_no_file_of_one_eye(tmp_path: Path) -> None:
    """A deep holdout of many surfaces asks for strips where one of a few does not, which the check goes by."""

    class InStrips(FrameRenderer):
        def _rows(self, camera: Camera, planes: int) -> int:
            return 16 if planes > HELD_PIXEL_BYTES else camera.height

    camera, deep = scenes.tilted_camera(64, 40), [[(1.0, z) for z in (3.0, 4.0, 5.0)]] * (64 * 40)
    write_samples(tmp_path / "z.exr", (64, 40), deep)
    options = RenderOptions(("rgb", "alpha"), holdout=HoldoutConfig())
    left, right = (Task(1, "1", camera, tmp_path / "a.exr", eye=eye, holdout=tmp_path / "z.exr") for eye in EYES)
    frames, pair = InStrips(Renderer(), scenes.one()[0], options), replace(left, right=right)
    frames.check([pair])
    refuses("a picture of 64x40 is too large to be written at once, expected a file for each eye", frames, pair)
    assert not (tmp_path / "a.exr").exists()


def test_a_panorama_says_so(tmp_path: Path) -> None:
    scenes.one()[0].save(tmp_path / "model.ply")
    key = {"frame": 1, "position": [0, 0, 0], "world_from_cam": [1, 0, 0, 0]}
    document = {"clsplat_cameras": 1, "width": 64, "height": 32, "projection": "equirectangular", "keys": [key]}
    for name, change in (("whole", {}), ("part", {"keys": [{**key, "fov_x": 180, "fov_y": 90}]})):
        (tmp_path / "cameras.json").write_text(json.dumps({**document, **change}))
        call = ["render", str(tmp_path / "model.ply"), "--cameras", str(tmp_path / "cameras.json")]
        assert main([*call, "-o", str(tmp_path / f"{name}.exr"), "--progress", "none"]) == 0
    assert exr_attributes(tmp_path / "whole.exr")["envmap"] == ("envmap", b"\x00")  # latlong
    assert "envmap" not in exr_attributes(tmp_path / "part.exr")
    assert main([*call, "-o", str(tmp_path / "cut.exr"), "--region", "0,0,8,8"]) == 0
    assert "envmap" not in exr_attributes(tmp_path / "cut.exr")


def test_cameras_are_of_whole_frames() -> None:
    """A pair of another size is the pair at that size: the shift goes with the focal length."""
    camera = Camera(60, 40, 50.0, 50.0, 30.0, 20.0, np.eye(3), np.zeros(3))
    twice = seen_by(camera, "left", DISTANCE, CONVERGENCE).resized(120, 80)
    again = seen_by(camera.resized(120, 80), "left", DISTANCE, CONVERGENCE)
    assert (twice.cx, twice.cy) == (again.cx, again.cy)

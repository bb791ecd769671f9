# SPDX-License-Identifier: Apache-2.0
"""`clsplat render` through orthographic cameras, from each format that knows them, on a real device."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from calls import Capture, error_line
from compare import assert_close
from needs import require
from numpy.typing import NDArray
from scenes import make_gaussians
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera
from clsplat.cli.main import main
from clsplat.gaussians import Gaussians
from clsplat.reference import every_pixel
from clsplat.reference.cameras import pixel_from_world
from clsplat.shots.viewpoints import look_at

WIDTH, HEIGHT, PIXEL = 160, 128, 0.03125
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
CHANNELS = ["--channels", "rgb,alpha,depth,normals,position,motion"]

POSITION = np.array([3.0, -4.0, 2.5])
ROTATION, TRANSLATION = look_at(POSITION, np.zeros(3), np.array([0.0, 0.0, 1.0]))
RIGHT = ROTATION[0]
CAMERA = Camera(
    *(WIDTH, HEIGHT, 1 / PIXEL, 1 / PIXEL, WIDTH / 2, HEIGHT / 2), ROTATION, TRANSLATION, projection="orthographic"
)


def cube() -> Gaussians:
    """A small ball at each corner of a cube of side 2, each of its own colour."""
    sh = ((CORNERS + 1) / 2 - 0.4)[:, None, :] / 0.3
    still = np.tile([1.0, 0, 0, 0], (8, 1))
    return make_gaussians(CORNERS, still, np.full((8, 3), np.log(0.05)), np.full(8, 0.97), sh)


def keyed(path: Path, poses: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> Path:
    """Frames from 1 on with these rotations (cam_from_world) and positions."""
    keys: list[dict[str, Any]] = []
    for rotation, position in poses:
        x, y, z, w = Rotation.from_matrix(rotation.T).as_quat().tolist()
        keys.append({"frame": len(keys) + 1, "position": position.tolist(), "world_from_cam": [w, x, y, z]})
    size = {"width": WIDTH, "height": HEIGHT, "projection": "orthographic", "pixel_size": PIXEL}
    path.write_text(json.dumps({"clsplat_cameras": 1, **size, "keys": keys}))
    return path


def stage(path: Path) -> Path:
    """The camera, and at frame 2 a step to its right; apertures are in tenths of a unit."""
    require("pxr")

    def rows(step: float) -> str:
        matrix = np.eye(4)
        matrix[:3, :3] = np.diag([1, -1, -1]) @ ROTATION
        matrix[3, :3] = POSITION + step * RIGHT
        return "(" + ", ".join("(" + ", ".join(map(repr, row)) + ")" for row in matrix.tolist()) + ")"

    path.write_text(f"""#usda 1.0
(
    startTimeCode = 1
    endTimeCode = 2
)
def Camera "flat"
{{
    token projection = "orthographic"
    float horizontalAperture = {10 * WIDTH * PIXEL}
    float verticalAperture = {10 * HEIGHT * PIXEL}
    float2 clippingRange = (0.01, 100)
    matrix4d xformOp:transform.timeSamples = {{ 1: {rows(0.0)}, 2: {rows(0.25)} }}
    uniform token[] xformOpOrder = ["xformOp:transform"]
}}
""")
    return path


def read(path: Path) -> tuple[dict[str, NDArray[np.float32]], Any]:
    source = oiio.ImageInput.open(str(path))
    assert source is not None, oiio.geterror()
    spec = source.spec()
    pixels = source.read_image(0, 0, 0, spec.nchannels, oiio.FLOAT)
    source.close()
    return {name: pixels[:, :, index] for index, name in enumerate(spec.channelnames)}, spec


@pytest.mark.parametrize("name", ["shot.json", "shot.usda"])
def test_render(name: str, tmp_path: Path) -> None:
    gaussians = cube()
    gaussians.save(tmp_path / "model.ply")
    if name == "shot.json":
        cameras, size = keyed(tmp_path / name, [(ROTATION, POSITION), (ROTATION, POSITION + 0.25 * RIGHT)]), []
    else:
        cameras, size = stage(tmp_path / name), ["--width", str(WIDTH)]
    arguments = ["--cameras", str(cameras), *size, "-o", str(tmp_path / "a.##.exr"), *CHANNELS]
    assert main(["render", str(tmp_path / "model.ply"), *arguments]) == 0
    found, spec = read(tmp_path / "a.01.exr")
    after = replace(CAMERA, translation=-ROTATION @ (POSITION + 0.25 * RIGHT))
    wanted = every_pixel.render(gaussians, CAMERA, after=after)
    names = {"R": wanted.image[:, :, 0], "A": wanted.alpha, "Z": wanted.features["depth"]}
    names |= {"P.y": wanted.features["position"][:, :, 1], "N.z": wanted.features["normal"][:, :, 2]}
    names["forward.u"] = wanted.features["motion"][:, :, 0]
    solid = (wanted.alpha > 0.5) & (wanted.margin > 3e-4)
    assert solid.sum() > 50
    for channel, values in names.items():
        # The bound; a position may pass through zero.
        assert_close(found[channel][solid], values[solid], relative=1e-4, absolute=1e-4, name=channel)
    assert_close(found["forward.u"][solid], np.full(solid.sum(), -0.25 / PIXEL), relative=1e-5)
    assert_close(centres(found, spec), pixel_from_world(CAMERA, CORNERS)[0], absolute=0.03)


def centres(found: dict[str, NDArray[np.float32]], spec: Any) -> NDArray[np.float64]:
    """Where the picture shows the corners' balls (8, 2), in pixels; as large at every depth. The header's matrix tells
    where to look."""
    to_ndc = np.reshape(spec.getattribute("worldToNDC"), (4, 4))
    ndc = np.concatenate([CORNERS, np.ones((8, 1))], axis=1) @ to_ndc
    wanted = ndc[:, :2] * [WIDTH, HEIGHT]
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    got, areas = [], []
    for at in wanted:
        own = np.where((abs(x - at[0]) < 7) & (abs(y - at[1]) < 7), found["A"], 0.0)
        areas.append(own.sum())
        got.append([(x * own).sum() / areas[-1], (y * own).sum() / areas[-1]])
    # Sums of pixels for integrals, without alphas under 1/255.
    np.testing.assert_allclose(areas, np.mean(areas), rtol=0.02)
    return np.array(got)


def test_a_turntable_has_parallel_edges(tmp_path: Path) -> None:
    cube().save(tmp_path / "model.ply")
    angles = np.deg2rad([-53.0, 37.0, 127.0, 217.0])
    places = [np.array([5 * np.cos(angle), 5 * np.sin(angle), 2.5]) for angle in angles]
    poses = [(look_at(place, np.zeros(3), np.array([0.0, 0.0, 1.0]))[0], place) for place in places]
    cameras = keyed(tmp_path / "keys.json", poses)
    out = ["-o", str(tmp_path / "t.##.exr"), "--path", "turntable", "--count", "8", "--channels", "rgb,alpha"]
    assert main(["render", str(tmp_path / "model.ply"), "--cameras", str(cameras), *out]) == 0
    pictures = []
    for frame in range(1, 9):
        found, spec = read(tmp_path / f"t.{frame:02d}.exr")
        pictures.append(found["A"])
        at = centres(found, spec)
        for step in (1, 2, 4):  # the four edges along an axis are one vector
            edges = np.array([at[i + step] - at[i] for i in range(8) if not i & step])
            np.testing.assert_allclose(edges, np.tile(edges.mean(axis=0), (4, 1)), atol=0.06)
    # A quarter of a turn: alike, as the cube is; poses are good to a few float32.
    assert_close(pictures[2], pictures[0], absolute=1e-4)


def test_what_nerfstudio_does_not_know(tmp_path: Path, capsys: Capture) -> None:
    cube().save(tmp_path / "model.ply")
    key = {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 60}
    document = {"camera_type": "orthographic", "render_width": 8, "render_height": 6, "camera_path": [key]}
    (tmp_path / "camera_path.json").write_text(json.dumps(document))
    out = ["-o", str(tmp_path / "a.exr")]
    assert main(["render", str(tmp_path / "model.ply"), "--cameras", str(tmp_path / "camera_path.json"), *out]) == 2
    assert "'camera_type' is 'orthographic', expected one of perspective, fisheye, equirectangular" in error_line(
        capsys
    )

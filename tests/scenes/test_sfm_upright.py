# SPDX-License-Identifier: Apache-2.0
"""What `clsplat sfm` recovers of the demo's still life, whose true frame is known: up, ground and length of a metre."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pycolmap
import pytest
from compare import similarity
from demo_photographs import photographs

from clsplat.arrays import Float64
from clsplat.config.orientation import FrameUse
from clsplat.scenes.loading import load_scene
from clsplat.scenes.scene import Scene
from clsplat.scenes.sfm import reconstruct as sfm

pytestmark = pytest.mark.slow  # features, matches and poses of twelve photographs
COUNT = 12
WRONG = (1, 4, 9)
"""Photographs whose GPS is a kilometre off."""


def sexagesimal(degrees: float) -> tuple[float, float, float]:
    minutes = 60 * (abs(degrees) % 1)
    return float(int(abs(degrees))), float(int(minutes)), 60 * (minutes % 1)


def tagged(path: Path, picture: Any, place: tuple[float, float, float]) -> None:
    """Write a JPEG with GPS. place: latitude and longitude in degrees, altitude in metres."""
    spec = oiio.ImageSpec(picture.shape[1], picture.shape[0], 3, "uint8")
    spec.attribute("Compression", "jpeg:97")
    spec.attribute("jpeg:subsampling", "4:4:4")
    for name, value, side in (("Latitude", place[0], "NS"), ("Longitude", place[1], "EW")):
        spec.attribute(f"GPS:{name}Ref", side[int(value < 0)])
        spec.attribute(f"GPS:{name}", oiio.TypeDesc("float[3]"), sexagesimal(value))
    spec.attribute("GPS:Altitude", float(place[2]))
    image = oiio.ImageBuf(spec)
    assert image.set_pixels(oiio.ROI.All, np.ascontiguousarray(picture))
    assert image.write(str(path)), image.geterror()


@pytest.fixture(scope="module")
def true() -> tuple[list[Any], Float64]:
    """Pictures of the demo's ring, and their true positions (12, 3) in metres, with z up."""
    pictures, cameras = photographs(range(COUNT), 240, 180)
    return pictures, np.stack([np.asarray(camera.position, np.float64) for camera in cameras])


@pytest.fixture(scope="module")
def photos(true: tuple[list[Any], Float64], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The photographs, with x east and y north, in a world that is a hundred times as large for GPS's sake."""
    folder = tmp_path_factory.mktemp("photos")
    enu = 100 * true[1] + np.random.default_rng(0).normal(0, 2.0, (COUNT, 3))  # errors of 2 m over some 200 m
    enu[list(WRONG)] += (0, 1000, 0)
    globe = pycolmap.GPSTransform().enu_to_ellipsoid(enu, 46.5, 7.5, 900.0)
    for index, (picture, place) in enumerate(zip(true[0], globe, strict=True)):
        tagged(folder / f"view_{index:02d}.jpg", picture, tuple(place))
    return folder


@pytest.fixture(scope="module")
def scene(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = sfm.SfmSettings(camera_model="SIMPLE_PINHOLE")
    return sfm.reconstruct(photos, tmp_path_factory.mktemp("scenes") / "scene", settings)


def reframed(photos: Path, scene: Path, orient: Any, scale: str) -> Scene:
    """The scene in another frame. The cameras are not recovered again."""
    settings = sfm.SfmSettings(camera_model="SIMPLE_PINHOLE", frame=FrameUse(orient, scale))
    return load_scene(sfm.reconstruct(photos, scene, settings))


def against(scene: Scene, places: Float64) -> tuple[float, Float64, Float64]:
    """Scale, rotation and translation from the scene to the true metres."""
    return similarity(np.stack([view.camera.position for view in scene.views]), places)


def test_the_still_life_stands_upright_on_its_floor(true: tuple[list[Any], Float64], scene: Path) -> None:
    loaded = load_scene(scene)
    assert loaded.frame.upright
    scale, rotation, shift = against(loaded, true[1])
    tilt = np.rad2deg(np.arccos(rotation @ (0.0, -1.0, 0.0) @ (0.0, 0.0, 1.0)))
    assert tilt < 1.0  # errors of poses of 20 mm at 2.5 m
    assert abs(shift[2]) < 0.03  # the origin is on the floor, z = 0
    assert np.linalg.norm(shift[:2]) < 0.5  # among the things, which are within 1 m of the middle
    assert np.linalg.norm(scale * rotation.T @ rotation - scale * np.eye(3)) < 1e-9


def test_a_known_length_gives_metres_within_a_percent(
    true: tuple[list[Any], Float64], photos: Path, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sfm, "run_worker", lambda *_: pytest.fail("recovered again"))
    metres = float(np.linalg.norm(true[1][0] - true[1][COUNT - 1]))
    loaded = reframed(photos, scene, None, f"view_00,view_{COUNT - 1}={metres!r}")
    assert against(loaded, true[1])[0] == pytest.approx(1, rel=0.01)
    assert loaded.frame.upright
    ends = loaded.views[2].camera.position, loaded.views[8].camera.position
    text = ",".join(f"{value!r}" for value in np.concatenate(ends).tolist())
    metres = float(np.linalg.norm(true[1][2] - true[1][8]))
    loaded = reframed(photos, scene, None, f"{text}={metres!r}")
    assert against(loaded, true[1])[0] == pytest.approx(1, rel=0.01)


def test_gps_gives_metres_and_north_and_three_wrong_positions_are_named(
    true: tuple[list[Any], Float64], photos: Path, scene: Path
) -> None:
    with pytest.warns(
        match="GPS of 3 photograph.s. is far from the cameras and not used: view_01.jpg by (999|1,00.) m"
    ):
        loaded = reframed(photos, scene, "up", "gps")
    scale, rotation, _ = against(loaded, 100 * true[1])
    assert scale == pytest.approx(
        1, rel=0.03
    )  # errors of 2 m over a spread of 190 m, nine photographs: 0.4 %; poses 1 %
    north = rotation @ (0.0, 0.0, 1.0)
    assert np.rad2deg(np.arctan2(north[0], north[1])) == pytest.approx(0, abs=2.0)
    latitude, longitude, altitude = loaded.frame.origin
    assert (latitude, longitude) == pytest.approx((46.5, 7.5), abs=0.001)  # the middle of the things, within 100 m
    assert altitude == pytest.approx(900, abs=10)
    assert "GPS positions of 9 photographs" in loaded.frame.scale_note


def test_colmaps_own_frame_comes_back(photos: Path, scene: Path) -> None:
    loaded = reframed(photos, scene, "none", "")
    assert not loaded.frame.upright
    matrix = loaded.frame.world_from_source
    np.testing.assert_array_equal(matrix, matrix[0, 0] * np.diag([1, 1, 1, 1 / matrix[0, 0]]))

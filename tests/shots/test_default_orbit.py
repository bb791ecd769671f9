# SPDX-License-Identifier: Apache-2.0
"""Cameras around a model of which nothing else is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calls import refuses
from models import random_gaussians

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.models import edit
from clsplat.shots import shot_around
from clsplat.shots.default_orbit import (
    CAMERAS_PER_RING,
    DEFAULT_ORBIT_SIZE_PX,
    ORBIT_FRAMING_MARGIN,
    among,
    cameras_around,
    parse_up,
)
from clsplat.shots.viewpoints import look_at


def cloud(means: Float64, scale: float = 0.02) -> Gaussians:
    """Small opaque Gaussians at these places (n, 3)."""
    model = random_gaussians(len(means), 0)
    model.means = means.astype(np.float32)
    model.log_scales[:] = np.log(scale)
    model.opacity_logits[:] = 2
    return model


def ball(count: int, radius: float, centre: tuple[float, float, float] = (0, 0, 0)) -> Float64:
    """Places (count, 3) spread evenly in a ball."""
    rng = np.random.default_rng(count)
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return centre + radius * rng.random((count, 1)) ** (1 / 3) * directions


@pytest.mark.parametrize("up", ["-y", "y", "z", "-x", "0.1,-2,0.3"])
def test_all_of_a_thing_is_in_every_picture(up: str) -> None:
    """Strays do not count; the cameras are level, and their middle ray goes through the thing's middle."""
    strays = 100 * ball(20, 1)
    model = cloud(np.concatenate([ball(2000, 0.5, (3, -2, 7)), strays]))
    axis = np.array(parse_up(up))
    cameras = cameras_around(model, parse_up(up), (320, 200))
    assert len(cameras) == 3 * CAMERAS_PER_RING
    thing = model.means[:2000].astype(np.float64)
    for camera in cameras:
        seen = thing @ camera.rotation.T + camera.translation
        pixels = seen[:, :2] / seen[:, 2:] * camera.fx + (camera.cx, camera.cy)
        assert (seen[:, 2] > 0).all() and ((pixels > 0) & (pixels < (320, 200))).all()
        assert abs(camera.rotation[0] @ axis) < 1e-9 < -camera.rotation[1] @ axis
    depth = (cameras[0].rotation @ (3, -2, 7) + cameras[0].translation)[2]
    height = np.ptp((thing @ cameras[0].rotation[1]) * cameras[0].fx / depth)
    assert 0.4 * 200 < height < 200 / ORBIT_FRAMING_MARGIN, "and it fills the picture"


def test_a_scene_is_looked_at_where_its_detail_is() -> None:
    """A room of large Gaussians with a thing of small ones in it, off its middle."""
    room, thing = cloud(8 * np.random.default_rng(0).uniform(-1, 1, (3000, 3)), 0.4), cloud(ball(3000, 0.5, (3, 2, -4)))
    for camera in cameras_around(edit.merge([room, thing])):
        middle = camera.rotation @ (3, 2, -4) + camera.translation
        assert np.hypot(*middle[:2]) < 0.1, "the thing is ahead"
        assert 0.5 < middle[2] < 4, "and near"


@pytest.mark.parametrize("size", [-103.0, -25.0, -np.inf])
def test_gaussians_of_no_size_are_no_detail(size: float) -> None:
    model = cloud(ball(2000, 0.5))
    wanted = cameras_around(model)[0].position
    model.log_scales[7] = size
    model.log_scales[9:12] = size
    assert np.allclose(cameras_around(model)[0].position, wanted)


def test_what_the_world_counts_from_moves_the_cameras_along() -> None:
    model = cloud(ball(500, 1))
    far = replace(model, origin=np.array([4e5, -5e6, 100.0]))
    for near, moved in zip(cameras_around(model), cameras_around(far), strict=True):
        assert np.allclose(moved.position - far.origin, near.position, atol=1e-6)  # float64 of 5e6
        assert np.allclose(moved.rotation, near.rotation, atol=1e-8)  # the same, of directions


@pytest.mark.parametrize("count", [1, 2, 3])
def test_models_of_next_to_nothing(count: int) -> None:
    """One Gaussian, several in one place and a line have cameras; none has not."""
    for means in (np.zeros((count, 3)), np.arange(3.0 * count).reshape(count, 3)):
        for camera in cameras_around(cloud(means)):
            assert np.isfinite(camera.rotation).all() and np.isfinite(camera.translation).all()
            assert (means @ camera.rotation.T + camera.translation)[:, 2].min() > 0
    refuses("has no Gaussians", cameras_around, edit.take(cloud(np.zeros((1, 3))), slice(0)))


@pytest.mark.parametrize(
    ("asked", "got"),
    [((None, None), DEFAULT_ORBIT_SIZE_PX), ((640, None), (640, 360)), ((None, 90), (160, 90)), ((50, 80), (50, 80))],
)
def test_sizes(asked: tuple[int | None, int | None], got: tuple[int, int]) -> None:
    camera = cameras_around(cloud(ball(9, 1)), size=asked)[0]
    assert (camera.width, camera.height) == got


def test_paths_around_a_model() -> None:
    """A turntable keeps one height, a spiral rises and sinks; both close."""
    model = cloud(ball(500, 1))
    turn = shot_around(model, "turntable", count=8).cameras
    heights = [-camera.position[1] for camera in turn]
    assert np.ptp(heights) < 1e-9 and heights[0] > 0.5, "above, as -y is up"
    assert np.allclose(turn[0].position + turn[4].position, 2 * np.array([0, -heights[0], 0]), atol=0.2)
    assert turn[0].position[2] < -2, "the first looks along z"
    assert np.ptp([-camera.position[1] for camera in shot_around(model, "spiral", count=40).cameras]) > 1
    assert len(shot_around(model, "turntable").frames) == 120


@pytest.mark.parametrize("text", ["w", "1,2", "0,0,0", "nan,1,1", "1,inf,0", "--y", ""])
def test_what_is_no_direction(text: str) -> None:
    refuses(f"--up {text}: expected x, y, z", parse_up, text)


def test_a_direction_has_length_one() -> None:
    for text in ("0,-3,4", "0,-3e200,4e200", "0,-3e-200,4e-200"):
        assert np.allclose(parse_up(text), (0, -0.6, 0.8))
    assert parse_up("-z") == (0, 0, -1)


def photographs(count: int = 12, width: int = 300, height: int = 200) -> list[Camera]:
    """Cameras on a circle of radius 1 in a room, that look at its middle and 20 degrees down."""
    cameras = []
    for angle in 2 * np.pi * np.arange(count) / count:
        position = np.array([np.sin(angle), -np.tan(np.radians(20)), -np.cos(angle)])
        pose = look_at(position, np.zeros(3), np.array([0.0, -1.0, 0.0]))
        cameras.append(Camera(width, height, 200.0, 210.0, 140.0, 101.0, *pose))
    return cameras


def test_a_path_among_own_cameras_stays_inside() -> None:
    """Walls at a distance of 3 are seen from where the photographs were taken, 1 from the middle."""
    room = cloud(ball(500, 3))
    own = photographs()
    turn = shot_around(room, "turntable", count=8, own=own).cameras
    places = np.stack([camera.position for camera in turn])
    assert np.allclose(np.linalg.norm(places[:, [0, 2]], axis=1), 1)
    assert np.allclose(places[0], own[0].position)
    assert (turn[0].width, turn[0].fx, turn[0].cx) == (300, 200.0, 140.0)
    outside = shot_around(room, "turntable", count=8, own=own, up="-y").cameras
    assert min(np.linalg.norm(camera.position) for camera in outside) > 3
    assert len(shot_around(room, "through", count=5, own=own).frames) == 5
    refuses("--path through: goes through cameras", shot_around, room, "through", own=own, up="-y")


@pytest.mark.parametrize(
    ("shape", "size", "scale"),
    [((300, 200), (512, 512), 2.56), ((200, 300), (512, 512), 2.56), ((300, 200), (600, 200), 2.0)],
)
def test_pictures_of_another_shape_show_what_was_photographed(
    shape: tuple[int, int], size: tuple[int, int], scale: float
) -> None:
    """The longer sides are cut, the shorter kept; the principal point keeps its distance from the middle."""
    camera = among(photographs(12, *shape), size)[0]
    assert (camera.width, camera.height) == size
    assert (camera.fx, camera.fy) == pytest.approx((200 * scale, 210 * scale))
    away = (140 - shape[0] / 2, 101 - shape[1] / 2)
    assert (camera.cx - size[0] / 2, camera.cy - size[1] / 2) == pytest.approx((away[0] * scale, away[1] * scale))


def test_strays_and_other_projections_among_own_cameras() -> None:
    own = photographs()
    far = replace(own[3], translation=own[3].translation + np.array([0, 0, 5000.0]))
    assert len(among([*own, far])) == len(own)
    fisheyes = [replace(camera, projection="fisheye") for camera in own]
    camera = among(fisheyes, (400, 300))[0]
    assert (camera.projection, camera.width, camera.height) == ("perspective", 400, 300)
    assert 2 * np.degrees(np.arctan(150 / camera.fy)) == pytest.approx(40)  # FIELD
    assert np.allclose(camera.position, own[0].position)

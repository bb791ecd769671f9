# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from calls import refuses

from clsplat.camera import Camera
from clsplat.scenes.orientation.level import focus_point, up_axis
from clsplat.shots.generated import turntable
from clsplat.shots.viewpoints import covered_arc, look_at


def rotated_world(seed):
    """An arbitrary rotation: no axis of the world may be taken for up."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def ring(azimuths, world, centre, radius=3.0, height=1.5):
    up = world[:, 2]
    cameras = []
    for azimuth in azimuths:
        position = centre + world @ np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
        rotation, translation = look_at(position, centre, up)
        cameras.append(Camera(64, 48, 60.0, 61.0, 31.0, 25.0, rotation, translation))
    return cameras


CENTRE = np.array([5.0, -2.0, 7.0])


def test_look_at_is_a_level_rotation_that_faces_the_target():
    up = np.array([0.0, 0.0, 1.0])
    rotation, translation = look_at(np.array([4.0, 1.0, 2.0]), np.array([0.0, 0.0, 1.0]), up)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    x, y, z = rotation @ [0.0, 0.0, 1.0] + translation
    assert x == pytest.approx(0) and y == pytest.approx(0) and z == pytest.approx(np.sqrt(18))
    assert rotation[0] @ up == pytest.approx(0)
    assert rotation[1] @ up < 0  # image y points down


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("azimuths", [np.arange(12) * 2 * np.pi / 12, np.linspace(0.2, 1.3, 7)])
def test_up_and_focus_of_a_ring(seed, azimuths):
    world = rotated_world(seed)
    cameras = ring(azimuths, world, CENTRE)
    np.testing.assert_allclose(up_axis(cameras), world[:, 2], atol=1e-6)
    np.testing.assert_allclose(focus_point(cameras), CENTRE, atol=1e-6)


def test_up_of_cameras_side_by_side_is_the_images_up():
    world = rotated_world(1)
    rotation, _ = look_at(CENTRE, CENTRE + world[:, 0], world[:, 2])
    cameras = [
        Camera(64, 48, 60.0, 60.0, 32.0, 24.0, rotation, -rotation @ (CENTRE + step * world[:, 1])) for step in range(5)
    ]
    np.testing.assert_allclose(up_axis(cameras), world[:, 2], atol=1e-6)
    ahead = (focus_point(cameras) - CENTRE) @ world[:, 0]
    assert ahead > 0.5  # parallel axes meet nowhere: still a point in front
    for camera in turntable(cameras, 7):
        assert np.isfinite(camera.rotation).all() and np.isfinite(camera.translation).all()


def test_turntable_goes_round_once_at_the_cameras_distance():
    world = rotated_world(2)
    cameras = ring(np.arange(10) * 2 * np.pi / 10 + 0.3, world, CENTRE)
    path = turntable(cameras, 24)
    assert len(path) == 24
    np.testing.assert_allclose(path[0].position, cameras[0].position, atol=1e-6)
    local = np.stack([(camera.position - CENTRE) @ world for camera in path])
    np.testing.assert_allclose(np.hypot(local[:, 0], local[:, 1]), 3.0, atol=1e-6)
    np.testing.assert_allclose(local[:, 2], 1.5, atol=1e-6)
    steps = np.diff(np.unwrap(np.arctan2(local[:, 1], local[:, 0])))
    np.testing.assert_allclose(np.abs(steps), 2 * np.pi / 24, atol=1e-6)
    for camera in path:
        assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (64, 48, 60, 61, 31, 25)
        x, y, _ = camera.rotation @ CENTRE + camera.translation
        assert abs(x) < 1e-6 and abs(y) < 1e-6


@pytest.mark.parametrize("shift", [0.0, 2.0, 5.5])
def test_turntable_stays_on_the_side_that_was_photographed(shift):
    world = rotated_world(3)
    azimuths = np.linspace(0.0, 1.2, 9)[[3, 0, 1, 2, 4, 5, 6, 7, 8]] + shift
    cameras = ring(azimuths, world, CENTRE)
    path = turntable(cameras, 40)
    local = np.stack([(camera.position - CENTRE) @ world for camera in path])
    turned = np.unwrap(np.arctan2(local[:, 1], local[:, 0]))
    assert turned.max() - turned.min() <= 1.2 + 1e-6
    assert turned.max() - turned.min() > 1.15
    np.testing.assert_allclose(path[0].position, cameras[0].position, atol=1e-6)
    closing = np.linalg.norm(path[-1].position - path[0].position)
    assert closing < 3.0 * 1.2 * np.pi / 40 * 1.5  # no jump where the path closes


def test_covered_arc_may_cross_the_seam():
    begin, width = covered_arc(np.array([-0.2, 0.1, 0.4]))
    assert begin == pytest.approx(2 * np.pi - 0.2)
    assert width == pytest.approx(0.6)


def test_nothing_to_turn():
    refuses("expected at least one", turntable, [], 10, error=ValueError)
    single = ring([0.5], rotated_world(0), CENTRE)
    assert len(turntable(single, 3)) == 3

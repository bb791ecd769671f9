# SPDX-License-Identifier: Apache-2.0
"""Paths made from a scene's cameras; turntables are in test_trajectory.py."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import pytest
from calls import refuses
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera
from clsplat.shots.generated import PATH_GENERATORS, parabola_weights, spiral, through
from clsplat.shots.viewpoints import look_at

FOCUS = np.array([5.0, -2.0, 7.0])
WORLD = Rotation.from_euler("xyz", [0.4, -1.3, 2.2]).as_matrix()
UP = WORLD[:, 2]


def dome(azimuths: Sequence[float], elevations: Sequence[float], distance: float = 4.0) -> list[Camera]:
    cameras = []
    for azimuth, elevation in zip(azimuths, elevations, strict=True):
        level = np.cos(elevation)
        local = distance * np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
        rotation, translation = look_at(FOCUS + WORLD @ local, FOCUS, UP)
        cameras.append(Camera(64, 48, 60.0, 61.0, 31.0, 25.0, rotation, translation))
    return cameras


def spherical(path: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    local = (np.array([camera.position for camera in path]) - FOCUS) @ WORLD
    distance = np.linalg.norm(local, axis=1)
    return np.arctan2(local[:, 1], local[:, 0]), np.arcsin(local[:, 2] / distance), distance


def assert_level_and_facing(path: Sequence[Camera]) -> None:
    for camera in path:
        assert camera.rotation[0] @ UP == pytest.approx(0, abs=1e-6)
        x, y, z = camera.rotation @ FOCUS + camera.translation
        assert abs(x) < 1e-5
        assert abs(y) < 1e-5
        assert z > 0
        assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (64, 48, 60, 61, 31, 25)


def test_a_spiral_goes_round_twice_while_it_rises_and_sinks() -> None:
    rng = np.random.default_rng(0)
    count = 60
    cameras = dome(np.arange(count) * 2 * np.pi / count, rng.uniform(0.1, 1.0, count))
    path = spiral(cameras, 200)
    assert len(path) == 200
    assert_level_and_facing(path)
    azimuth, elevation, distance = spherical(path)
    np.testing.assert_allclose(np.diff(np.unwrap(azimuth)), 4 * np.pi / 200, atol=1e-6)
    low, high = np.percentile([np.arcsin((c.position - FOCUS) @ UP / 4.0) for c in cameras], [10, 90])
    assert elevation.argmin() == 0
    assert elevation.argmax() == 100
    np.testing.assert_allclose([elevation.min(), elevation.max()], [low, high], atol=1e-6)
    np.testing.assert_allclose(distance, 4.0, atol=1e-5)


def test_a_spiral_before_a_scene_stays_where_the_photographs_were_taken() -> None:
    rng = np.random.default_rng(1)
    cameras = dome(rng.uniform(1.0, 1.8, 40), rng.uniform(-0.2, 0.3, 40))
    path = spiral(cameras, 120)
    assert_level_and_facing(path)
    azimuth, elevation, distance = spherical(path)
    seen_azimuth, seen_elevation, seen_distance = spherical(cameras)
    for values, seen in ((azimuth, seen_azimuth), (elevation, seen_elevation), (distance, seen_distance)):
        assert seen.min() - 1e-5 <= values.min()
        assert values.max() <= seen.max() + 1e-5
    assert np.ptp(azimuth) > 0.9 * np.ptp(seen_azimuth)
    # closed: the step from the last frame to the first is one like the others
    steps = np.linalg.norm(np.diff([c.position for c in (*path, path[0])], axis=0), axis=1)
    assert steps[-1] < 1.5 * steps[:-1].max()


def test_through_the_cameras_in_their_order() -> None:
    cameras = dome(np.linspace(0, 2.0, 9), np.linspace(0.1, 0.6, 9))
    path = through(cameras, 81)
    assert len(path) == 81
    for there, given in ((path[0], cameras[0]), (path[-1], cameras[-1])):  # the ends stay
        np.testing.assert_allclose(there.position, given.position, atol=1e-9)
        np.testing.assert_allclose(there.rotation, given.rotation, atol=1e-9)
    positions = np.array([camera.position for camera in path])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert steps.max() < 1.2 * steps.min()  # evenly
    for index, camera in enumerate(cameras):  # cameras that stand on a smooth curve hardly move
        assert np.linalg.norm(positions - camera.position, axis=1).min() < 0.1
        if index:
            before = np.linalg.norm(positions - cameras[index - 1].position, axis=1).argmin()
            assert np.linalg.norm(positions - camera.position, axis=1).argmin() > before


def test_the_weights_are_those_of_a_parabola() -> None:
    np.testing.assert_allclose(parabola_weights(0), [1])
    np.testing.assert_allclose(parabola_weights(1), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(parabola_weights(3), np.array([-2, 3, 6, 7, 6, 3, -2]) / 21)


def test_through_smooths_a_hand_that_shakes() -> None:
    rng = np.random.default_rng(2)
    smooth = dome(np.linspace(0, 2.0, 40), np.full(40, 0.3))
    shaken = [
        Camera(64, 48, 60.0, 61.0, 31.0, 25.0, turned, -turned @ (camera.position + rng.normal(0, 0.03, 3)))
        for camera in smooth
        for turned in [Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix() @ camera.rotation]
    ]

    def jerk(path: Sequence[Camera]) -> float:
        return float(np.linalg.norm(np.diff([camera.position for camera in path], 2, axis=0)))

    assert jerk(through(shaken, 40)) < 0.5 * jerk(shaken)


def test_through_cameras_that_stand_still() -> None:
    (one,) = dome([0.3], [0.2])
    turning = []
    for angle in (0.0, 0.0, 0.3, 0.3, 0.6):
        rotation = Rotation.from_rotvec([0, angle, 0]).as_matrix() @ one.rotation
        turning.append(Camera(64, 48, 60.0, 61.0, 31.0, 25.0, rotation, -rotation @ one.position))
    path = through(turning, 20)
    np.testing.assert_allclose([camera.position for camera in path], [one.position] * 20, atol=1e-9)
    turns = [Rotation.from_matrix(a.rotation @ b.rotation.T).magnitude() for a, b in pairwise(path)]
    assert min(turns) > 0.3 * max(turns)
    for camera in through([one, one, one], 4):
        np.testing.assert_allclose(camera.rotation, one.rotation, atol=1e-12)


@pytest.mark.parametrize("make", PATH_GENERATORS.values(), ids=PATH_GENERATORS)
def test_any_number_of_frames(make: Callable[[Sequence[Camera], int], list[Camera]]) -> None:
    cameras = dome([0.0, 0.5, 1.0], [0.1, 0.2, 0.1])
    for frames in (1, 2, 17):
        path = make(cameras, frames)
        assert len(path) == frames
        assert all(np.isfinite(camera.rotation).all() and np.isfinite(camera.translation).all() for camera in path)
    assert len(make(cameras[:1], 3)) == 3
    for wrong, frames in (([], 3), (cameras, 0)):
        refuses("expected at least one of each", make, wrong, frames, error=ValueError)

# SPDX-License-Identifier: Apache-2.0
"""The camera between key frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calls import refuses
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera
from clsplat.shots.keyframes import Key, interpolate, tangents
from clsplat.shots.shot import Shot, numbered

# Rotations and positions of a few units go through some ten products in float64.
EXACT = 1e-12


def camera(position, rotation=None, fx: float = 50.0, cx: float = 32.0) -> Camera:
    turned = (rotation or Rotation.identity()).inv().as_matrix()
    return Camera(64, 48, fx, 1.1 * fx, cx, 24.0, turned, -turned @ np.asarray(position, np.float64))


def random_keys(seed: int, count: int = 6) -> list[Key]:
    rng = np.random.default_rng(seed)
    frames = 1 + np.cumsum(rng.uniform(0.5, 9, count))
    keys, rotation = [], Rotation.identity()
    for frame in frames:
        rotation = rotation * Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3))
        keys.append(Key(frame, camera(rng.normal(size=3), rotation, rng.uniform(20, 90), rng.uniform(20, 40))))
    return keys


def assert_same(a: Camera, b: Camera, tolerance: float = EXACT) -> None:
    np.testing.assert_allclose(a.rotation, b.rotation, atol=tolerance)
    np.testing.assert_allclose(a.position, b.position, atol=tolerance)
    np.testing.assert_allclose([a.fx, a.fy, a.cx, a.cy], [b.fx, b.fy, b.cx, b.cy], rtol=tolerance)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("loop", [None, 60.0])
def test_passes_through_its_keys(seed: int, loop: float | None) -> None:
    keys = random_keys(seed)
    for key, there in zip(keys, interpolate(keys, [key.frame for key in keys], loop=loop), strict=True):
        assert_same(there, key.camera)
        assert (there.width, there.height, there.near) == (64, 48, 0.01)


def velocities(keys: list[Key], frame: float, side: int, loop: float | None = None) -> np.ndarray:
    """Numbers a frame, just after (side 1) or just before a frame."""
    step = 1e-6 * side
    here, there = interpolate(keys, [frame, frame + step], loop=loop)
    turn = Rotation.from_matrix(here.rotation @ there.rotation.T).as_rotvec()
    return np.concatenate([(there.position - here.position) / step, turn / step, [(there.fx - here.fx) / step]])


@pytest.mark.parametrize("seed", range(3))
def test_moves_and_turns_without_a_jerk(seed: int) -> None:
    keys = random_keys(seed)
    for key in keys[1:-1]:
        before, after = velocities(keys, key.frame, -1), velocities(keys, key.frame, 1)
        # differences over 1e-6 frames: accelerations of some 100 units (of focal lengths, here) give 1e-4
        np.testing.assert_allclose(before, after, atol=1e-3)
        assert np.linalg.norm(after[:3]) > 1e-2 or np.linalg.norm(after[3:6]) > 1e-3


def test_a_straight_path_is_even_and_two_keys_are_a_line() -> None:
    keys = [Key(float(f), camera([2.0 * f, -f, 0.5])) for f in (0, 1, 4, 5, 9)]
    path = interpolate(keys, np.linspace(0, 9, 37))
    np.testing.assert_allclose(
        [each.position for each in path], np.linspace([0, 0, 0.5], [18, -9, 0.5], 37), atol=1e-12
    )
    turn = Rotation.from_rotvec([0.0, 1.2, 0.0])
    pair = [Key(10.0, camera([0, 0, 0])), Key(20.0, camera([1, 2, 3], turn, 200.0))]
    middle, quarter = interpolate(pair, [15.0, 12.5])
    assert_same(
        replace(middle, fy=middle.fx),
        replace(camera([0.5, 1, 1.5], Rotation.from_rotvec([0, 0.6, 0]), 100.0), fy=100.0),
    )
    np.testing.assert_allclose(quarter.position, [0.25, 0.5, 0.75])
    np.testing.assert_allclose(quarter.fx, 50 * 4**0.25)  # evenly in the logarithm
    np.testing.assert_allclose(Rotation.from_matrix(quarter.rotation.T).as_rotvec(), [0, 0.3, 0], atol=1e-12)


@pytest.mark.parametrize("loop", [None, 50.0])
def test_a_hold_holds(loop: float | None) -> None:
    keys = random_keys(5)
    held = replace(keys[2], frame=keys[2].frame + 0.3)
    rest = [replace(key, frame=key.frame + 5) for key in keys[3:]]
    keys = [*keys[:3], held, *rest]
    for each in interpolate(keys, np.linspace(keys[2].frame, held.frame, 9), loop=loop):
        assert_same(each, held.camera)


@pytest.mark.parametrize("seed", range(4))
def test_stays_within_a_chord_of_its_keys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # distances and durations that differ a hundredfold, where Catmull-Rom splines make loops
    frames = np.cumsum(rng.choice([0.1, 1.0, 10.0], 9))
    points = np.cumsum(rng.normal(size=(9, 3)) * rng.choice([0.05, 1.0, 5.0], (9, 1)), axis=0)
    focal = rng.uniform(20, 90, 9)
    keys = [Key(f, camera(p, fx=x)) for f, p, x in zip(frames, points, focal, strict=True)]
    for index in range(8):
        chord = np.linalg.norm(points[index + 1] - points[index])
        for each in interpolate(keys, np.linspace(frames[index], frames[index + 1], 21)):
            assert np.linalg.norm(each.position - points[index]) <= 2 * chord + 1e-12
            away = min(np.linalg.norm(each.position - points[index]), np.linalg.norm(each.position - points[index + 1]))
            assert away <= chord + 1e-12
            low, high = sorted(focal[index : index + 2])
            assert low * (1 - 1e-12) <= each.fx <= high * (1 + 1e-12)


def test_a_key_moves_two_segments_on_each_side_at_most() -> None:
    keys = random_keys(7, 9)
    other = list(keys)
    other[4] = replace(keys[4], camera=camera([9.0, 9, 9], Rotation.from_rotvec([1.0, 0, 0])))
    far = [*np.linspace(keys[0].frame, keys[2].frame, 9), *np.linspace(keys[6].frame, keys[8].frame, 9)]
    for a, b in zip(interpolate(keys, far), interpolate(other, far), strict=True):
        assert_same(a, b)


def test_the_world_may_be_turned() -> None:
    keys = random_keys(8)
    world = Rotation.from_rotvec([0.4, -2.0, 1.0])
    turned = [
        Key(key.frame, camera(world.apply(key.camera.position), world * Rotation.from_matrix(key.camera.rotation.T)))
        for key in keys
    ]
    frames = np.linspace(keys[0].frame, keys[-1].frame, 30)
    for a, b in zip(interpolate(keys, frames), interpolate(turned, frames), strict=True):
        np.testing.assert_allclose(b.position, world.apply(a.position), atol=EXACT)
        np.testing.assert_allclose(b.rotation.T, world.as_matrix() @ a.rotation.T, atol=EXACT)


def test_closed_loops_close() -> None:
    keys = random_keys(9, 5)
    loop = keys[-1].frame - keys[0].frame + 4.0
    begin, end = interpolate(keys, [keys[0].frame, keys[0].frame + loop], loop=loop)
    assert_same(begin, end)
    first = keys[0].frame
    np.testing.assert_allclose(
        velocities(keys, first, 1, loop), velocities(keys, first + loop, -1, loop), atol=1e-3
    )  # as in test_moves_and_turns_without_a_jerk
    square = [Key(10.0 * i, camera(p)) for i, p in enumerate([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])]
    quarters = interpolate(square, [5.0, 15.0, 25.0, 35.0], loop=40.0)
    radii = [np.linalg.norm(each.position) for each in quarters]
    np.testing.assert_allclose(radii, radii[0])
    assert 1.1 < radii[0] < np.sqrt(2)  # rounder than the square's side at 1


def test_roll_goes_as_far_as_it_says() -> None:
    keys = [Key(0.0, camera([0, 0, 0])), Key(10.0, camera([0, 0, 0]), 4 * np.pi)]
    half, eighth = interpolate(keys, [5.0, 1.25])
    np.testing.assert_allclose(half.rotation, np.eye(3), atol=EXACT)
    # a quarter turn about the axis ahead: what was to the right is now at the top of the camera
    np.testing.assert_allclose(eighth.rotation @ [1, 0, 0], [0, -1, 0], atol=EXACT)
    thirds = [Key(10.0 * i, camera([0, 0, 0]), i * 2 * np.pi / 3) for i in range(3)]
    (between,) = interpolate(thirds, [25.0], loop=30.0)
    turned = Rotation.from_matrix(between.rotation.T).as_rotvec()
    np.testing.assert_allclose(turned, [0, 0, -np.pi / 3], atol=1e-9)  # on, not back


def test_one_key_and_beyond_the_ends() -> None:
    only = Key(4.0, camera([1, 2, 3], Rotation.from_rotvec([0.1, 0.2, 0.3])))
    for loop in (None, 10.0):
        for each in interpolate([only], [-5, 4, 4.5, 100], loop=loop):
            assert_same(each, only.camera)
    keys = random_keys(1)
    before, after = interpolate(keys, [keys[0].frame - 3, keys[-1].frame + 3])
    assert_same(before, keys[0].camera)
    assert_same(after, keys[-1].camera)


def test_keys_that_cannot_be() -> None:
    key = Key(1.0, camera([0, 0, 0]))
    for keys, loop in (([], None), ([key, key], None), ([key, replace(key, frame=5.0)], 4.0)):
        refuses("expected", interpolate, keys, [1.0], loop=loop, error=ValueError)


def test_tangents_are_those_of_a_parabola() -> None:
    times = np.array([0.0, 1.0, 3.0, 4.5])
    values = np.stack([times**2 + times, 5 - 0.5 * times], axis=1)
    slopes = np.diff(values, axis=0) / np.diff(times)[:, None]
    np.testing.assert_allclose(tangents(times, slopes), np.stack([2 * times + 1, -0.5 + 0 * times], axis=1))


def test_a_shot_between_its_frames() -> None:
    shot = Shot(numbered([camera([0.0, 0, 0]), camera([1.0, 0, 0]), camera([2.0, 0, 0])], first=10))
    np.testing.assert_allclose(shot.at(11.25).position, [1.25, 0, 0], atol=EXACT)

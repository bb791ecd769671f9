# SPDX-License-Identifier: Apache-2.0
"""Weights between photographs whose cameras are near each other."""

from __future__ import annotations

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.training.appearance.view_neighbours import MAX_MEAN_NEIGHBOURS, common, places


def ring(count: int, *, size: float = 3.0) -> list[Camera]:
    """Cameras on a circle that look at its middle, as of a turntable."""
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        rotation = np.array([[-np.sin(angle), np.cos(angle), 0], [0, 0, -1], [-np.cos(angle), -np.sin(angle), 0]])
        cameras.append(Camera(8, 8, 8.0, 8.0, 4.0, 4.0, rotation, np.array([0.0, 0.0, size])))
    return cameras


def kept(count: int, waves: int) -> float:
    """The part of a wave around a ring that neighbours have in common."""
    wave = np.cos(waves * 2 * np.pi * np.arange(count) / count)
    matrix = common(ring(count), np.ones(count, bool))
    return float(wave @ (matrix @ wave) / (wave @ wave))


def test_what_neighbours_have_in_common_is_kept_and_what_each_has_alone_is_not() -> None:
    assert kept(60, 1) > 0.8
    assert kept(60, 2) > 0.6
    assert kept(60, 10) < 0.02
    assert kept(4, 2) == pytest.approx(0.5, abs=1e-3), "no neighbours"


@pytest.mark.parametrize("count", [1, 2, 7, 60])
def test_the_matrix_is_symmetric_and_never_negative(count: int) -> None:
    """A negative eigenvalue would push gains away from where they began, ever faster."""
    cameras = ring(count)
    rng = np.random.default_rng(count)
    for place in range(0, count, 3):
        cameras[place] = cameras[place].posed(cameras[place].rotation, rng.normal(0, 2, 3))
    matrix = common(cameras, np.ones(count, bool)).toarray()
    np.testing.assert_array_equal(matrix, matrix.T)
    values = np.linalg.eigvalsh(matrix)
    assert values.min() > -1e-5, "weights are rounded to 2^-20"
    assert values.max() < 1
    assert len(np.unique(np.round(matrix * 2**20))) == len(np.unique(matrix * 2**20))


def test_photographs_that_points_do_not_tell_have_no_weight() -> None:
    told = np.arange(60) % 3 > 0
    matrix = common(ring(60), told).toarray()
    assert not matrix[~told].any()
    assert not matrix[:, ~told].any()
    assert matrix[told].any(axis=1).all()
    assert not common(ring(60), np.zeros(60, bool)).nnz


def test_the_scale_of_the_world_and_one_camera_far_away_do_not_count() -> None:
    np.testing.assert_allclose(places(ring(9, size=3.0)), places(ring(9, size=3e4)), atol=1e-12)
    np.testing.assert_array_equal(places(ring(1))[:, :3], np.zeros((1, 3)))
    lost = [*ring(60), Camera(8, 8, 8.0, 8.0, 4.0, 4.0, np.eye(3), np.array([0.0, 0.0, 3e3]))]
    one, two = common(ring(60), np.ones(60, bool)), common(lost, np.ones(61, bool))
    # the middle is another camera's place by now
    np.testing.assert_allclose(one.toarray(), two.toarray()[:60, :60], atol=0.02)


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (1.0, 2.0, 3.0), (100.0, 200.0, 30.0)])
def test_a_tripod_is_one_place(centre: tuple[float, float, float]) -> None:
    """Wherever it stands: what rounding makes of its centre is no distance."""
    told = np.ones(90, bool)
    wanted = common([camera.posed(camera.rotation, np.zeros(3)) for camera in ring(90)], told)
    cameras = [camera.posed(camera.rotation, -camera.rotation @ centre) for camera in ring(90)]
    np.testing.assert_allclose(common(cameras, told).toarray(), wanted.toarray(), atol=2.0**-19)


def test_many_photographs_have_no_more_neighbours() -> None:
    steps = np.arange(60) / 60
    cameras = [
        Camera(8, 8, 8.0, 8.0, 4.0, 4.0, np.eye(3), np.array([x, y, 0.0])) for x in steps for y in steps
    ]  # from a drone
    assert common(cameras, np.ones(len(cameras), bool)).nnz <= MAX_MEAN_NEIGHBOURS * len(cameras)

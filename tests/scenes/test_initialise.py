# SPDX-License-Identifier: Apache-2.0
"""Initial Gaussians against the definition, written out as loops."""

import numpy as np
import pytest
from calls import refuses

from clsplat.scenes.start.initialise import MIN_SQUARED_DISTANCE, from_points, mean_squared_distance, random_points
from clsplat.spherical_harmonics import SH_C0


def brute_force(points: np.ndarray) -> np.ndarray:
    """Mean squared distance to the three nearest others, (N,)."""
    squared = np.square(points[:, None] - points[None]).sum(axis=2)
    np.fill_diagonal(squared, np.inf)
    return np.sort(squared, axis=1)[:, : min(3, len(points) - 1)].mean(axis=1)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 200])
def test_neighbours(count: int) -> None:
    points = np.random.default_rng(0).standard_normal((count, 3))
    np.testing.assert_allclose(mean_squared_distance(points), brute_force(points), rtol=1e-12)


def test_points_that_coincide() -> None:
    points = np.repeat(np.random.default_rng(0).standard_normal((10, 3)), [1, 2, 3, 4, 5, 6, 1, 1, 1, 1], axis=0)
    np.testing.assert_allclose(mean_squared_distance(points), brute_force(points), rtol=1e-12, atol=1e-15)
    scales = np.exp(from_points(points, np.zeros_like(points)).log_scales)
    assert np.isfinite(scales).all()
    np.testing.assert_allclose(scales.min(), np.sqrt(MIN_SQUARED_DISTANCE), rtol=1e-5)


def test_a_lone_point() -> None:
    gaussians = from_points([[1, 2, 3]], [[0.5, 0.5, 0.5]])
    np.testing.assert_allclose(np.exp(gaussians.log_scales), np.sqrt(MIN_SQUARED_DISTANCE), rtol=1e-5)


def test_what_a_gaussian_starts_as() -> None:
    rng = np.random.default_rng(0)
    points, colors = rng.standard_normal((30, 3)), rng.random((30, 3))
    gaussians = from_points(points, colors)
    gaussians.check()
    assert gaussians.sh_degree == 0
    np.testing.assert_array_equal(gaussians.means, points.astype(np.float32))
    np.testing.assert_array_equal(gaussians.quaternions, np.tile(np.float32([1, 0, 0, 0]), (30, 1)))
    np.testing.assert_allclose(1 / (1 + np.exp(-gaussians.opacity_logits)), 0.1, rtol=1e-6)
    np.testing.assert_allclose(0.5 + SH_C0 * gaussians.sh[:, 0], colors, atol=1e-6)
    np.testing.assert_allclose(np.exp(2 * gaussians.log_scales), np.tile(brute_force(points)[:, None], 3), rtol=1e-5)


def test_bad_points() -> None:
    refuses("no points", from_points, np.zeros((0, 3)), np.zeros((0, 3)))
    refuses("point 1 has the position", from_points, [[0, 0, 0], [0, np.nan, 0]], np.zeros((2, 3)))
    refuses("expected", from_points, np.zeros((4, 3)), np.zeros((3, 3)), error=ValueError)


def test_random_points_fill_the_box_and_repeat() -> None:
    low, high = np.array([-1, 0, 2.0]), np.array([1, 5, 2.5])
    points, colors = random_points(2000, low, high, np.random.default_rng(7))
    assert points.shape == colors.shape == (2000, 3)
    assert (points >= low).all()
    assert (points <= high).all()
    np.testing.assert_allclose(points.mean(axis=0), (low + high) / 2, atol=0.1)
    assert (np.abs(colors - 0.5) < 0.01).all()
    np.testing.assert_array_equal(points, random_points(2000, low, high, np.random.default_rng(7))[0])

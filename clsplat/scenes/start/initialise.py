# SPDX-License-Identifier: Apache-2.0
"""Initial Gaussians of a training: one per point, isotropic, as large as the distance to neighbouring points."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float64
from clsplat.camera import DEFAULT_NEAR_PLANE
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.spherical_harmonics import SH_C0

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene

INITIAL_OPACITY = 0.1
"""Opacity of every initial Gaussian."""
MIN_SQUARED_DISTANCE = 1e-7
"""Lower bound of a point's mean squared distance to its neighbours, in world units squared. It gives coincident points
a size.

This is the 3DGS authors' bound, for scenes whose length unit is within ORDINARY_UNITS. In other scenes it is scaled by
the squared ratio of the length unit to the nearer end of that range.
"""
ORDINARY_UNITS = (1.0, 100.0)
"""Least and largest length unit, in world units, for which MIN_SQUARED_DISTANCE is not scaled."""
MIN_START_COLOUR = 1 / 512
"""Smallest initial value of a colour channel: half a step of an 8-bit image.

A channel that starts at 0 is at the colour clamp, where it has no gradient. Rounding may then keep it at 0.
"""
SCALE_NEIGHBOURS = 3
"""Number of nearest points whose distances give a Gaussian its size."""


def from_scene(scene: Scene, random_count: int, rng: np.random.Generator) -> Gaussians:
    """Create Gaussians of SH degree 0 at the scene's points, or at `random_count` random points if it has no points."""
    points: NDArray[Any] = scene.points
    colors: NDArray[Any] = scene.point_colors
    if len(points) == 0:
        points, colors = random_points(random_count, *scene.bounds, rng)
    return from_points(points, colors, origin=scene.origin, length_unit=scene.length_unit, near=scene.near)


def from_points(
    points: ArrayLike,
    colors: ArrayLike,
    *,
    origin: Float64 | None = None,
    length_unit: float = 1.0,
    near: float = DEFAULT_NEAR_PLANE,
) -> Gaussians:
    """Create one Gaussian per point.

    points: (N, 3), in world units.
    colors: (N, 3) in [0, 1].
    origin: (3,), point of the world that the Gaussians' means are relative to, by default the world's origin.
    length_unit: the scene's length unit in world units.
    near: the model's near plane in world units.

    The standard deviation is the root of the mean squared distance to the three nearest other points, or to all if
    there are fewer. It has a lower bound (`squared_floor`). The opacity is 0.1, the quaternion 1 0 0 0.
    Raises InputError for no points or points that are not finite, ValueError for wrong shapes.
    """
    xyz = np.asarray(points, np.float64)
    rgb: NDArray[Any] = np.asarray(colors)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or rgb.shape != xyz.shape:
        raise ValueError(f"points have the shape {xyz.shape} and colors {rgb.shape}: expected (N, 3) for both")
    count = len(xyz)
    if count == 0:
        raise InputError("no points to start from, expected at least one")
    if not np.isfinite(xyz).all():
        row = int(np.argmin(np.isfinite(xyz).all(axis=1)))
        raise InputError(f"point {row} has the position {xyz[row].tolist()}, expected finite coordinates")

    origin = np.zeros(3) if origin is None else origin
    log_scales = 0.5 * np.log(np.maximum(mean_squared_distance(xyz), squared_floor(length_unit)))
    quaternions = np.zeros((count, 4), np.float32)
    quaternions[:, 0] = 1
    sh = ((np.maximum(rgb, MIN_START_COLOUR) - 0.5) / SH_C0).astype(np.float32)[:, None]
    return Gaussians(
        means=np.ascontiguousarray(xyz - origin, np.float32),
        quaternions=quaternions,
        log_scales=np.repeat(log_scales.astype(np.float32)[:, None], 3, axis=1),
        opacity_logits=np.full(count, np.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY)), np.float32),
        sh=sh,
        origin=origin,
        near=near,
    )


def squared_floor(length_unit: float) -> float:
    """Return the lower bound of points' mean squared distances, in world units squared (MIN_SQUARED_DISTANCE)."""
    low, high = ORDINARY_UNITS
    return MIN_SQUARED_DISTANCE * (length_unit / min(max(length_unit, low), high)) ** 2


def mean_squared_distance(points: Float64) -> Float64:
    """Return the mean squared distance (N,) of points (N, 3) to their three nearest neighbours; 0 for a single point.

    Coincident points are neighbours at distance 0, as in the authors' code.
    """
    from scipy.spatial import cKDTree

    neighbours = min(SCALE_NEIGHBOURS, len(points) - 1)
    if neighbours == 0:
        return np.zeros(len(points))
    distances, _ = cKDTree(points).query(points, k=neighbours + 1)
    # Distances are sorted, so the first is 0, the distance of the point to itself or to a coincident point.
    return np.asarray(np.mean(np.square(distances[:, 1:]), axis=1))


def random_points(count: int, low: ArrayLike, high: ArrayLike, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Return uniformly random points (count, 3) in a box, and their colours (count, 3), for a scene without points.

    The colours are grey with a little noise, as in the 3DGS authors' code.

    low, high: (3,), corners of the box in world units.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    points = low + rng.random((count, 3)) * (high - low)
    colors = 0.5 + SH_C0 * rng.random((count, 3)) / 255
    return points, colors

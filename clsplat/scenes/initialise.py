# SPDX-License-Identifier: Apache-2.0
"""The Gaussians that training starts from: one a point, isotropic, as wide as the way to its neighbours. Of a
cloud without colours each has the mean of what the training photographs have where it is seen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import NEAR
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.images.alpha import composite
from clsplat.scenes.data_set import pixels_of
from clsplat.scenes.point_files import UNCOLOURED, of_one_colour
from clsplat.spherical_harmonics import C0

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene

INITIAL_OPACITY = 0.1
MIN_SQUARED_DISTANCE = 1e-7
"""The authors' floor under the mean squared distance, which keeps points that coincide alive: world units squared in
scenes whose extent is one of ORDINARY_EXTENTS, and in others as much of the extent as at the nearer end."""
ORDINARY_EXTENTS = (1.0, 100.0)
LEAST_COLOUR = 1 / 512
"""Half a step of an 8 bit image. A channel that starts at 0 is at the clamp of colours, where it has no gradient, and
rounding may keep it there for good."""
NEIGHBOURS = 3
LONGEST = 400
"""Pixels of the photographs' longer side here: a point stands for a few of the full size."""
UNSEEN = UNCOLOURED
"""Grey, for points that no photograph shows."""


def from_scene(scene: Scene, random_count: int, rng: np.random.Generator) -> Gaussians:
    """Gaussians of degree 0 at the scene's points, or at `random_count` random ones where it has none."""
    points: NDArray[Any] = scene.points
    colors: NDArray[Any] = scene.point_colors
    if len(points) == 0:
        points, colors = random_points(random_count, *scene.bounds, rng)
    return from_points(points, colors, origin=scene.origin, extent=scene.extent, near=scene.near)


def from_points(
    points: ArrayLike,
    colors: ArrayLike,
    *,
    origin: Float64 | None = None,
    extent: float = 1.0,
    near: float = NEAR,
) -> Gaussians:
    """One Gaussian a point.

    points (N, 3), world units; colors (N, 3) in [0, 1]; origin (3,): where the means count from, the world's own if not
    given; extent: the scene's, world units; near: the model's near plane. The standard deviation is the root of the
    mean squared distance to the three nearest other points (fewer where there are fewer; a lone point gets the floor).
    Opacity 0.1, quaternions 1 0 0 0.
    Raises InputError for no points or points that are not finite, ValueError for wrong shapes.
    """
    xyz = np.asarray(points, np.float64)
    rgb: NDArray[Any] = np.asarray(colors)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or rgb.shape != xyz.shape:
        raise ValueError(f"points {xyz.shape} and colors {rgb.shape}: expected (N, 3) both")
    count = len(xyz)
    if count == 0:
        raise InputError("no points to start from, expected at least one")
    if not np.isfinite(xyz).all():
        raise InputError(f"point {int(np.argmin(np.isfinite(xyz).all(axis=1)))} is not finite")

    origin = np.zeros(3) if origin is None else origin
    log_scales = 0.5 * np.log(np.maximum(mean_squared_distance(xyz), squared_floor(extent)))
    quaternions = np.zeros((count, 4), np.float32)
    quaternions[:, 0] = 1
    sh = ((np.maximum(rgb, LEAST_COLOUR) - 0.5) / C0).astype(np.float32)[:, None]
    return Gaussians(
        means=np.ascontiguousarray(xyz - origin, np.float32),
        quaternions=quaternions,
        log_scales=np.repeat(log_scales.astype(np.float32)[:, None], 3, axis=1),
        opacity_logits=np.full(count, np.log(INITIAL_OPACITY / (1 - INITIAL_OPACITY)), np.float32),
        sh=sh,
        origin=origin,
        near=near,
    )


def squared_floor(extent: float) -> float:
    """Floor under the mean squared distance of a scene's points, world units squared."""
    low, high = ORDINARY_EXTENTS
    return MIN_SQUARED_DISTANCE * (extent / min(max(extent, low), high)) ** 2


def mean_squared_distance(points: Float64) -> Float64:
    """Mean squared distance to the three nearest other points, (N,); points (N, 3). 0 for a lone point.

    A point that coincides with others counts them as neighbours at distance 0, as the authors' code does.
    """
    from scipy.spatial import cKDTree

    neighbours = min(NEIGHBOURS, len(points) - 1)
    if neighbours == 0:
        return np.zeros(len(points))
    distances, _ = cKDTree(points).query(points, k=neighbours + 1)
    # Sorted, so the first is 0: the point itself or one at the same place, which is the same distance.
    return np.asarray(np.mean(np.square(distances[:, 1:]), axis=1))


def random_points(count: int, low: ArrayLike, high: ArrayLike, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Points uniform in a box and their colours, for a scene without points.

    low, high (3,): the box's corners, world units. Returns points (count, 3) and colors (count, 3): grey with the
    authors' trace of noise.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    points = low + rng.random((count, 3)) * (high - low)
    colors = 0.5 + C0 * rng.random((count, 3)) / 255
    return points, colors


def is_colourless(scene: Scene) -> bool:
    """True if points have no colours, as a cloud of --points, or all the same, as clouds without colours are read."""
    return scene.colourless is not None or of_one_colour(scene.point_colors)


def photographed(scene: Scene, background: ArrayLike) -> Float32:
    """(N, 3) float32 in [0, 1] for the scene's points, but for those that have their own. What lies before a point is
    not known, and counts too."""
    sums, seen = np.zeros((len(scene.points), 3)), np.zeros(len(scene.points))
    for view in scene.train_views:
        factor = min(LONGEST / max(view.camera.width, view.camera.height), 1.0)
        camera = view.camera.resized(
            max(round(factor * view.camera.width), 1), max(round(factor * view.camera.height), 1)
        ).before(scene.near)
        picture = composite(view.load(camera.width, camera.height), background)
        rows, columns, inside = pixels_of(scene.points, camera, view.lens)
        sums[inside] += picture[rows, columns]
        seen[inside] += 1
    means = np.where(seen[:, None] > 0, sums / np.maximum(seen, 1)[:, None], UNSEEN)
    if scene.colourless is not None:
        means = np.where(scene.colourless[:, None], means, scene.point_colors)
    return np.clip(means, 0, 1).astype(np.float32)

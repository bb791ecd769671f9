# SPDX-License-Identifier: Apache-2.0
"""The Gaussians that training starts from: one a point, isotropic, as wide as the way to its neighbours. Of a
cloud without colours each has the median of what the training photographs have where they show it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import NEAR
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.images.alpha import composite
from clsplat.scenes.data_set import depths_of, nearest_around, pixels_of
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
NEAREST = 15
"""Photographs that a point without a colour takes it from. Those from afar show it with what is around; of a few, one
that shows something else counts for much."""
IN_A_CELL = 16
"""Points on average in the cells in which the nearest hides others: of fewer some let what is behind through, and more
are so wide that they hold things side by side."""
WIDEST = 1 / 25
"""Side of these cells at most, in the longer of the picture: with few points hardly any hides another."""
BEHIND = 1.05
"""Depth, in that of the nearest point of the cell, from which on a point is taken to be hidden."""
HIDDEN = 1e30
"""Rank of a hidden point, times how deep it is behind the nearest: above that of any which is shown."""
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
    """(N, 3) float32 in [0, 1] for the scene's points, but for those that have their own: by channel the median of what
    the NEAREST training photographs that show a point have there, at the size that is trained on.

    A photograph does not show what its mask leaves out, nor what lies behind others. A point that lies so in all of
    them takes those where it does least.
    """
    count = len(scene.points)
    ranks, colors = np.full((count, NEAREST), np.inf), np.full((count, NEAREST, 3), np.inf, np.float32)
    for view in scene.train_views:
        camera, picture = view.camera.before(scene.near), view.load_masked()
        rows, columns, inside = pixels_of(scene.points, camera, view.lens)
        which, depths = np.flatnonzero(inside), depths_of(scene.points[inside], camera)
        cell = np.sqrt(IN_A_CELL * camera.width * camera.height / max(len(which), 1))
        cell = max(min(cell, WIDEST * max(camera.width, camera.height)), 1.0)
        behind = depths / nearest_around(rows, columns, depths, cell)
        rank = np.where(behind <= BEHIND, depths / camera.fx, HIDDEN * behind)
        pixels = picture[rows, columns]
        counts = pixels[:, 4] > 0 if pixels.shape[1] == 5 else np.ones(len(which), np.bool_)
        last = ranks[which].argmax(axis=1)
        kept = counts & (rank < ranks[which, last])
        which, last = which[kept], last[kept]
        ranks[which, last] = rank[kept]
        colors[which, last] = composite(pixels[None, kept, :4], background)[0]
    shown = ranks < HIDDEN
    colors[~shown & shown.any(axis=1, keepdims=True)] = np.inf
    medians = np.clip(_medians(colors), 0, 1)
    return medians if scene.colourless is None else np.where(scene.colourless[:, None], medians, scene.point_colors)


def _medians(colors: Float32) -> Float32:
    """(N, 3) medians by channel of the finite ones of colours (N, K, 3), which are sorted in place; UNSEEN for none."""
    counts = np.isfinite(colors).all(axis=2).sum(axis=1)[:, None, None]
    colors.sort(axis=1)
    middles = np.concatenate([np.maximum(counts - 1, 0) // 2, counts // 2], axis=1)
    medians = np.take_along_axis(colors, middles, axis=1).mean(axis=1)
    return np.asarray(np.where(counts[:, 0] > 0, medians, np.float32(UNSEEN)))

# SPDX-License-Identifier: Apache-2.0
"""Initial Gaussians: one per point, isotropic, with a size according to the distance to the point's neighbours.

Points without colours take the median colour of the training photographs that show them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import DEFAULT_NEAR_PLANE
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.images.alpha import composite
from clsplat.scenes.dataset import nearest_around, occlusion_cell, pixels_of
from clsplat.scenes.point_files import UNCOLOURED_GREY, of_one_colour
from clsplat.spherical_harmonics import SH_C0

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene

INITIAL_OPACITY = 0.1
MIN_SQUARED_DISTANCE = 1e-7
"""Lower bound of the mean squared distance, in world units squared. It gives coincident points a size.

This is the 3DGS authors' bound, for scenes whose length unit is within ORDINARY_UNITS. In other scenes it is scaled by
the squared ratio of the unit to the nearer end of that range.
"""
ORDINARY_UNITS = (1.0, 100.0)
MIN_START_COLOUR = 1 / 512
"""Smallest initial value of a colour channel: half a step of an 8-bit image.

A channel that starts at 0 is at the colour clamp, where it has no gradient. Rounding may then keep it at 0.
"""
SCALE_NEIGHBOURS = 3
COLOUR_VIEWS_PER_POINT = 15
"""Number of nearest photographs that give a point its colour.

In distant photographs the colour of a point is mixed with its surroundings. With fewer photographs than this number, a
photograph with something else in front of the point would have too much weight.
"""
OCCLUSION_DEPTH_RATIO = 1.05
"""Ratio of a point's depth to that of the nearest point in its cell, above which the point counts as occluded."""
HIDDEN_POINT_RANK = 1e30
"""An occluded point's rank is this times its relative depth. It thus exceeds the rank of any visible point."""
UNSEEN_GREY = UNCOLOURED_GREY
"""Grey value of points that no photograph shows."""


def from_scene(scene: Scene, random_count: int, rng: np.random.Generator) -> Gaussians:
    """Gaussians of SH degree 0 at the scene's points, or at `random_count` random points if the scene has no points."""
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
    """One Gaussian per point.

    points: (N, 3), in world units.
    colors: (N, 3) in [0, 1].
    origin: (3,), origin of the means in the world, by default the world's origin.
    length_unit: the scene's length unit in world units.
    near: the model's near plane.

    The standard deviation is the root of the mean squared distance to the three nearest other points, or to all if
    there are fewer. A lone point gets the lower bound. The opacity is 0.1, the quaternion 1 0 0 0.
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
        raise InputError(f"point {int(np.argmin(np.isfinite(xyz).all(axis=1)))} is not finite")

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
    """Lower bound, in world units squared, of the mean squared distance of a scene's points."""
    low, high = ORDINARY_UNITS
    return MIN_SQUARED_DISTANCE * (length_unit / min(max(length_unit, low), high)) ** 2


def mean_squared_distance(points: Float64) -> Float64:
    """Mean squared distance (N,) of points (N, 3) to their three nearest neighbours; 0 for a lone point.

    Coincident points are neighbours at distance 0, as in the authors' code.
    """
    from scipy.spatial import cKDTree

    neighbours = min(SCALE_NEIGHBOURS, len(points) - 1)
    if neighbours == 0:
        return np.zeros(len(points))
    distances, _ = cKDTree(points).query(points, k=neighbours + 1)
    # Distances are sorted, so the first one is 0: that of the point itself or of a coincident point.
    return np.asarray(np.mean(np.square(distances[:, 1:]), axis=1))


def random_points(count: int, low: ArrayLike, high: ArrayLike, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Uniformly random points in a box, and their colours, for a scene without points.

    low, high: (3,), corners of the box in world units.
    Returns points (count, 3) and colours (count, 3). As in the authors' code, these are grey with a little noise.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    points = low + rng.random((count, 3)) * (high - low)
    colors = 0.5 + SH_C0 * rng.random((count, 3)) / 255
    return points, colors


def is_colourless(scene: Scene) -> bool:
    """True if points lack colours: some are marked as colourless (from --points), or all have the same colour, as from
    another cloud without colours."""
    return scene.colourless is not None or of_one_colour(scene.point_colors)


def photographed(scene: Scene, background: ArrayLike) -> Float32:
    """Colours (N, 3) float32 in [0, 1] of the scene's points. Points with colours of their own keep them.

    A colour is the median per channel over the nearest COLOUR_VIEWS_PER_POINT training photographs that show the point,
    at the training size. Masked and occluded points do not count as shown. A point that is occluded in all photographs
    uses the photographs in which it is least occluded.
    """
    count = len(scene.points)
    ranks, colors = (
        np.full((count, COLOUR_VIEWS_PER_POINT), np.inf),
        np.full((count, COLOUR_VIEWS_PER_POINT, 3), np.inf, np.float32),
    )
    for view in scene.train_views:
        camera, picture = view.camera.before(scene.near), view.load_masked()
        rows, columns, inside = pixels_of(scene.points, camera, view.lens)
        which, depths = np.flatnonzero(inside), camera.depths_of(scene.points[inside])
        behind = depths / nearest_around(rows, columns, depths, occlusion_cell(camera, len(which)))
        rank = np.where(behind <= OCCLUSION_DEPTH_RATIO, depths / camera.fx, HIDDEN_POINT_RANK * behind)
        pixels = picture[rows, columns]
        counts = pixels[:, 4] > 0 if pixels.shape[1] == 5 else np.ones(len(which), np.bool_)
        last = ranks[which].argmax(axis=1)
        kept = counts & (rank < ranks[which, last])
        which, last = which[kept], last[kept]
        ranks[which, last] = rank[kept]
        colors[which, last] = composite(pixels[None, kept, :4], background)[0]
    shown = ranks < HIDDEN_POINT_RANK
    colors[~shown & shown.any(axis=1, keepdims=True)] = np.inf
    medians = np.clip(_medians(colors), 0, 1)
    return medians if scene.colourless is None else np.where(scene.colourless[:, None], medians, scene.point_colors)


def _medians(colors: Float32) -> Float32:
    """Medians per channel, (N, 3), of the finite colours in (N, K, 3); UNSEEN_GREY if there are none. Sorts `colors` in
    place."""
    counts = np.isfinite(colors).all(axis=2).sum(axis=1)[:, None, None]
    colors.sort(axis=1)
    middles = np.concatenate([np.maximum(counts - 1, 0) // 2, counts // 2], axis=1)
    medians = np.take_along_axis(colors, middles, axis=1).mean(axis=1)
    return np.asarray(np.where(counts[:, 0] > 0, medians, np.float32(UNSEEN_GREY)))

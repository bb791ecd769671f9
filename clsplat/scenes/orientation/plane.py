# SPDX-License-Identifier: Apache-2.0
"""Level plane of a scene, such as a floor, a table top or the ground of a survey, among the scene's points.

The plane with the most points near it is found by RANSAC (Fischler and Bolles 1981) among planes that are nearly level.
Iteratively reweighted least squares then fit it to its points (Tukey's biweight).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64

MAX_PLANE_POINTS = 20_000
"""Maximum number of points that the search for a plane uses, evenly spaced in the scene's order."""
MIN_PLANE_POINTS = 30
"""Minimum number of points on a plane."""
PLANE_TRIALS = 3000
"""Number of random triples of points that RANSAC tries. If a tenth of the points are on a plane, one
trial in a thousand has all three points on it."""
PLANE_HALF_THICKNESS = 0.01
"""Largest distance of a plane's points from it, relative to the scene's radius."""
MIN_PLANE_SHARE = 0.1
"""Minimum fraction of the points on the plane. A level slice of a wall has 3 % if the wall is
30 times as high as the plane is thick."""
MIN_PLANE_BREADTH = 0.15
"""Minimum ratio of a plane's two widths (standard deviations of its points). A level slice of a wall is a line."""
PLANE_FIT_WIDTHS = (3.0,) * 10 + (1.0,) * 10
"""Half thickness of the plane in each reweighted fit, as a multiple of PLANE_HALF_THICKNESS. RANSAC uses the first one,
because thin planes through points of an uneven surface, such as a blanket, differ by up to 4 degrees."""


@dataclass(frozen=True, eq=False)
class LevelPlane:
    """A plane of points.

    normal: (3,), unit vector on the upper side.
    height: position along the normal: points p of the plane have normal @ p = height.
    share: fraction of the scene's points that are on the plane.
    """

    normal: Float64
    height: float
    share: float


def level_plane(points: Float64, up: Float64, max_tilt: float, radius: float) -> LevelPlane | None:
    """Find the plane with the most points among planes whose normal is at most `max_tilt` radians from `up` (3,).

    points: (N, 3), in the region of interest.
    radius: the scene's radius in world units, to which the plane's thickness is relative.
    Returns None if no such plane has enough points, or if the points on it are nearly in a line.
    """
    if len(points) < MIN_PLANE_POINTS:
        return None
    points = points[:: max(1, -(-len(points) // MAX_PLANE_POINTS))]
    half = PLANE_HALF_THICKNESS * radius
    normal, height = _searched(points, up, max_tilt, PLANE_FIT_WIDTHS[0] * half)
    if normal is None:
        return None
    normal, height = _fitted(points, normal, height, half)
    on = np.abs(points @ normal - height) < half
    share = float(on.mean())
    tilt = float(np.arccos(np.clip(normal @ up, -1, 1)))
    if on.sum() < MIN_PLANE_POINTS or share < MIN_PLANE_SHARE or tilt > max_tilt or not _is_broad(points[on]):
        return None
    return LevelPlane(normal, height, share)


def _searched(points: Float64, up: Float64, max_tilt: float, half: float) -> tuple[Float64 | None, float]:
    """Return the normal and height of the nearly level plane through three points that has the most points near it.

    half: largest distance of the points that count as near. The normal is None if no trial gave a nearly level plane.
    """
    rng = np.random.default_rng(0)
    triples = points[rng.integers(len(points), size=(PLANE_TRIALS, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0] / lengths[lengths > 0, None]
    normals *= np.where(normals @ up < 0, -1.0, 1.0)[:, None]
    heights = np.einsum("nk,nk->n", normals, triples[lengths > 0, 0])
    level = normals @ up > np.cos(max_tilt)
    best: tuple[int, Float64 | None, float] = (0, None, 0.0)
    for normal, height in zip(normals[level], heights[level], strict=True):
        count = int((np.abs(points @ normal - height) < half).sum())
        if count > best[0]:
            best = (count, normal, float(height))
    return best[1], best[2]


def _fitted(points: Float64, normal: Float64, height: float, half: float) -> tuple[Float64, float]:
    """Fit a plane to the points near it by iteratively reweighted least squares. Returns its normal and height.

    normal, height: of the plane to start from.
    half: half thickness of the plane in the last fit, in world units.
    """
    for width in PLANE_FIT_WIDTHS:
        off = (points @ normal - height) / (width * half)
        weights = np.square(np.clip(1 - off * off, 0, None))  # Tukey's biweight
        if (weights > 0).sum() < 3:
            break
        middle = np.average(points, axis=0, weights=weights)
        offsets = points - middle
        _, axes = np.linalg.eigh((weights[:, None] * offsets).T @ offsets)
        fitted: Float64 = axes[:, 0]
        normal = fitted if fitted @ normal >= 0 else -fitted
        height = float(middle @ normal)
    return normal, height


def _is_broad(points: Float64) -> bool:
    """Return True if the points (n, 3) of a plane spread in two directions."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] >= MIN_PLANE_BREADTH * spread[0])


def ground_height(heights: Float64, ceiling: float, radius: float) -> float:
    """Return the height of the ground among the heights (N,) of a scene's points.

    It is the lowest layer, as thick as a plane, that has at least a third as many points as the fullest layer.

    ceiling: height of the cameras, below which the ground is searched.
    radius: the scene's radius, to which a plane's thickness is relative.
    """
    low = heights[heights < ceiling]
    if len(low) < MIN_PLANE_POINTS:
        low = heights
    step = 2 * PLANE_HALF_THICKNESS * radius
    floor = float(np.quantile(low, 0.005))
    bins = np.floor((low[low >= floor] - floor) / step).astype(int)
    counts = np.bincount(bins)
    lowest = int(np.flatnonzero(3 * counts >= counts.max())[0])
    level = low[(low >= floor + (lowest - 0.5) * step) & (low <= floor + (lowest + 1.5) * step)]
    return float(np.median(level))


def in_reach(points: Float64, middle: Float64, radius: float) -> NDArray[np.bool_]:
    """Return a mask (N,) of the points within `radius` of `middle` (3,)."""
    return np.asarray(np.linalg.norm(points - middle, axis=1) <= radius)

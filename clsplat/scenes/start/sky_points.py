# SPDX-License-Identifier: Apache-2.0
"""Initial points of the sky, on a sphere around the scene, where photographs show the sky."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.config.points import SKY_RADIUS_RATIO
from clsplat.errors import InputError
from clsplat.images.alpha import composite
from clsplat.scenes.dataset import pixels_of

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene, View

SKY_IMAGE_SIDE_PX = 400
"""Longer side in pixels to which larger photographs are reduced. A sky point covers several pixels of the full size."""
SKY_RADIUS_QUANTILE = 0.95
"""Quantile of the distances of the scene's points that counts as the farthest distance."""
SKY_OVERSAMPLING = 4
"""Number of candidate directions on the half sphere, per requested point."""
SKYLINE_COLUMNS = 24
"""Number of column strips of a photograph. In each, the sky is above all points."""
MIN_SKY_VOTE_FRACTION = 0.5
"""A direction is sky if at least this fraction of the photographs that show it have sky there."""
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5.0))


def sky_points(scene: Scene, count: int) -> tuple[Float64, Float32]:
    """At most `count` points (N, 3) on the sky sphere in the world, and their mean colours (N, 3) in the photographs.

    A direction above the horizon is sky if, in most photographs that show it, no scene point lies above it in its
    column strip.
    Raises InputError if there is no such direction, no common up direction, or no points in the scene.
    """
    if len(scene.points) == 0:
        raise InputError(
            f"{scene.name}: --sky needs points to find the sky above them, and the scene has none; leave out --sky"
        )
    cameras = [view.camera for view in scene.train_views]
    middle, *_ = scene.spread
    up = -np.stack([camera.rotation[1] for camera in cameras]).mean(axis=0)
    if (length := float(np.linalg.norm(up))) < 0.1:
        raise InputError(f"{scene.name}: --sky needs cameras with a common up direction; leave out --sky")
    radius = SKY_RADIUS_RATIO * max(
        float(np.quantile(np.linalg.norm(scene.points - middle, axis=1), SKY_RADIUS_QUANTILE)), scene.extent
    )
    directions = half_sphere(SKY_OVERSAMPLING * count, up / length)
    places = middle + radius * directions
    sums, votes, shown = np.zeros((len(places), 3)), np.zeros(len(places)), np.zeros(len(places))
    for view in scene.train_views:
        factor = min(SKY_IMAGE_SIDE_PX / max(view.camera.width, view.camera.height), 1.0)
        width, height = (max(round(factor * side), 1) for side in (view.camera.width, view.camera.height))
        camera = view.camera.resized(width, height).before(scene.near)
        rows, columns, inside = pixels_of(places, camera, view.lens)
        shown += inside
        if not inside.any():
            continue
        is_sky = rows < _skyline(scene.points, camera, view)[columns]
        there = np.flatnonzero(inside)[is_sky]
        if len(there):
            picture = composite(view.load(width, height), np.zeros(3))
            sums[there] += picture[rows[is_sky], columns[is_sky]]
            votes[there] += 1
    chosen = np.flatnonzero((votes > 0) & (votes >= MIN_SKY_VOTE_FRACTION * shown))
    if len(chosen) == 0:
        raise InputError(f"{scene.name}: --sky: no photograph shows sky above its points; leave out --sky")
    if len(chosen) > count:
        chosen = chosen[np.linspace(0, len(chosen) - 1, count).astype(int)]
    colors: Float32 = np.clip(sums[chosen] / votes[chosen, None], 0, 1).astype(np.float32)
    return places[chosen], colors


def half_sphere(count: int, up: Float64) -> Float64:
    """Directions (count, 3), evenly spaced over the half sphere around `up` on a golden-angle spiral."""
    height = (np.arange(count) + 0.5) / count
    level, angle = np.sqrt(1 - height**2), _GOLDEN_ANGLE * np.arange(count)
    aside = np.eye(3)[int(np.argmin(np.abs(up)))]
    east = np.cross(up, aside)
    east /= np.linalg.norm(east)
    along = np.outer(level * np.cos(angle), east) + np.outer(level * np.sin(angle), np.cross(up, east))
    return np.asarray(along + np.outer(height, up))


def _skyline(points: Float64, camera: Camera, view: View) -> NDArray[np.int64]:
    """Row above which a picture shows no scene points, for each column.

    It is the same for all columns of a strip, and takes the neighbouring strips into account. It is 0 for strips
    without points, which may be too plain to have any.
    """
    rows, columns, _ = pixels_of(points, camera, view.lens)
    part = np.minimum(columns * SKYLINE_COLUMNS // camera.width, SKYLINE_COLUMNS - 1)
    tops = np.full(SKYLINE_COLUMNS + 2, camera.height)
    np.minimum.at(tops, part + 1, rows)
    tops = np.minimum(np.minimum(tops[:-2], tops[1:-1]), tops[2:])
    tops[tops == camera.height] = 0
    margin = camera.height // 40
    return np.asarray(np.maximum(tops[np.arange(camera.width) * SKYLINE_COLUMNS // camera.width] - margin, 0))

# SPDX-License-Identifier: Apache-2.0
"""A sky to start from: points of a sphere around the scene, where photographs see the sky."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.config.points import SKY_RADIUS
from clsplat.errors import InputError
from clsplat.images.alpha import composite
from clsplat.scenes.data_set import pixels_of

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene, View

LONGEST = 400
"""Pixels of the photographs' longer side here: a point of the sky stands for a few of the full size."""
FARTHEST = 0.95
"""Share of the scene's points that are within the distance of what counts as the farthest."""
DENSER = 4
"""Factor by which there are more directions to choose from than points are asked for, over the half sphere."""
COLUMNS = 24
"""Columns of a photograph in each of which the sky is what is above all points."""
AGREE = 0.5
"""Share of the photographs that show a direction in which it has to be sky."""
_GOLDEN = np.pi * (3 - np.sqrt(5.0))


def sky_points(scene: Scene, count: int) -> tuple[Float64, Float32]:
    """At most `count` points (N, 3) of the sky's sphere in the world and their colours (N, 3), the means of what the
    photographs have there.

    A direction above the horizon is sky where most photographs that show it have no point of the scene above it, in its
    column. Raises InputError where there is no such direction, or no points to tell by.
    """
    if len(scene.points) == 0:
        raise InputError(
            f"{scene.name}: --sky: the scene has no points to tell the sky by, expected some; leave it out"
        )
    cameras = [view.camera for view in scene.train_views]
    middle, *_ = scene.spread
    up = -np.stack([camera.rotation[1] for camera in cameras]).mean(axis=0)
    if (length := float(np.linalg.norm(up))) < 0.1:
        raise InputError(f"{scene.name}: --sky: the cameras have no common up, expected one; leave it out")
    radius = SKY_RADIUS * max(float(np.quantile(np.linalg.norm(scene.points - middle, axis=1), FARTHEST)), scene.extent)
    directions = half_sphere(DENSER * count, up / length)
    places = middle + radius * directions
    sums, votes, shown = np.zeros((len(places), 3)), np.zeros(len(places)), np.zeros(len(places))
    for view in scene.train_views:
        factor = min(LONGEST / max(view.camera.width, view.camera.height), 1.0)
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
    chosen = np.flatnonzero((votes > 0) & (votes >= AGREE * shown))
    if len(chosen) == 0:
        raise InputError(f"{scene.name}: --sky: no photograph shows any above its points, expected some; leave it out")
    if len(chosen) > count:
        chosen = chosen[np.linspace(0, len(chosen) - 1, count).astype(int)]
    colors: Float32 = np.clip(sums[chosen] / votes[chosen, None], 0, 1).astype(np.float32)
    return places[chosen], colors


def half_sphere(count: int, up: Float64) -> Float64:
    """Directions (count, 3), evenly over the half sphere about `up`: a spiral of the golden angle."""
    height = (np.arange(count) + 0.5) / count
    level, angle = np.sqrt(1 - height**2), _GOLDEN * np.arange(count)
    aside = np.eye(3)[int(np.argmin(np.abs(up)))]
    east = np.cross(up, aside)
    east /= np.linalg.norm(east)
    along = np.outer(level * np.cos(angle), east) + np.outer(level * np.sin(angle), np.cross(up, east))
    return np.asarray(along + np.outer(height, up))


def _skyline(points: Float64, camera: Camera, view: View) -> NDArray[np.int64]:
    """For each column of the picture the row above which no point of the scene is, in its part of the columns and those
    beside it; 0 where none is below either: it may be too plain to have any."""
    rows, columns, _ = pixels_of(points, camera, view.lens)
    part = np.minimum(columns * COLUMNS // camera.width, COLUMNS - 1)
    tops = np.full(COLUMNS + 2, camera.height)
    np.minimum.at(tops, part + 1, rows)
    tops = np.minimum(np.minimum(tops[:-2], tops[1:-1]), tops[2:])
    tops[tops == camera.height] = 0
    margin = camera.height // 40
    return np.asarray(np.maximum(tops[np.arange(camera.width) * COLUMNS // camera.width] - margin, 0))

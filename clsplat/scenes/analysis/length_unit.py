# SPDX-License-Identifier: Apache-2.0
"""The scene's length unit, from the depths of the points that the photographs show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from clsplat.arrays import Float64
from clsplat.scenes.dataset import nearest_around, occlusion_cell, pixels_of, tracked_in_view
from clsplat.scenes.readers import colmap
from clsplat.scenes.scene import Scene, View

DEPTH_TO_UNIT = 1.4
"""The largest length unit, as a multiple of the median depth.

The extent of the orbited scenes that were tried is at most 1.29 times the median depth. They keep it.
"""
NEAR_PER_EXTENT = 1e-6
"""Least depth of a point that counts, as a fraction of the extent."""
MAX_SAMPLED_VIEWS = 200
"""Maximum number of sampled photographs, spread evenly over the training photographs."""
MAX_SAMPLED_POINTS = 100_000
"""Maximum number of a scene's points that are projected, if it is not known which photographs show them."""


def length_unit_of(scene: Scene) -> float:
    """Length unit in world units: the extent, but at most `DEPTH_TO_UNIT` times the median depth.

    The depth is the median over the training photographs of the median depth of the points that they show. These are
    the points of a COLMAP model's tracks. Without tracks, each cell of a picture shows its nearest point.
    """
    medians = [float(np.median(depths)) for depths in _depths(scene) if len(depths)]
    unit = DEPTH_TO_UNIT * float(np.median(medians)) if medians else np.inf
    return min(unit, scene.extent) if unit > 0 else scene.extent


def _depths(scene: Scene) -> Iterator[Float64]:
    """Depths (k,) of the points that each of the sampled photographs shows."""
    views = scene.train_views
    views = views[:: max(-(-len(views) // MAX_SAMPLED_VIEWS), 1)]
    tracked = _tracked(scene, views)
    points = scene.points[:: max(-(-len(scene.points) // MAX_SAMPLED_POINTS), 1)]
    for view in views:
        if tracked:
            depths = view.camera.depths_of(tracked.get(view.name, np.empty((0, 3))))
            yield depths[depths > 0]
        elif len(points):
            yield _nearest(points, view, NEAR_PER_EXTENT * scene.extent)


def _tracked(scene: Scene, views: Sequence[View]) -> dict[str, Float64]:
    """Points (k, 3) of the tracks of each view, by its name; empty without tracks in the cameras' world frame."""
    model = None if scene.source is None else colmap.find_model(scene.source)
    if model is None or not len(scene.points):
        return {}
    tracks = colmap.read_tracks(model)
    found = {name: tracks.points[rows] for name, rows in tracks.shown_in([view.name for view in views]).items()}
    near = NEAR_PER_EXTENT * scene.extent
    shown = [view for view in views if view.name in found]
    *_, enough = tracked_in_view((view.camera.before(near), view.lens, found[view.name]) for view in shown)
    return found if enough else {}


def _nearest(points: Float64, view: View, near: float) -> Float64:
    """Depth of the nearest of the points (N, 3) in each occupied cell of the view's picture.

    near: depth from which points count, if the camera has no near plane of its own.
    """
    camera = view.camera.before(near)
    rows, columns, inside = pixels_of(points, camera, view.lens)
    depths = camera.depths_of(points[inside])
    around = nearest_around(rows, columns, depths, occlusion_cell(camera, len(depths)))
    nearest: Float64 = depths[depths == around]
    return nearest

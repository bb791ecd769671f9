# SPDX-License-Identifier: Apache-2.0
"""Scene points that are visible in the photographs' thumbnails, and exposures estimated from their colours."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.scenes.dataset import nearest_around, pixels_of
from clsplat.scenes.point_files import of_one_colour
from clsplat.scenes.scene import Scene, View

MAX_SAMPLED_SCENE_POINTS = 4000
"""Maximum number of scene points that are sampled. A larger sample changes a median brightness by less than 0.01."""
THUMBNAIL_OCCLUSION_DEPTH_RATIO = 1.15
"""A point counts as occluded if its depth is over this many times that of the nearest point in its occlusion cell."""
THUMBNAIL_OCCLUSION_CELL_PX = 8
"""Side in thumbnail pixels of an occlusion cell, a square in which the nearest point hides farther ones."""
MIN_POINTS_PER_VIEW = 40
"""Minimum number of visible points in a photograph whose brightness or scale is measured."""
MIN_EXPOSURE_COLOUR, MAX_EXPOSURE_COLOUR = 0.06, 0.94
"""Range of colour values that are used to measure exposure. Smaller ones are noisy, and larger ones may be clipped."""
COLOUR_NOISE_FLOOR = 1 / 255
"""Colour value up to which the logarithm is mostly noise: one 8-bit step.

A higher limit would exclude the darkest points of a dark photograph, which would then seem brighter.
"""
EXPOSURE_IRLS_ITERATIONS, MIN_EXPOSURE_RESIDUAL_STOPS = 10, 0.02
"""Iterations of reweighted least squares for exposures, and residual in stops below which weights no longer grow."""
EXPOSURE_RIDGE = 1e-9
"""Ridge term of the normal equations for exposures, as a fraction of their diagonal."""


class VisiblePoints:
    """Scene points located in the thumbnails of the training photographs."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        step = max(-(-len(scene.points) // MAX_SAMPLED_SCENE_POINTS), 1)
        self.points = scene.points[::step]
        self.colors = scene.point_colors[::step].astype(np.float64)
        grey = of_one_colour(scene.point_colors) if scene.colourless is None else scene.colourless[::step]
        self._coloured = np.broadcast_to(~np.asarray(grey), len(self.points))

    @cached_property
    def places(self) -> dict[str, tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Float64]]:
        """Indices, rows, columns and depths of the points that each thumbnail shows, keyed by the view's name.

        Rows and columns are in pixels of the thumbnail. Panoramas and fisheyes are left out.
        """
        flat = [view for view in self.scene.sampled_views if view.split == "train" and view.lens.native is None]
        return {view.name: self._place(view) for view in flat}

    @cached_property
    def up(self) -> Float64:
        """Mean up direction of the cameras in the world, (3,), unit length."""
        mean: Float64 = -np.mean([view.camera.rotation[1] for view in self.scene.train_views], axis=0)
        return mean / max(float(np.linalg.norm(mean)), 1e-9)

    def _place(self, view: View) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Float64]:
        height, width = self.scene.thumbnails[view.name].pixels.shape[:2]
        camera = view.camera.resized(width, height)
        rows, columns, inside = pixels_of(self.points, camera, view.lens)
        where = np.flatnonzero(inside)
        depths = (self.points[where] - camera.position) @ camera.rotation[2]
        seen = depths <= THUMBNAIL_OCCLUSION_DEPTH_RATIO * nearest_around(
            rows, columns, depths, THUMBNAIL_OCCLUSION_CELL_PX
        )
        return where[seen], rows[seen], columns[seen], depths[seen]

    @cached_property
    def gains(self) -> dict[str, Float64]:
        """log2 gain (3,) of each view, by the view's name, relative to the median of all views.

        A gain is the median, over the points in the view, of the colour in the view divided by the point's own colour.
        Points without own colours are not used. Views with fewer than MIN_POINTS_PER_VIEW usable points are left out.
        """
        found = {}
        for name, (which, rows, columns, _) in self.places.items():
            seen, known = self.scene.thumbnails[name].pixels[rows, columns], self.colors[which]
            both = np.concatenate([seen, known], axis=1)
            good = ((both > MIN_EXPOSURE_COLOUR) & (both < MAX_EXPOSURE_COLOUR)).all(axis=1) & self._coloured[which]
            if good.sum() >= MIN_POINTS_PER_VIEW:
                found[name] = np.median(np.log2(seen[good] / known[good]), axis=0)
        middle = np.median(list(found.values()), axis=0) if found else 0.0
        return {name: gain - middle for name, gain in found.items()}

    @cached_property
    def exposures(self) -> dict[str, Float64]:
        """log2 exposure (3,) of each photograph relative to the other photographs. The keys are the views' names.

        Each point is assumed to have the same colour in all photographs, so that differences are due to exposure. The
        fit minimises absolute differences by iteratively reweighted least squares. The scene's own point colours are
        not used. Photographs with fewer than MIN_POINTS_PER_VIEW shared points are left out.
        """
        if len(self.points) < MIN_POINTS_PER_VIEW:  # return early: `places` would load all thumbnails
            return {}
        seen = {name: self._logs(name) for name in self.places}
        counts = np.bincount(np.concatenate([np.empty(0, np.int64), *(which for which, _ in seen.values())]))
        shared = {}
        for name, (which, logs) in seen.items():
            several = counts[which] > 1
            if several.sum() >= MIN_POINTS_PER_VIEW:
                shared[name] = which[several], logs[several]
        if not shared:
            return {}
        views = np.repeat(np.arange(len(shared)), [len(which) for which, _ in shared.values()])
        points, colors = (np.concatenate(each) for each in zip(*shared.values(), strict=True))
        return dict(zip(shared, relative_exposures(points, views, colors), strict=True))

    def _logs(self, name: str) -> tuple[NDArray[np.int64], Float64]:
        """Return the indices (n,) of points that are neither too dark nor clipped in the view `name`, and log2 of the
        colours (n, 3) that the view shows there."""
        which, rows, columns, _ = self.places[name]
        pixels = self.scene.thumbnails[name].pixels
        seen, most = (
            pixels[rows, columns].astype(np.float64),
            MAX_EXPOSURE_COLOUR if pixels.max(initial=0) <= 1 else np.inf,
        )
        good = ((seen > COLOUR_NOISE_FLOOR) & (seen < most)).all(axis=1)
        return which[good], np.log2(seen[good])


def relative_exposures(points: NDArray[np.int64], views: NDArray[np.int64], logs: Float64) -> Float64:
    """Estimate the exposures (V, 3) of views from the colours of shared points.

    points, views: (M,), indices of a point and of a view that shows it; each pair occurs once.
    logs: (M, 3), log2 of the colours of these points in these views.

    Each log colour is modelled as the view's exposure plus the point's colour. The sum of absolute residuals is
    minimised. In each group of views that are connected by points, the weighted mean exposure is 0.
    """
    points = np.unique(points, return_inverse=True)[1]
    sizes, weights, found = (points.max() + 1, views.max() + 1), np.ones(len(points)), np.empty(0)
    for _ in range(EXPOSURE_IRLS_ITERATIONS):
        shown = np.zeros(sizes)
        shown[points, views] = weights
        whole = shown.sum(axis=1)
        means = _sums(points, weights, logs) / whole[:, None]
        # Normal equations, with the points' colours eliminated. The ridge term makes each group's weighted mean 0.
        matrix = np.diag(shown.sum(axis=0) * (1 + EXPOSURE_RIDGE)) - shown.T @ (shown / whole[:, None])
        found = np.linalg.solve(matrix, _sums(views, weights, logs - means[points]))
        colors = means - shown @ found / whole[:, None]
        weights = 1 / np.maximum(np.abs(logs - found[views] - colors[points]).mean(axis=1), MIN_EXPOSURE_RESIDUAL_STOPS)
    return found


def _sums(places: NDArray[np.int64], weights: Float64, values: Float64) -> Float64:
    """Return, for each index from 0 to K - 1, the sum of the weighted values that have this index: (K, 3).

    places: (M,), the index of each value. weights: (M,). values: (M, 3).
    """
    return np.stack([np.bincount(places, weights * column) for column in values.T], axis=1)

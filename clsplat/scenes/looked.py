# SPDX-License-Identifier: Apache-2.0
"""Where a scene's points are in glances at its photographs, and what they tell of the photographs' exposures."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.scenes.data_set import PANORAMA, RADIAL, nearest_around, pixels_of
from clsplat.scenes.point_files import of_one_colour
from clsplat.scenes.scene import Scene, View

MAX_POINTS = 4000
"""Points of the scene that are looked at: more move a median of brightness by less than a hundredth."""
BEHIND = 1.15
"""Depth, in that of the nearest point around, from which on a point is taken to be hidden."""
CELL = 8
"""Pixels of a glance that a point is alone in front of."""
LEAST_POINTS = 40
"""Points in a photograph without which nothing is said of its brightness or scale."""
DARK, BRIGHT = 0.06, 0.94
"""Colours outside are clipped or noise, and say nothing of exposure."""
NOISE = 1 / 255
"""Colours under which a logarithm is one of noise: a step of 8 bits. With a higher bound a dark photograph loses the
darkest of its points, and seems brighter."""
ROUNDS, LEAST_APART = 10, 0.02
"""Weighings of the points by how well they fit, and stops up to which one fits as well as any."""
RIDGE = 1e-9
"""Part of the normal equations' diagonal that is added to it."""


class Looked:
    """The training photographs' glances, with the places of the scene's points in them."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        step = max(-(-len(scene.points) // MAX_POINTS), 1)
        self.points = scene.points[::step]
        self.colors = scene.point_colors[::step].astype(np.float64)
        grey = of_one_colour(scene.point_colors) if scene.colourless is None else scene.colourless[::step]
        self._coloured = np.broadcast_to(~np.asarray(grey), len(self.points))

    @cached_property
    def places(self) -> dict[str, tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Float64]]:
        """By view: points that lie in it and are not hidden, their rows and columns in the glance, and their depths."""
        flat = [view for view in self.scene.train_views if view.lens.model not in (PANORAMA, *RADIAL)]
        return {view.name: self._place(view) for view in flat}

    @cached_property
    def up(self) -> Float64:
        """Upwards in the world, as the cameras were held on average, (3,)."""
        mean: Float64 = -np.mean([view.camera.rotation[1] for view in self.scene.train_views], axis=0)
        return mean / max(float(np.linalg.norm(mean)), 1e-9)

    def _place(self, view: View) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Float64]:
        height, width = self.scene.glances[view.name].pixels.shape[:2]
        camera = view.camera.resized(width, height)
        rows, columns, inside = pixels_of(self.points, camera, view.lens)
        where = np.flatnonzero(inside)
        depths = (self.points[where] - camera.position) @ camera.rotation[2]
        seen = depths <= BEHIND * nearest_around(rows, columns, depths, CELL)
        return where[seen], rows[seen], columns[seen], depths[seen]

    @cached_property
    def gains(self) -> dict[str, Float64]:
        """log2 of the brightness (3,) of each view by that of the points' colours, less the views' medians, of points
        that have colours."""
        found = {}
        for name, (which, rows, columns, _) in self.places.items():
            seen, known = self.scene.glances[name].pixels[rows, columns], self.colors[which]
            both = np.concatenate([seen, known], axis=1)
            good = ((both > DARK) & (both < BRIGHT)).all(axis=1) & self._coloured[which]
            if good.sum() >= LEAST_POINTS:
                found[name] = np.median(np.log2(seen[good] / known[good]), axis=0)
        middle = np.median(list(found.values()), axis=0) if found else 0.0
        return {name: gain - middle for name, gain in found.items()}

    @cached_property
    def exposures(self) -> dict[str, Float64]:
        """log2 of how bright each photograph is beside the others, (3,): each point has one colour in all photographs
        that show it, and what differs is their exposure. Of photographs that show LEAST_POINTS of these.

        Both by least absolute differences, in reweighted least squares; of the points' colours in the scene nothing is
        taken.
        """
        if len(self.points) < LEAST_POINTS:  # without a glance at any photograph
            return {}
        seen = {name: self._logs(name) for name in self.places}
        counts = np.bincount(np.concatenate([np.empty(0, np.int64), *(which for which, _ in seen.values())]))
        shared = {}
        for name, (which, logs) in seen.items():
            several = counts[which] > 1
            if several.sum() >= LEAST_POINTS:
                shared[name] = which[several], logs[several]
        if not shared:
            return {}
        views = np.repeat(np.arange(len(shared)), [len(which) for which, _ in shared.values()])
        points, colors = (np.concatenate(each) for each in zip(*shared.values(), strict=True))
        return dict(zip(shared, relative_exposures(points, views, colors), strict=True))

    def _logs(self, name: str) -> tuple[NDArray[np.int64], Float64]:
        """Points (n,) that a view shows neither dark nor clipped, and log2 of their colours in it (n, 3)."""
        which, rows, columns, _ = self.places[name]
        pixels = self.scene.glances[name].pixels
        seen, most = pixels[rows, columns].astype(np.float64), BRIGHT if pixels.max(initial=0) <= 1 else np.inf
        good = ((seen > NOISE) & (seen < most)).all(axis=1)
        return which[good], np.log2(seen[good])


def relative_exposures(points: NDArray[np.int64], views: NDArray[np.int64], logs: Float64) -> Float64:
    """Exposures (V, 3) of views, by log2 colours `logs` (M, 3) of `points` (M,) in `views` (M,), each pair once: the
    sums of a view's exposure and a point's colour are off by the least absolute differences. Of views that points link
    the mean, by weights, is 0."""
    points = np.unique(points, return_inverse=True)[1]
    sizes, weights, found = (points.max() + 1, views.max() + 1), np.ones(len(points)), np.empty(0)
    for _ in range(ROUNDS):
        shown = np.zeros(sizes)
        shown[points, views] = weights
        whole = shown.sum(axis=1)
        means = _sums(points, weights, logs) / whole[:, None]
        # normal equations without the points' colours; what is added to them has each group's mean 0
        matrix = np.diag(shown.sum(axis=0) * (1 + RIDGE)) - shown.T @ (shown / whole[:, None])
        found = np.linalg.solve(matrix, _sums(views, weights, logs - means[points]))
        colors = means - shown @ found / whole[:, None]
        weights = 1 / np.maximum(np.abs(logs - found[views] - colors[points]).mean(axis=1), LEAST_APART)
    return found


def _sums(places: NDArray[np.int64], weights: Float64, values: Float64) -> Float64:
    """Sums (places, 3) of weighted values (M, 3)."""
    return np.stack([np.bincount(places, weights * column) for column in values.T], axis=1)

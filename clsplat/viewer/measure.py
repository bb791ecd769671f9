# SPDX-License-Identifier: Apache-2.0
"""Distance between two clicked points of the model, and the flags that set the scale by it.

The module uses neither OpenCL nor viser.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.errors import InputError

MIN_CLICK_ALPHA = 0.5
"""Minimum alpha of a pixel on which a click hits the model."""
CLICK_WINDOW_PX = 3
"""Number of pixels on each side of a click to which a plane is fitted. A single depth would not follow
the surface, as it is the same on all pixels of a Gaussian."""
SAME_SURFACE_RATIO = 0.1
"""Largest difference from the clicked depth, relative to it, of depths that can be on the same surface."""
SURFACE_FITS = 5
"""Number of reweighted least-squares fits of the plane."""
FLAG_PRECISION = 1e-5
"""Precision of coordinates in the flag --scale, relative to the distance between the points."""
MAX_LENGTH_METRES = 1e6
"""Largest length that can be entered, in metres."""


def point_at(camera: Camera, depth: Float32, alpha: Float32, place: tuple[float, float]) -> Float64:
    """Return the point (3,) of the world that a click hits.

    camera: a pinhole camera of the picture's size.
    depth: (H, W), along the camera's axis in world units, of the surface that is seen. alpha: (H, W).
    place: of the click, from the picture's left and top, as fractions of its width and height.
    Raises InputError for a click that does not hit the model.
    """
    if not all(0 <= value <= 1 for value in place):  # false for NaN too
        raise InputError("the click is outside the picture")
    x, y = place[0] * camera.width, place[1] * camera.height
    column, row = min(int(x), camera.width - 1), min(int(y), camera.height - 1)
    z = float(depth[row, column])
    if not (alpha[row, column] >= MIN_CLICK_ALPHA and 0 < z < np.inf):
        raise InputError("nothing is there: click on the model")
    z = _surface_depth(depth, alpha, (x, y))
    ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
    return np.asarray(camera.rotation.T @ (z * ray - camera.translation))


def _surface_depth(depth: Float32, alpha: Float32, place: tuple[float, float]) -> float:
    """Return the depth of the surface at a place (x, y) in pixels, by a robust fit of a plane to the depths around it.

    On a plane, 1 / depth is linear in x and y. Weights are Tukey's biweight.
    """
    column, row = (min(int(value), side - 1) for value, side in zip(place, depth.shape[::-1], strict=True))
    rows, columns = (slice(max(at - CLICK_WINDOW_PX, 0), at + CLICK_WINDOW_PX + 1) for at in (row, column))
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]][:, rows, columns] + 0.5
    z, centre = depth[rows, columns].astype(np.float64), float(depth[row, column])
    near = (alpha[rows, columns] >= MIN_CLICK_ALPHA) & (np.abs(z - centre) <= SAME_SURFACE_RATIO * centre)
    terms = np.stack([np.ones(near.sum()), x[near] - place[0], y[near] - place[1]], axis=1)
    inverse, weights = 1 / z[near], np.ones(near.sum())
    fit = np.array([1 / centre, 0.0, 0.0])
    for _ in range(SURFACE_FITS):
        roots = np.sqrt(weights)
        fit = np.linalg.lstsq(terms * roots[:, None], inverse * roots, rcond=None)[0]
        off = np.abs(terms @ fit - inverse)
        weights = np.square(np.clip(1 - np.square(off / (4.7 * 1.4826 * np.median(off) + 1e-12 / centre)), 0, None))
    least, most = centre * (1 - SAME_SURFACE_RATIO), centre * (1 + SAME_SURFACE_RATIO)
    return float(np.clip(1 / fit[0], least, most))


@dataclass
class Measurement:
    """The points that were clicked, at most two.

    points: each (3,), in the world.
    """

    points: list[Float64] = field(default_factory=list)

    def add(self, point: Float64) -> None:
        """Add a point. A third one begins a new measurement."""
        self.points = [point] if len(self.points) == 2 else [*self.points, point]

    @property
    def distance(self) -> float | None:
        """Distance of the points in world units; None until there are two."""
        return float(np.linalg.norm(self.points[1] - self.points[0])) if len(self.points) == 2 else None

    def text(self, metres: float) -> str:
        """Return the result as Markdown. metres: the known length; 0 if it is not known."""
        if (distance := self.distance) is None:
            return ("Click on a point.", "Click on a second point.")[len(self.points)]
        shown = f"Distance: {distance:.6g} world units."
        if not 0 < metres <= MAX_LENGTH_METRES or distance == 0:
            return f"{shown} Enter its length in metres to see the flag that sets the scale."
        digits = max(0, math.ceil(-math.log10(FLAG_PRECISION * distance)))
        ends = ",".join(f"{value:.{digits}f}" for point in self.points for value in point)
        return (
            f"{shown} To make it {metres:g} m, give `clsplat sfm` or `clsplat train` the flag\n\n"
            f"```\n--scale={ends}={metres:g}\n```\n\nor scale this model:\n\n"
            f"```\nclsplat convert MODEL OUTPUT --scale {metres / distance:.6g}\n```"
        )

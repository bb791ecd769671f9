# SPDX-License-Identifier: Apache-2.0
"""Distance between two clicked points of the model, and the flags that make it a known length. Uses neither OpenCL nor
viser."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.errors import InputError

MIN_CLICK_ALPHA = 0.5
"""Minimum alpha of a pixel on which a click hits the model."""
MAX_LENGTH_METRES = 1e6
"""Largest length that can be entered, in metres."""


def point_at(camera: Camera, depth: Float32, alpha: Float32, place: tuple[float, float]) -> Float64:
    """Return the point (3,) of the world that a click hits.

    camera: a pinhole camera of the picture's size.
    depth: (H, W), along the camera's axis in world units. alpha: (H, W).
    place: from the picture's left and top, as fractions of its width and height.
    Raises InputError for a click beside the model.
    """
    if not all(0 <= value <= 1 for value in place):  # false for NaN too
        raise InputError("the click is outside the picture")
    x, y = place[0] * camera.width, place[1] * camera.height
    column, row = min(int(x), camera.width - 1), min(int(y), camera.height - 1)
    z = float(depth[row, column])
    if not (alpha[row, column] >= MIN_CLICK_ALPHA and 0 < z < np.inf):
        raise InputError("nothing is there: click on the model")
    ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
    return np.asarray(camera.rotation.T @ (z * ray - camera.translation))


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
            return f"{shown} Enter its length in metres for a flag."
        ends = ",".join(f"{value:.6g}" for point in self.points for value in point)
        return (
            f"{shown} To make it {metres:g} m, give `clsplat sfm` or `clsplat train` the flag\n\n"
            f"`--scale={ends}={metres:g}`\n\nor scale this model:\n\n"
            f"`clsplat convert MODEL OUTPUT --scale {metres / distance:.6g}`"
        )

# SPDX-License-Identifier: Apache-2.0
"""Geometry of a shot's cameras: poses that face a point, covered arc, and the box of the points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64

MAX_AZIMUTH_GAP_RADIANS = np.deg2rad(100.0)
"""Widest azimuth gap between cameras, in radians, that a turntable crosses. At wider gaps it swings back and forth."""


def look_at(position: Float64, target: Float64, up: Float64) -> tuple[Float64, Float64]:
    """Rotation (3, 3) and translation (3,), `cam_from_world`, of a level camera at `position` that faces `target`.

    up: (3,), at any angle to the view direction but not parallel to it.
    """
    forward = target - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rotation, -rotation @ position


def covered_arc(azimuths: Float64) -> tuple[float, float]:
    """Return the start and width, in radians, of the shortest arc that contains all azimuths (n,). The arc goes from
    its start in the direction of increasing angles."""
    ordered = np.sort(np.mod(azimuths, 2 * np.pi))
    gaps = np.diff(ordered, append=ordered[0] + 2 * np.pi)
    widest = int(np.argmax(gaps))
    return float(ordered[(widest + 1) % len(ordered)]), float(2 * np.pi - gaps[widest])


def extent_of(points: NDArray[Any], inside: float = 0.96) -> tuple[Float64, Float64]:
    """Return the corners (3,) of the box that contains the fraction `inside` of the points (N, 3) along each axis. The
    points outside count as outliers."""
    if not len(points):
        return -np.ones(3), np.ones(3)
    some = points[:: max(1, len(points) // 100_000)]
    low, high = np.quantile(some.astype(np.float64), [0.5 - inside / 2, 0.5 + inside / 2], axis=0)
    return low, high

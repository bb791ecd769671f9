# SPDX-License-Identifier: Apache-2.0
"""Detection of outliers: cameras and points so far away that a scene size computed with them would be meaningless."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import Camera

OUTLIER_GAP_RATIO = 2.0
"""Outliers may begin where a distance from the middle of all positions is over this many times the next smaller one.

In captures without outliers this ratio is at most 1.7, and largest at the farthest positions.
"""
OUTLIER_DISTANCE_RATIO = 5.0
"""Minimum distance of an outlier from the middle, relative to the farthest position that is not an outlier.

If the scene size includes an outlier at 5, 8, 12 or 30 times that distance, a training on 24 photographs loses
1.2, 2.7, 4 or 7 dB of PSNR.
"""
MAX_OUTLIER_CAMERA_FRACTION = 0.25
"""Maximum fraction of the cameras that can be outliers. If more cameras are far away, they belong to the capture."""
MAX_OUTLIER_POINT_FRACTION = 0.01
"""Maximum fraction of the points that can be outliers."""


def strays(places: Float64, most: float, least: float = 0.0, middle: Float64 | None = None) -> NDArray[np.bool_]:
    """Return a mask (N,) of the outliers among positions `places` (N, 3).

    Distances are measured from `middle` (3,), by default the median of each axis, and sorted. The first gap is where a
    distance is more than OUTLIER_GAP_RATIO times the distance before it. Positions beyond the gap are outliers if they
    are more than OUTLIER_DISTANCE_RATIO times as far away as the last position before it.

    most: maximum fraction of outliers.
    least: lower limit of the distance before the gap, such as the distance of the points that the cameras see. If
        `least` is 0 and all positions but a few coincide, no position is an outlier.
    """
    found = np.zeros(len(places), np.bool_)
    first = len(places) - int(most * len(places))  # the `first` nearest positions cannot be outliers
    if not 0 < first < len(places):
        return found
    distances = np.linalg.norm(places - (np.median(places, axis=0) if middle is None else middle), axis=1)
    order = np.argsort(distances, kind="stable")
    within, beyond = distances[order[first - 1 : -1]], distances[order[first:]]
    reach = np.maximum(within, least)
    gaps = (beyond > OUTLIER_GAP_RATIO * reach) & (reach > 0)
    if gaps.any():
        at = int(gaps.argmax())
        found[order[first + at :]] = beyond[at:] > OUTLIER_DISTANCE_RATIO * reach[at]
    return found


def stray_cameras(cameras: Sequence[Camera], least: float = 0.0) -> NDArray[np.bool_]:
    """Return a mask (N,) of the outliers among cameras.

    least: distance from the middle, in world units, within which no camera is an outlier.
    """
    return strays(np.stack([camera.position for camera in cameras]), MAX_OUTLIER_CAMERA_FRACTION, least)

# SPDX-License-Identifier: Apache-2.0
"""Strays: cameras and points that stand so far off the others that sizes taken from all of them mean nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import Camera

GAP = 2.0
"""Distance of a place from the middle, in that of the next one nearer to it, from which on it may be a stray. In the
captures at hand the next one out is up to 1.7 times as far."""
FACTOR = 5.0
"""Distance of a stray from the middle, in that of the farthest of the others. A training of 24 photographs whose sizes
include a stray loses 1.2 dB at 5, 2.7 at 8, 4 at 12 and 7 at 30."""
MOST_CAMERAS = 0.25
"""Largest share of the cameras that can be strays: more of them are a part of the capture."""
MOST_POINTS = 0.01
"""The same of the points, of which thousands are left."""


def strays(places: Float64, most: float, least: float = 0.0, middle: Float64 | None = None) -> NDArray[np.bool_]:
    """(N,): True for the places (N, 3) that are strays.

    Distances count from the middle (3,), by default the median of each axis. Sorted, those behind the first gap of GAP
    are strays if they are FACTOR times as far as the last before it, and at most this share of all. least: a distance
    from which FACTOR counts in any case, such as that of what the cameras look at. Places that are all the same but for
    some have no size to compare with otherwise, and no strays.
    """
    found = np.zeros(len(places), np.bool_)
    first = len(places) - int(most * len(places))  # so many stay whatever their distances are
    if not 0 < first < len(places):
        return found
    distances = np.linalg.norm(places - (np.median(places, axis=0) if middle is None else middle), axis=1)
    order = np.argsort(distances, kind="stable")
    within, beyond = distances[order[first - 1 : -1]], distances[order[first:]]
    reach = np.maximum(within, least)
    gaps = (beyond > GAP * reach) & (reach > 0)
    if gaps.any():
        at = int(gaps.argmax())
        found[order[first + at :]] = beyond[at:] > FACTOR * reach[at]
    return found


def stray_cameras(cameras: Sequence[Camera], least: float = 0.0) -> NDArray[np.bool_]:
    """(N,): True for the cameras that are strays; least: as of `strays`."""
    return strays(np.stack([camera.position for camera in cameras]), MOST_CAMERAS, least)

# SPDX-License-Identifier: Apache-2.0
"""Focal length of a camera without EXIF, from the fundamental matrices of pairs of its photographs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MIN_FOCAL_PAIRS, MAX_FOCAL_PAIRS = 20, 500
"""Minimum number of pairs from which a focal length is found, and number of the pairs that are used at most."""
MIN_FOCAL_RATIO, MAX_FOCAL_RATIO, FOCAL_CANDIDATES = 0.3, 4.0, 80
"""Range of the candidates as multiples of the photographs' longer side, and number of candidates, 3 % apart."""
MAX_SINGULAR_VALUE_GAP = 0.02
"""Largest relative difference of two singular values in the median pair, for the focal length to count as found.

It is 0.0015 in bonsai_photos, whose focal length is found within 2 %, and 0.010 in rgbd_7scenes (5 %). In the drone's
pictures of flat ground in caliterra it is 0.069.
"""


def focal_from_pairs(fundamentals: NDArray[Any], width: int, height: int) -> float | None:
    """Return the focal length in pixels that photographs of one camera share, None if the pairs do not tell.

    With the right focal length a fundamental matrix becomes an essential matrix, whose first two singular values are
    equal (Mendonca, Cipolla, 1999). The focal length is the candidate with which their relative difference is smallest
    in the median pair. The principal point is the middle of the photograph.

    fundamentals: fundamental matrices (N, 3, 3) of pairs of photographs of width x height pixels.
    """
    if len(fundamentals) < MIN_FOCAL_PAIRS:
        return None
    used = np.linspace(0, len(fundamentals) - 1, min(len(fundamentals), MAX_FOCAL_PAIRS)).astype(int)
    middle = np.array([[1, 0, width / 2], [0, 1, height / 2], [0, 0, 1]])
    centred = middle.T @ fundamentals[used] @ middle
    candidates = max(width, height) * np.geomspace(MIN_FOCAL_RATIO, MAX_FOCAL_RATIO, FOCAL_CANDIDATES)
    gaps = np.array([np.median(_gaps(centred, focal)) for focal in candidates])
    best = int(np.argmin(gaps))
    if gaps[best] > MAX_SINGULAR_VALUE_GAP or best in (0, FOCAL_CANDIDATES - 1):
        return None
    return float(candidates[best])


def _gaps(centred: NDArray[Any], focal: float) -> NDArray[Any]:
    """Return the relative differences (N,) of the first two singular values of essential matrices.

    centred: fundamental matrices (N, 3, 3), with the principal point at (0, 0).
    """
    scale = np.diag([focal, focal, 1.0])
    values = np.linalg.svd(scale @ centred @ scale, compute_uv=False)
    return np.asarray((values[:, 0] - values[:, 1]) / (values[:, 0] + values[:, 1]))

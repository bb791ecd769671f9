# SPDX-License-Identifier: Apache-2.0
"""Photographs with nearby cameras (neighbours), and the part of their gains that they have in common.

The pictures hardly determine the common part, so `--appearance exposure` pulls it to its initial value.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.camera import Camera

if TYPE_CHECKING:
    from scipy.sparse import csr_array

NEIGHBOUR_DISTANCE_LIMIT = 2.5
"""Distance at which cameras stop being neighbours.

It combines two distances: between the cameras' centres, relative to their median distance from the middle, and between
the unit viewing directions. A neighbour at a quarter of the limit has about half of the weight. Over
about this quarter, a colour of SH degree 3 can vary with the direction.
"""
MAX_MEAN_NEIGHBOURS = 256
"""Maximum mean number of neighbours of a camera, itself included. With more, the distance limit is reduced."""
NEIGHBOUR_WEIGHT_STEP = 2.0**-20
"""Weights of neighbours are rounded to multiples of this, to be equal on processors that round differently."""


def places(cameras: Sequence[Camera]) -> Float64:
    """Return points (n, 6) whose distances say how near cameras are to each other: position and viewing direction of
    each camera. Positions are relative to their middle, in units of the median distance from it. If all positions
    differ only by rounding, they count as equal."""
    centres = np.array([camera.position for camera in cameras])
    apart = centres - np.median(centres, axis=0)
    extent = float(np.median(np.linalg.norm(apart, axis=1)))
    if extent <= 1e-6 * np.abs(centres).max():
        apart, extent = np.zeros_like(apart), 1.0
    return np.concatenate([apart / extent, [camera.rotation[2] for camera in cameras]], axis=1)


def common(cameras: Sequence[Camera], told: NDArray[np.bool_]) -> csr_array:
    """Symmetric matrix (n, n) that extracts the common part of neighbouring photographs' values.

    told: (n,), True for photographs that have gains from points; rows and columns of all others are 0.

    For a photograph with many neighbours the matrix keeps nearly all of the common part. For a photograph without
    neighbours it keeps half of the value. The matrix's entries are w / sqrt(t t'). The weight w is (1 - r)^6 (6 r + 1)
    for two cameras at a distance of r times NEIGHBOUR_DISTANCE_LIMIT. For each of the two photographs, t or t' is 1
    plus the sum of w over its neighbours, itself included. As a function of distance, w is positive definite in six
    dimensions (Wendland, Advances in Computational Mathematics 4, 1995). So the matrix is positive semidefinite, except
    for rounding to `NEIGHBOUR_WEIGHT_STEP`.
    """
    from scipy.sparse import csr_array, diags_array  # here, as the import takes 0.2 s and few trainings need it
    from scipy.spatial import KDTree

    numbers = np.flatnonzero(told)
    if not len(numbers):
        return csr_array((len(told), len(told)), dtype=np.float64)
    points = places(cameras)[numbers]
    tree, reach = KDTree(points), NEIGHBOUR_DISTANCE_LIMIT
    while (
        tree.count_neighbors(tree, reach) > MAX_MEAN_NEIGHBOURS * len(points)
        and reach > NEIGHBOUR_DISTANCE_LIMIT / 1024
    ):
        reach /= 2**0.5
    pairs = tree.query_pairs(reach, output_type="ndarray")
    apart = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) / reach
    weights = (1 - apart) ** 6 * (6 * apart + 1)
    half = csr_array((weights, tuple(numbers[pairs].T)), shape=(len(told), len(told)))
    near = half + half.T + diags_array(told.astype(np.float64))
    scale = diags_array(told / np.sqrt(1 + near.sum(axis=1)))
    result = csr_array(scale @ near @ scale)
    result.data = np.round(result.data / NEIGHBOUR_WEIGHT_STEP) * NEIGHBOUR_WEIGHT_STEP
    result.eliminate_zeros()
    result.sort_indices()
    return result

# SPDX-License-Identifier: Apache-2.0
"""Photographs whose cameras are near each other: what their gains have in common, pictures hardly tell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.spatial import KDTree

from clsplat.arrays import Float64
from clsplat.camera import Camera

REACH = 2.5
"""Distance at which cameras are no neighbours any more: of their centres, in parts of the median distance from the
middle, and of the unit vectors in which they look, together. About half of the weight is left at a quarter of it,
as far as colours by direction, of SH degree 3, can follow."""
MOST = 256
"""Neighbours of a camera on average, itself among them; where there were more, they reach less far."""
GRAIN = 2.0**-20
"""Weights are multiples of it, so that processors that round otherwise have the same."""


def places(cameras: Sequence[Camera]) -> Float64:
    """Points (n, 6) whose distances `REACH` measures. Centres that rounding alone holds apart are one."""
    centres = np.array([camera.position for camera in cameras])
    apart = centres - np.median(centres, axis=0)
    extent = float(np.median(np.linalg.norm(apart, axis=1)))
    if extent <= 1e-6 * np.abs(centres).max():
        apart, extent = np.zeros_like(apart), 1.0
    return np.concatenate([apart / extent, [camera.rotation[2] for camera in cameras]], axis=1)


def common(cameras: Sequence[Camera], told: NDArray[np.bool_]) -> csr_array:
    """A symmetric matrix (n, n) that keeps of values of photographs what neighbours have in common, up to all of it,
    and half of what one without neighbours has; rows and columns of those not `told` are 0.

    Between two photographs it has w / sqrt(t t'), where w is (1 - r)^6 (6 r + 1) at a distance of r REACH, and t, t'
    are 1 more than the sums of their w. With such w, positive definite in six dimensions (Wendland, Advances in
    Computational Mathematics 4, 1995), the matrix is positive semidefinite but for `GRAIN`.
    """
    numbers = np.flatnonzero(told)
    if not len(numbers):
        return csr_array((len(told), len(told)), dtype=np.float64)
    points = places(cameras)[numbers]
    tree, reach = KDTree(points), REACH
    while tree.count_neighbors(tree, reach) > MOST * len(points) and reach > REACH / 1024:
        reach /= 2**0.5
    pairs = tree.query_pairs(reach, output_type="ndarray")
    apart = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1) / reach
    weights = (1 - apart) ** 6 * (6 * apart + 1)
    half = csr_array((weights, tuple(numbers[pairs].T)), shape=(len(told), len(told)))
    near = half + half.T + diags_array(told.astype(np.float64))
    scale = diags_array(told / np.sqrt(1 + near.sum(axis=1)))
    result = csr_array(scale @ near @ scale)
    result.data = np.round(result.data / GRAIN) * GRAIN
    result.eliminate_zeros()
    result.sort_indices()
    return result

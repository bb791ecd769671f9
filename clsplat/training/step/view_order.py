# SPDX-License-Identifier: Apache-2.0
"""Order of the views in an epoch, a pass through the training photographs (--view-order). Uses no OpenCL.

A pass shows each view once. Its order is random (a shuffle), or alternates between four clusters of views. The views
of a cluster look at points that are near each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clsplat.arrays import Int64
from clsplat.camera import Camera

CLUSTER_VIEWS = 16
"""Maximum number of views in a cluster."""
CLUSTERS_AT_ONCE = 4
"""Number of clusters whose views alternate. With one cluster after the other, successive views would have more in
common. But the scene bonsai then loses 0.3 dB: the model fits the last cluster at the expense of the others
(docs/decisions/0050)."""
GAZE_UNITS = 1.5
"""Distance, in length units, from a camera to the point on its viewing axis that stands for the view.

A length unit is 1.4 times the median depth of the photographs, or less. With about this distance the views of
a cluster have the most Gaussians in common (docs/decisions/0050).
"""
POINT_STEP = 2.0**-16
"""Points are rounded to multiples of this, in length units. So the points of cameras in a row or in one place have
equal coordinates, in spite of rounding errors."""


class ViewOrder:
    """Order of the training views in each epoch, a pass through all of them.

    cameras: cameras of the training views, as given. The order does not follow refined poses.
    unit: length unit of the scene, in world units.
    near: True to group views into clusters that look at points near each other; False for a random order.
    """

    def __init__(self, cameras: Sequence[Camera], unit: float, *, near: bool) -> None:
        self._count = len(cameras)
        self.clusters = clusters_of(gaze_points(cameras, unit)) if near else None

    def next_pass(self, rng: np.random.Generator) -> list[int]:
        """Indices of all views, in the order of the next pass."""
        if self.clusters is None:
            return [int(view) for view in rng.permutation(self._count)]
        waiting = [rng.permutation(self.clusters[one]).tolist() for one in rng.permutation(len(self.clusters))]
        begun = [waiting.pop() for _ in range(min(CLUSTERS_AT_ONCE, len(waiting)))]
        order: list[int] = []
        while begun:
            order += [cluster.pop() for cluster in begun]
            begun = [cluster or waiting.pop() for cluster in begun if cluster or waiting]
        return order


def gaze_points(cameras: Sequence[Camera], unit: float) -> Int64:
    """Points (n, 3) that the views look at, relative to the middle of the cameras, in multiples of `POINT_STEP`.

    The point of a panorama, which looks in every direction, is its camera's position.
    """
    positions = np.array([camera.position for camera in cameras])
    axes = np.array([camera.rotation[2] * (not camera.model.wraps) for camera in cameras])
    points = (positions - np.median(positions, axis=0)) / unit + GAZE_UNITS * axes
    return np.asarray(np.round(points / POINT_STEP).astype(np.int64))


def clusters_of(points: Int64) -> list[Int64]:
    """Divide views into clusters of nearly equal size, each of at most `CLUSTER_VIEWS` views whose points are near each
    other. Returns the indices of each cluster's views.

    points: (n, d), the point that each view looks at.

    The clusters are the leaves of a k-d tree, which divides along the coordinate of the widest range. Views with equal
    coordinates are divided by their index.
    """
    leaves, nodes = [], [np.arange(len(points))]
    while nodes:
        views = nodes.pop()
        parts = -(-len(views) // CLUSTER_VIEWS)
        if parts == 1:
            leaves.append(views)
            continue
        coordinate = int(np.argmax(np.ptp(points[views], axis=0)))
        views = views[np.lexsort((views, points[views, coordinate]))]
        middle = len(views) * (parts // 2) // parts
        nodes += [views[:middle], views[middle:]]
    return [np.sort(views) for views in leaves]

# SPDX-License-Identifier: Apache-2.0
"""Colours for a cloud that has none: of each point the mean of what the training photographs have where it is seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32, Float64
from clsplat.images.alpha import composite

if TYPE_CHECKING:
    from clsplat.camera import Camera
    from clsplat.scenes.scene import Scene

LONGEST = 400
"""Pixels of the photographs' longer side here: a point stands for a few of the full size."""
UNSEEN = 0.5
"""Grey, for points that no photograph shows."""


def is_colourless(scene: Scene) -> bool:
    """True if all points are of one colour, as those of clouds without colours are read."""
    colors = scene.point_colors
    return len(colors) > 1 and bool((colors == colors[0]).all())


def photographed(scene: Scene, background: ArrayLike) -> Float32:
    """(N, 3) float32 in [0, 1] for the scene's points. What lies before a point is not known, and counts too."""
    sums, seen = np.zeros((len(scene.points), 3)), np.zeros(len(scene.points))
    for view in scene.train_views:
        factor = min(LONGEST / max(view.camera.width, view.camera.height), 1.0)
        camera = view.camera.resized(
            max(round(factor * view.camera.width), 1), max(round(factor * view.camera.height), 1)
        ).before(scene.near)
        picture = composite(view.load(camera.width, camera.height), background)
        rows, columns, inside = pixels_of(scene.points, camera)
        sums[inside] += picture[rows, columns]
        seen[inside] += 1
    means = np.where(seen[:, None] > 0, sums / np.maximum(seen, 1)[:, None], UNSEEN)
    return np.clip(means, 0, 1).astype(np.float32)


def pixels_of(points: Float64, camera: Camera) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Rows and columns of the pixels that show the points (N, 3) of the world, of those before the camera and in its
    picture, which are `inside` (N,)."""
    local = points @ camera.rotation.T + camera.translation
    depth = local[:, 2]
    ahead = depth > camera.near
    by = np.where(ahead, depth, 1.0)
    x, y = camera.fx * local[:, 0] / by + camera.cx, camera.fy * local[:, 1] / by + camera.cy
    inside = ahead & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return y[inside].astype(np.int64), x[inside].astype(np.int64), inside

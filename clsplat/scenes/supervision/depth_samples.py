# SPDX-License-Identifier: Apache-2.0
"""Known depths of one view, from points or a depth map: their pixels and inverse depths, for the depth loss.

Scales of relative depth maps are fitted in `scenes/depth_sources.py`.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.files.documents import short_digest
from clsplat.images.depth_maps import read_map
from clsplat.scenes.dataset import Lens, pixels_of

NO_DEPTH_VALUE = 65535
"""Value that some sensors write for unknown depth in metric maps of integers. 0 also means unknown."""


@dataclass(frozen=True, eq=False)
class KnownDepth:
    """Known depths of a view, from points or from a depth map.

    points: (K, 3) float64, world coordinates; not used with a depth map.
    weights: (K,), weights of the points in the depth loss, 0 to 1.
    path: file of the depth map, if any.
    unit: world units per value of a metric map, whose inverse depth is 1 / (value * unit).
    fit: scale and offset of a relative map, whose inverse depth is scale * value + offset; None for a metric map.
    whole: True if the map has integer values.
    """

    points: Float64
    weights: Float64
    path: Path | None = None
    unit: float = 1.0
    fit: tuple[float, float] | None = None
    whole: bool = False

    def at(self, camera: Camera, lens: Lens) -> tuple[NDArray[np.int64], Float32, Float32]:
        """Return the pixels with known depth in a picture of the camera's size.

        The results are ascending pixel indices, inverse depths in 1 / world units, and weights, each (k,).

        lens: the lens of the photograph and its depth map. A camera that is not a pinhole has the same lens.
        """
        if self.path is not None:
            nearness = self._from_map(camera, lens)
            found = np.flatnonzero((nearness > 0) & (nearness < np.finfo(np.float32).max))
            return found, nearness.ravel()[found].astype(np.float32), np.ones(len(found), np.float32)
        rows, columns, inside = pixels_of(self.points, camera, lens)
        index, near = rows * camera.width + columns, 1 / camera.depths_of(self.points[inside])
        weights = self.weights[inside]
        order = np.lexsort((-near, index))  # of several points in a pixel, the nearest comes first
        index, first = np.unique(index[order], return_index=True)
        kept = order[first]
        return index, near[kept].astype(np.float32), weights[kept].astype(np.float32)

    def _from_map(self, camera: Camera, lens: Lens) -> Float64:
        assert self.path is not None
        values = sampled(read_map(self.path), camera, lens)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.fit is None:
                return np.where(self.measured(values), 1 / (values * self.unit), 0.0)
            return np.where(np.isfinite(values), self.fit[0] * values + self.fit[1], 0.0)

    def measured(self, values: NDArray[Any]) -> NDArray[np.bool_]:
        """Return a mask of a metric map's values: True for depths, False for values that mean an unknown depth."""
        known: NDArray[np.bool_] = (values > 0) & np.isfinite(values) & ~(self.whole & (values == NO_DEPTH_VALUE))
        return known

    @property
    def digest(self) -> str:
        """Identifier that differs for different known depths."""
        if self.path is not None:
            return f"{short_digest(self.path)} {self.unit} {self.fit}"
        data = np.concatenate([self.points, self.weights[:, None]], axis=1).astype("<f8")
        return hashlib.blake2b(data.tobytes(), digest_size=16).hexdigest()


def sampled(values: Float32, camera: Camera, lens: Lens) -> Float64:
    """Sample a depth map (h, w) at the pixels of a camera (H, W), without interpolation; NaN outside the map.

    lens: lens of the depth map, at any size.
    """
    height, width = values.shape
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    if camera.is_pinhole and not lens.is_pinhole:
        rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
        found = lens.img_from_cam(rays.reshape(-1, 3)).reshape(*x.shape, 2)
        x, y = found[..., 0] * width / lens.width, found[..., 1] * height / lens.height
    else:
        x, y = x * width / camera.width, y * height / camera.height
    with np.errstate(invalid="ignore"):
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    column, row = (np.where(inside, place, 0).astype(np.int64) for place in (x, y))
    return np.where(inside, values[row, column].astype(np.float64), np.nan)

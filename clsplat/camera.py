# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera: COLMAP's axes (x right, y down, z forward), pixel centres at +0.5."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera and its pose.

    width, height: image size in pixels; fx, fy, cx, cy: intrinsics in pixels, the principal point measured
    from the image's top left corner, so that the centre of the first pixel is (0.5, 0.5);
    rotation (3, 3), translation (3,): `cam_from_world`, x_cam = rotation @ x_world + translation.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rotation: Float64
    translation: Float64
    near: float = 0.01

    @property
    def position(self) -> Float64:
        """The camera's centre in the world, (3,)."""
        centre: Float64 = -self.rotation.T @ self.translation
        return centre

    def from_origin(self, origin: Float64) -> Camera:
        """The same view, for coordinates of the world that are counted from origin (3,)."""
        if not origin.any():
            return self
        return replace(self, translation=self.translation + self.rotation @ origin)

    def resized(self, width: int, height: int) -> Camera:
        """The same view on another pixel grid: pixel centres at +0.5 make this a pure scaling."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

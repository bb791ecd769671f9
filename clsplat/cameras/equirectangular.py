# SPDX-License-Identifier: Apache-2.0
"""The equirectangular camera: a panorama in longitude and latitude.

Equation numbers refer to docs/cameras.md.

Gaussians at the poles and the seam: `kernels/project_rays.cl`, `kernels/shared/tile.h`.
"""

from __future__ import annotations

import math

import numpy as np

from clsplat.arrays import Float64
from clsplat.cameras.model import CameraModel, Intrinsics


class Equirectangular(CameraModel):
    """A panorama in longitude and latitude, eqs. (5), (6). Kernels: kernels/shared/camera/equirectangular.h."""

    flat = False
    wraps = True

    def wide_focal(self, width: int) -> float:
        return width / (2 * np.pi)

    def whole(self, width: int, height: int) -> tuple[float, float, float, float]:
        return width / math.tau, height / math.pi, width / 2, height / 2

    def is_whole(self, view: Intrinsics) -> bool:
        whole = (view.fx * 2 * np.pi, view.fy * np.pi, 2 * view.cx, 2 * view.cy)
        return bool(np.allclose(whole, (view.width, view.height) * 2, rtol=1e-9))

    def ndc_from_cam(self, view: Intrinsics, width: int, height: int) -> Float64 | None:  # noqa: ARG002
        return None

    def rays_of(self, view: Intrinsics, a: Float64, b: Float64) -> tuple[Float64, Float64]:  # noqa: ARG002
        directions = np.stack([np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a)], axis=1)
        directions[np.abs(b) > np.pi / 2] = np.nan
        return np.zeros((len(a), 3)), directions

    def places_of(self, view: Intrinsics, points: Float64) -> tuple[Float64, Float64, Float64]:  # noqa: ARG002
        x, y, z = points.T
        level = np.hypot(x, z)
        depths = np.hypot(level, y)
        return np.where(depths > 0, np.arctan2(x, z), np.nan), np.arctan2(y, level), depths

    def pixel_widths(self, view: Intrinsics, points: Float64) -> Float64:
        depths = np.linalg.norm(points, axis=1)
        return np.where(depths > view.near, depths / max(view.fx, view.fy), np.inf)

    def footprints(self, view: Intrinsics, directions: Float64) -> tuple[Float64, Float64, Float64]:
        x, y, z = directions.T
        zero = np.zeros_like(x)
        pixels = np.zeros((len(x), 2, 2))
        level = np.hypot(x, z)
        safe = np.where(level > 0, level, 1.0)
        s, c = np.where(level > 0, x / safe, 0.0), np.where(level > 0, z / safe, 1.0)
        right, down = np.stack([c, zero, -s], axis=1), np.stack([-y * s, level, -y * c], axis=1)
        pixels[:, 0, 0] = np.maximum(level, 0.5 / view.fy) / view.fx
        pixels[:, 1, 1] = 1 / view.fy
        return right, down, pixels

    def low_pass_grad(self, view: Intrinsics, directions: Float64, gradients: Float64, low_pass: float) -> Float64:
        x, y, z = directions.T
        g11, g12 = gradients[:, 0, 0], gradients[:, 0, 1]
        result = np.zeros((len(directions), 2))
        level = np.hypot(x, z)
        free = level > 0.5 / view.fy
        across = np.where(free, level, 0.5 / view.fy) / view.fx
        around = y / np.where(level > 0, level, np.inf)
        result[:, 0] = 2 * low_pass * g12 * around * (across**2 - view.fy**-2)
        result[:, 1] = -2 * low_pass * g11 * np.where(free, across * y / view.fx, 0.0)
        return result

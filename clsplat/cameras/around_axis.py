# SPDX-License-Identifier: Apache-2.0
"""Base class of camera models that are symmetric around the axis: fisheyes, and perspective along rays.

Equation numbers refer to docs/cameras.md.
"""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64
from clsplat.cameras.model import CameraModel, Intrinsics


class AroundAxis(CameraModel):
    """A camera model whose image radius depends only on the angle from the axis. Subclasses add `angles_of_pixel`."""

    def angles_of_pixel(self, view: Intrinsics, theta: Float64) -> tuple[Float64, Float64, Float64, Float64]:
        """Return p, q and their derivatives with respect to theta, each (N,): eqs. (10) and (27).

        fx pixels cover p radians in the direction away from the axis, and q radians around the axis.

        theta: (N,), angle from the axis in radians.
        """
        raise NotImplementedError(self.projection)

    def footprints(self, view: Intrinsics, directions: Float64) -> tuple[Float64, Float64, Float64]:
        x, y, z = directions.T
        zero = np.zeros_like(x)
        pixels = np.zeros((len(x), 2, 2))
        across = np.hypot(x, y)
        safe = np.where(across > 0, across, 1.0)
        c, s = np.where(across > 0, x / safe, 1.0), np.where(across > 0, y / safe, 0.0)
        right, down = np.stack([z * c, z * s, -across], axis=1), np.stack([-s, c, zero], axis=1)
        along, around, _, _ = self.angles_of_pixel(view, np.arctan2(across, z))
        pixels[:, 0, 0], pixels[:, 0, 1] = c * along / view.fx, s * along / view.fy
        pixels[:, 1, 0], pixels[:, 1, 1] = -s * around / view.fx, c * around / view.fy
        return right, down, pixels

    def low_pass_grad(self, view: Intrinsics, directions: Float64, gradients: Float64, low_pass: float) -> Float64:
        x, y, z = directions.T
        g11, g12, g22 = gradients[:, 0, 0], gradients[:, 0, 1], gradients[:, 1, 1]
        result = np.zeros((len(directions), 2))
        r = np.hypot(x, y)
        safe = np.where(r > 0, r, 1.0)
        c, s = np.where(r > 0, x / safe, 1.0), np.where(r > 0, y / safe, 0.0)
        theta = np.arctan2(r, z)
        p, q, dp, dq = self.angles_of_pixel(view, theta)
        wide, more = view.fx**-2, view.fy**-2 - view.fx**-2
        result[:, 0] = g11 * 2 * p * dp * (wide + s * s * more)
        result[:, 0] += 2 * g12 * (dp * q + p * dq) * c * s * more
        result[:, 0] += g22 * 2 * q * dq * (wide + c * c * more)
        by_angle = g11 * 2 * c * s * more * (p * p - p * q * z)
        by_angle += (
            2
            * g12
            * (p * q * (c * c - s * s) * more + z * ((p * p - q * q) * wide + more * (p * p * s * s - q * q * c * c)))
        )
        by_angle -= g22 * 2 * c * s * more * (q * q - p * q * z)
        result[:, 1] = np.where(r > 1e-6, by_angle / safe, 0.0)
        return low_pass * result

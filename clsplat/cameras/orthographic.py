# SPDX-License-Identifier: Apache-2.0
"""The orthographic camera, whose rays are parallel.

Equation numbers refer to docs/cameras.md.
"""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64
from clsplat.cameras.model import CameraModel, Intrinsics, PlaneProjection


class Orthographic(CameraModel):
    """The orthographic camera, eqs. (3), (15) to (17). Kernels: kernels/shared/camera/orthographic.h."""

    parallel = True
    focal_keys = ("pixel_size",)

    def ndc_from_cam(self, view: Intrinsics, width: int, height: int) -> Float64 | None:
        projection = np.zeros((4, 4))
        projection[0, 0] = view.fx / width
        projection[1, 1] = -view.fy / height
        along = 1 / (view.far - view.near) if np.isfinite(view.far) else 1.0
        projection[2, 2] = along
        projection[3] = [view.cx / width, view.cy / height, -along * view.near, 1.0]
        return projection

    def rays_of(self, view: Intrinsics, a: Float64, b: Float64) -> tuple[Float64, Float64]:  # noqa: ARG002
        zero = np.zeros_like(a)
        return np.stack([a, b, zero], axis=1), np.stack([zero, zero, np.ones_like(a)], axis=1)

    def places_of(self, view: Intrinsics, points: Float64) -> tuple[Float64, Float64, Float64]:  # noqa: ARG002
        x, y, z = points.T
        return np.where(z > 0, x, np.nan), np.where(z > 0, y, np.nan), z

    def divisors(self, z: Float64) -> Float64:
        return np.ones_like(z)

    def projected(self, view: Intrinsics, points: Float64) -> PlaneProjection:
        jacobian = np.zeros((len(points), 2, 3), points.dtype)
        jacobian[:, 0, 0] = view.fx
        jacobian[:, 1, 1] = view.fy
        return PlaneProjection(np.zeros((len(points), 2)), np.ones((len(points), 2), np.bool_), jacobian)

    def mean_grad(
        self,
        view: Intrinsics,
        points: Float64,
        plane: PlaneProjection,  # noqa: ARG002
        d_jacobian: Float64,  # noqa: ARG002
        d_means2d: Float64,
    ) -> Float64:
        """Return the gradient (N, 3) with respect to the points: eq. (20). The Jacobian is constant."""
        return np.concatenate([d_means2d * [view.fx, view.fy], np.zeros((len(points), 1))], axis=1)

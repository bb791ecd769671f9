# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera, with Gaussians on its image plane or along its rays.

Equation numbers refer to docs/cameras.md.
"""

from __future__ import annotations

import math

import numpy as np

from clsplat.arrays import Float64
from clsplat.cameras.around_axis import AroundAxis
from clsplat.cameras.model import CameraModel, Intrinsics, PlaneProjection


class Perspective(CameraModel):
    """The pinhole camera, eq. (2). Kernels: kernels/shared/camera/perspective.h."""

    is_pinhole = True

    def focal_length(self, fov: float, size: float) -> float:
        if not 0 < fov < math.pi:
            raise ValueError(f"angle of view is {math.degrees(fov):g} degrees, expected more than 0 and less than 180")
        return 0.5 * size / math.tan(0.5 * fov)

    def ndc_from_cam(self, view: Intrinsics, width: int, height: int) -> Float64 | None:
        projection = np.zeros((4, 4))  # the homogeneous coordinate w is z
        projection[0, 0] = view.fx / width
        projection[1, 1] = -view.fy / height
        projection[2] = [view.cx / width, view.cy / height, 1.0, 1.0]
        projection[3, 2] = -view.near
        return projection

    def rays_of(self, view: Intrinsics, a: Float64, b: Float64) -> tuple[Float64, Float64]:  # noqa: ARG002
        directions = np.stack([a, b, np.ones_like(a)], axis=1)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return np.zeros((len(a), 3)), directions

    def places_of(self, view: Intrinsics, points: Float64) -> tuple[Float64, Float64, Float64]:  # noqa: ARG002
        x, y, z = points.T
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(z > 0, x / z, np.nan), np.where(z > 0, y / z, np.nan), z

    def divisors(self, z: Float64) -> Float64:
        return z

    def projected(self, view: Intrinsics, points: Float64) -> PlaneProjection:
        """Return the linearised projection, with clamped ratios: eqs. (3), (4) of docs/gradients.md."""
        z = points[:, 2]
        raw = points[:, :2] / z[:, None]
        low, high = view.frustum_limits
        ratios, unclamped = np.clip(raw, low, high), (raw > low) & (raw < high)
        jacobian = np.zeros((len(points), 2, 3), points.dtype)
        jacobian[:, 0, 0] = view.fx / z
        jacobian[:, 1, 1] = view.fy / z
        jacobian[:, 0, 2] = -view.fx * ratios[:, 0] / z
        jacobian[:, 1, 2] = -view.fy * ratios[:, 1] / z
        return PlaneProjection(ratios, unclamped, jacobian)

    def mean_grad(
        self, view: Intrinsics, points: Float64, plane: PlaneProjection, d_jacobian: Float64, d_means2d: Float64
    ) -> Float64:
        """Return the gradient (N, 3) with respect to the points: eqs. (36), (37) of docs/gradients.md."""
        x, y, z = points.T
        # Equation (36): gradient with respect to z and the ratios, through the Jacobian. A clamped ratio is constant.
        d00, d02, d11, d12 = d_jacobian[:, 0, 0], d_jacobian[:, 0, 2], d_jacobian[:, 1, 1], d_jacobian[:, 1, 2]
        d_z = (-view.fx * d00 + view.fx * plane.ratios[:, 0] * d02) / z**2
        d_z += (-view.fy * d11 + view.fy * plane.ratios[:, 1] * d12) / z**2
        d_ratio_x = np.where(plane.unclamped[:, 0], -view.fx * d02 / z, 0.0)
        d_ratio_y = np.where(plane.unclamped[:, 1], -view.fy * d12 / z, 0.0)
        # Equation (37): gradient through the mean on the image, which is not clamped.
        d_ratio_x = d_ratio_x + view.fx * d_means2d[:, 0]
        d_ratio_y = d_ratio_y + view.fy * d_means2d[:, 1]
        d_z -= (d_ratio_x * x + d_ratio_y * y) / z**2
        return np.stack([d_ratio_x / z, d_ratio_y / z, d_z], axis=1)


class PerspectiveByRays(AroundAxis, Perspective):
    """A pinhole camera that draws Gaussians along rays, as a fisheye does: eqs. (30), (31).

    Kernels: perspective_rays.h.
    """

    def angles_of_pixel(
        self,
        view: Intrinsics,  # noqa: ARG002
        theta: Float64,
    ) -> tuple[Float64, Float64, Float64, Float64]:
        sine, cosine = np.sin(theta), np.cos(theta)
        return cosine**2, cosine, -2 * sine * cosine, -sine

# SPDX-License-Identifier: Apache-2.0
"""Fisheye cameras: equidistant, and with distortion coefficients.

Equation numbers refer to docs/cameras.md.

The inverse of the distortion in kernels: `kernels/shared/camera/bent_fisheye.h`.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from clsplat.arrays import Bool, Float64
from clsplat.cameras.around_axis import AroundAxis
from clsplat.cameras.model import Intrinsics

MIN_FISHEYE_SLOPE = 0.1
"""Smallest derivative of a fisheye's image radius with respect to the angle, relative to the derivative on the axis.
Where it is smaller, the picture counts as folded over and stays empty. Where it is larger, float32 suffices to compute
a pixel's angle."""


def radii(view: Intrinsics, theta: Float64) -> tuple[Float64, Float64, Float64]:
    """Return image radii, in focal lengths, of rays at angles `theta` from a fisheye's axis: eq. (18).

    Also returns their first and second derivatives with respect to theta. Arrays are (N,), angles in radians.
    """
    powers, factors = 2 * np.arange(5), np.array([1.0, *view.radial])
    series = theta[:, None] ** powers
    radius, slope = theta * (series @ factors), series @ (factors * (powers + 1))
    bend = theta * (series[:, :4] @ (factors * (powers + 1) * powers)[1:])
    return radius, slope, bend


class Fisheye(AroundAxis):
    """An equidistant fisheye, eq. (4). Kernels: kernels/shared/camera/fisheye.h."""

    flat = False

    def angles(self, view: Intrinsics, radius: Float64) -> Float64:  # noqa: ARG002
        """Return angles (N,) from the axis, in radians, of pixels at image radii `radius` (N,), in focal lengths."""
        return radius

    def ndc_from_cam(self, view: Intrinsics, width: int, height: int) -> Float64 | None:  # noqa: ARG002
        return None

    def rays_of(self, view: Intrinsics, a: Float64, b: Float64) -> tuple[Float64, Float64]:
        radius = np.hypot(a, b)
        theta = self.angles(view, radius)
        # sin(theta) / radius, and 1 on the axis; np.sinc(x) is sin(pi x) / (pi x)
        ratio = np.sinc(theta / np.pi) * np.where(radius > 0, theta / np.where(radius > 0, radius, 1.0), 1.0)
        directions = np.stack([ratio * a, ratio * b, np.cos(theta)], axis=1)
        directions[radius > view.fold[1]] = np.nan
        return np.zeros((len(a), 3)), directions

    def places_of(self, view: Intrinsics, points: Float64) -> tuple[Float64, Float64, Float64]:
        x, y, z = points.T
        across = np.hypot(x, y)
        theta = np.arctan2(across, z)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(across > 0, radii(view, theta)[0] / across, np.where(z > 0, 0.0, np.nan))
        ratio = np.where(self.shows(view, points), ratio, np.nan)
        return ratio * x, ratio * y, np.hypot(across, z)

    def pixel_widths(self, view: Intrinsics, points: Float64) -> Float64:
        depths, focal, (low, high) = np.linalg.norm(points, axis=1), max(view.fx, view.fy), view.frustum_limits
        across = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(across, points[:, 2])
        along, around, _, _ = self.angles_of_pixel(view, theta)
        places = radii(view, theta)[0][:, None] * points[:, :2] / np.where(across > 0, across, 1.0)[:, None]
        seen = (depths > view.near) & (theta < view.fold[0]) & ((places > low) & (places < high)).all(axis=1)
        return np.where(seen, depths / focal * np.minimum(along, around), np.inf)

    def angles_of_pixel(self, view: Intrinsics, theta: Float64) -> tuple[Float64, Float64, Float64, Float64]:
        """Return p, q and their derivatives with respect to theta, each (N,): eqs. (10), (19).

        fx pixels cover p radians in the direction away from the axis, and q radians around the axis.
        """
        radius, slope, bend = radii(view, theta)
        with np.errstate(all="ignore"):
            ratio = np.where(theta > 1e-6, np.sin(theta) / radius, 1.0)
            least = 0.5 / (np.pi * view.fx)
            near_axis = -theta * (1 / 3 + 2 * view.radial[0])
            d_around = np.where(theta > 1e-4, (np.cos(theta) - ratio * slope) / radius, near_axis)
        return 1 / slope, np.maximum(ratio, least), -bend / slope**2, np.where(ratio > least, d_around, 0.0)


class BentFisheye(Fisheye):
    """A fisheye with coefficients (Kannala and Brandt), eqs. (18), (19). Kernels: fisheye.h with bent_fisheye.h."""

    self_tested = False  # the self-test covers Fisheye, whose kernels and footprints are the same
    without_motion = "a fisheye with coefficients, expected a fisheye without them or a pinhole camera"

    def fold(self, radial: tuple[float, float, float, float]) -> tuple[float, float]:
        return _fold(tuple(radial))

    def angles(self, view: Intrinsics, radius: Float64) -> Float64:
        """Return angles (N,) from the axis, in radians, of pixels at image radii `radius` (N,), in focal lengths.

        This is the inverse of `radii`, computed by bisection.
        """
        low, high = np.zeros_like(radius), np.full_like(radius, view.fold[0])
        for _ in range(50):
            middle = 0.5 * (low + high)
            over = radii(view, middle)[0] > radius
            low, high = np.where(over, low, middle), np.where(over, middle, high)
        return 0.5 * (low + high)

    def shows(self, view: Intrinsics, points: Float64) -> Bool:
        """Return a mask of the points whose angle from the axis is less than the largest that the fisheye shows."""
        return np.asarray(np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2]) < view.fold[0])


@lru_cache(maxsize=64)
def _fold(radial: tuple[float, ...]) -> tuple[float, float]:
    powers = 2 * np.arange(5)
    factors = np.array([1.0, *radial])
    angles = np.linspace(0.0, math.pi, 4097)
    folded = (((1 + powers) * factors) @ angles ** powers[:, None]) < MIN_FISHEYE_SLOPE
    angle = float(angles[np.argmax(folded) - 1]) if folded.any() else math.pi
    return angle, float(angle * (factors @ angle**powers))

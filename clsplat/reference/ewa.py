# SPDX-License-Identifier: Apache-2.0
"""EWA projection with gsplat's conventions, and its gradient: float64 twin of kernels/ewa.cl and kernels/ewa_grad.cl.

Equation numbers refer to docs/gradients.md. In gradients, the upper twelve entries of the view matrix are independent
variables, which need not be a rotation and a translation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.reference.project import ALPHA_MIN

BOX_STANDARD_DEVIATIONS = 3.33
"""Half size of a Gaussian's box in standard deviations, unless its opacity makes the box smaller."""
TWIN_EWA_CLAMP_FRACTION = 0.15
"""Distance beyond the image's edges at which means are clamped in the Jacobian, as a fraction of the image's side.

`stages.ewa` has its own copy: a twin shares no constant of a formula with the code that it checks."""
SERIES_TANGENT_SQUARED = 1e-3
"""Below this (r / z)^2 a fisheye's formulas are computed as series, because their differences would cancel."""


@dataclass(frozen=True, eq=False)
class EwaViewTwin:
    """A camera of the EWA projection.

    viewmat: (4, 4), camera from world.
    intrinsics: (3, 3); skew is ignored.
    model: pinhole, ortho or fisheye.
    near, far: world units; Gaussians whose depth is not strictly between these are culled.
    eps2d: px^2, added to the diagonal of the projected covariance.
    radius_clip: pixels; Gaussians with this radius or a smaller one are culled.
    """

    viewmat: Float64
    intrinsics: Float64
    width: int
    height: int
    model: str = "pinhole"
    near: float = 0.01
    far: float = 1e10
    eps2d: float = 0.3
    radius_clip: float = 0.0

    @property
    def focal(self) -> Float64:
        """Focal lengths fx and fy in pixels, (2,)."""
        return self.intrinsics[[0, 1], [0, 1]]

    @property
    def centre(self) -> Float64:
        """Principal point cx and cy in pixels, (2,)."""
        return self.intrinsics[:2, 2]


@dataclass(frozen=True, eq=False)
class EwaProjectedTwin:
    """Projected Gaussians. Culled Gaussians have radii of 0; their other values are not set to 0.

    radii: (N, 2) int32, half sides of the bounding box in pixels, 0 where culled.
    means2d: (N, 2), pixels.
    depths: (N,).
    conics: (N, 3), a, b, c of the inverse covariance.
    compensations: (N,), factors of the opacities that make up for the low-pass.
    points: (N, 3), the means in the camera's axes.
    jacobians: (N, 2, 3), of the projection.
    clamped: (N, 2), True where x/z or y/z is clamped in the Jacobian.
    covariances: (N, 2, 2), on the image, with the low-pass.
    determinants: (N,), of the covariances without the low-pass.
    """

    radii: NDArray[np.int32]
    means2d: Float64
    depths: Float64
    conics: Float64
    compensations: Float64
    points: Float64
    jacobians: Float64
    clamped: NDArray[np.bool_]
    covariances: Float64
    determinants: Float64

    @property
    def visible(self) -> NDArray[np.bool_]:
        """Mask (N,) of the Gaussians that are not culled."""
        return self.radii[:, 0] > 0


def rotations_of(quaternions: Float64) -> Float64:
    """Return rotation matrices (N, 3, 3) of quaternions (N, 4), w x y z, of any nonzero length."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows).transpose(2, 0, 1)


def covariances_of(quaternions: Float64, scales: Float64) -> Float64:
    """Return covariances R S S^T R^T (N, 3, 3) of quaternions (N, 4) and scales (N, 3)."""
    m = rotations_of(quaternions) * scales[:, None, :]
    return m @ m.transpose(0, 2, 1)


def covariances_grad(quaternions: Float64, scales: Float64, gradients: Float64) -> tuple[Float64, Float64]:
    """Return gradients with respect to quaternions (N, 4) and scales (N, 3).

    gradients: (N, 3, 3), symmetric, with respect to the covariances.
    """
    rotations = rotations_of(quaternions)
    d_m = 2 * gradients @ (rotations * scales[:, None, :])
    d_scales = (rotations * d_m).sum(axis=1)
    d_r = d_m * scales[:, None, :]
    length = np.linalg.norm(quaternions, axis=1, keepdims=True)
    unit = quaternions / length
    w, x, y, z = unit.T
    r = d_r.transpose(1, 2, 0)
    d_unit = 2 * np.stack(
        [
            x * (r[2, 1] - r[1, 2]) + y * (r[0, 2] - r[2, 0]) + z * (r[1, 0] - r[0, 1]),
            w * (r[2, 1] - r[1, 2]) + y * (r[0, 1] + r[1, 0]) + z * (r[0, 2] + r[2, 0]) - 2 * x * (r[1, 1] + r[2, 2]),
            w * (r[0, 2] - r[2, 0]) + x * (r[0, 1] + r[1, 0]) + z * (r[1, 2] + r[2, 1]) - 2 * y * (r[0, 0] + r[2, 2]),
            w * (r[1, 0] - r[0, 1]) + x * (r[0, 2] + r[2, 0]) + y * (r[1, 2] + r[2, 1]) - 2 * z * (r[0, 0] + r[1, 1]),
        ],
        axis=1,
    )
    return (d_unit - unit * (unit * d_unit).sum(axis=1, keepdims=True)) / length, d_scales


def full_covariances(upper: Float64) -> Float64:
    """Return symmetric matrices (N, 3, 3) from upper triangles (N, 6): xx, xy, xz, yy, yz, zz."""
    full: Float64 = upper[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    return full


def upper_gradients(full: Float64) -> Float64:
    """Return gradients (N, 6) with respect to upper triangles, whose off-diagonal entries stand for two entries each.

    full: (N, 3, 3), the symmetric gradients with respect to full matrices.
    """
    return np.asarray(full.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]] * np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0]), np.float64)


def _fisheye(points: Float64) -> tuple[Float64, Float64, Float64]:
    """Return s = theta / r, h = (ds/dr) / r and (dh/dr) / r at points (N, 3) in the camera's axes.

    Here r is the distance from the axis and theta the angle from it: eqs. (157), (158).
    """
    x, y, z = points.T
    q = x * x + y * y
    r, d = np.sqrt(q), q + z * z
    with np.errstate(divide="ignore", invalid="ignore"):
        t = q / (z * z)
        s = np.arctan2(r, z) / r
        h = (z / d - s) / q
        bend = (-2 * z / (d * d) - 3 * h) / q
        near = (t < SERIES_TANGENT_SQUARED) & (z > 0)
        k = np.arange(8)
        powers = t[:, None] ** k
        signs = (-1.0) ** k
        s = np.where(near, (powers * signs / (2 * k + 1)).sum(axis=1) / z, s)
        h = np.where(near, -(powers * signs * 2 * (k + 1) / (2 * k + 3)).sum(axis=1) / z**3, h)
        bend = np.where(near, (powers * signs * 4 * (k + 2) * (k + 1) / (2 * k + 5)).sum(axis=1) / z**5, bend)
    return s, h, bend


def project(
    means: Float64, covariances: Float64, view: EwaViewTwin, opacities: Float64 | None = None
) -> EwaProjectedTwin:
    """Project means (N, 3) and covariances (N, 3, 3): equations (150) to (156).

    opacities: (N,), 0 to 1, after compensation if the caller compensates. With them boxes end where alpha is 1/255.
    """
    rotation, translation = view.viewmat[:3, :3], view.viewmat[:3, 3]
    fx, fy = view.focal
    points = means @ rotation.T + translation
    x, y, z = points.T
    zero = np.zeros_like(x)
    clamped = np.zeros((len(means), 2), bool)
    with np.errstate(all="ignore"):
        if view.model == "ortho":
            means2d = points[:, :2] * view.focal + view.centre
            rows = [[zero + fx, zero, zero], [zero, zero + fy, zero]]
        elif view.model == "fisheye":
            s, h, _ = _fisheye(points)
            d = (points * points).sum(axis=1)
            means2d = points[:, :2] * s[:, None] * view.focal + view.centre
            rows = [
                [fx * (s + x * x * h), fx * x * y * h, -fx * x / d],
                [fy * x * y * h, fy * (s + y * y * h), -fy * y / d],
            ]
        else:
            ratios = points[:, :2] / z[:, None]
            means2d = ratios * view.focal + view.centre
            size = np.array([view.width, view.height])
            low = -(view.centre + TWIN_EWA_CLAMP_FRACTION * size) / view.focal
            high = ((1 + TWIN_EWA_CLAMP_FRACTION) * size - view.centre) / view.focal
            limited = np.clip(ratios, low, high)
            clamped = limited != ratios
            rx, ry = limited.T
            rows = [[fx / z, zero, -fx / z * rx], [zero, fy / z, -fy / z * ry]]
        jacobians = np.array(rows).transpose(2, 0, 1)
        t = jacobians @ rotation
        raw = t @ covariances @ t.transpose(0, 2, 1)
        det0 = raw[:, 0, 0] * raw[:, 1, 1] - raw[:, 0, 1] * raw[:, 1, 0]
        filtered = raw + view.eps2d * np.eye(2)
        det = filtered[:, 0, 0] * filtered[:, 1, 1] - filtered[:, 0, 1] * filtered[:, 1, 0]
        conics = np.stack([filtered[:, 1, 1], -filtered[:, 0, 1], filtered[:, 0, 0]], axis=1) / det[:, None]
        compensations = np.sqrt(np.maximum(det0 / det, 0.0))
        extend: Float64 | float = BOX_STANDARD_DEVIATIONS
        valid = (z > view.near) & (z < view.far) & (det > 0)
        if opacities is not None:
            extend = np.minimum(BOX_STANDARD_DEVIATIONS, np.sqrt(np.maximum(2 * np.log(opacities / ALPHA_MIN), 0.0)))
            valid &= opacities >= ALPHA_MIN
        wide = np.ceil(extend * np.sqrt(filtered[:, 0, 0]))
        tall = np.ceil(extend * np.sqrt(filtered[:, 1, 1]))
        valid &= (means2d[:, 0] + wide > 0) & (means2d[:, 0] - wide < view.width)
        valid &= (means2d[:, 1] + tall > 0) & (means2d[:, 1] - tall < view.height)
        valid &= (wide > view.radius_clip) | (tall > view.radius_clip)
        radii = np.where(valid[:, None], np.stack([wide, tall], axis=1), 0.0).astype(np.int32)
    return EwaProjectedTwin(radii, means2d, z.copy(), conics, compensations, points, jacobians, clamped, filtered, det0)


def _fisheye_grad(view: EwaViewTwin, points: Float64, d_means2d: Float64, d_j: Float64) -> tuple[Float64, Float64]:
    """Return a fisheye's gradients with respect to points (N, 3) in the camera's axes and to focal lengths (2,).

    The gradient with respect to focal lengths is only the part through the means on the image, without the part through
    the Jacobians.

    d_means2d: (N, 2), the gradient with respect to the means on the image.
    d_j: (N, 2, 3), the gradient with respect to the Jacobians.
    """
    x, y, z = points.T
    fx, fy = view.focal
    s, h, bend = _fisheye(points)
    d = (points * points).sum(axis=1)
    g2 = d_means2d * view.focal
    v0, v1, v2 = (fx * d_j[:, 0]).T
    w0, w1, w2 = (fy * d_j[:, 1]).T
    by_s = v0 + w1 + x * g2[:, 0] + y * g2[:, 1]
    by_h = v0 * x * x + (v1 + w0) * x * y + w1 * y * y
    by_d = (v2 * x + w2 * y) / (d * d)
    d_p = np.zeros_like(points)
    d_p[:, 0] = s * g2[:, 0] + 2 * x * h * v0 + y * h * (v1 + w0) - v2 / d + x * (by_s * h + by_h * bend + 2 * by_d)
    d_p[:, 1] = s * g2[:, 1] + 2 * y * h * w1 + x * h * (v1 + w0) - w2 / d + y * (by_s * h + by_h * bend + 2 * by_d)
    d_p[:, 2] = -by_s / d + 2 * by_h / (d * d) + 2 * z * by_d
    return d_p, (points[:, :2] * s[:, None] * d_means2d).sum(axis=0)


def _pinhole_grad(
    view: EwaViewTwin,
    points: Float64,
    jacobians: Float64,
    clamped: NDArray[np.bool_],
    d_means2d: Float64,
    d_j: Float64,
) -> tuple[Float64, Float64, Float64]:
    """Return a pinhole camera's gradients with respect to points (N, 3), focal lengths (2,) and principal point (2,).

    The gradient with respect to the principal point is only the part through means that are clamped in the Jacobian,
    with the sign reversed.

    points, jacobians, clamped: rows of these arrays of `EwaProjectedTwin`.
    d_means2d, d_j: gradients (N, 2) and (N, 2, 3) with respect to the means on the image and the Jacobians.
    """
    z = points[:, 2]
    jx, jy = jacobians[:, 0, 0], jacobians[:, 1, 1]
    ratios = points[:, :2] / z[:, None]
    limited = -np.stack([jacobians[:, 0, 2] / jx, jacobians[:, 1, 2] / jy], axis=1)
    d_limited = -np.stack([jx * d_j[:, 0, 2], jy * d_j[:, 1, 2]], axis=1)
    d_ratios = d_means2d * view.focal + np.where(clamped, 0.0, d_limited)
    d_p = np.zeros_like(points)
    d_p[:, :2] = d_ratios / z[:, None]
    d_p[:, 2] = -(d_ratios * ratios).sum(axis=1) / z - (d_j * jacobians).sum(axis=(1, 2)) / z
    beyond = np.where(clamped, d_limited, 0.0)
    by_focal = (ratios * d_means2d).sum(axis=0) - (beyond * limited).sum(axis=0) / view.focal
    return d_p, by_focal, beyond.sum(axis=0) / view.focal


def project_grad(
    means: Float64,
    covariances: Float64,
    view: EwaViewTwin,
    projected: EwaProjectedTwin,
    gradients: Mapping[str, Float64],
) -> dict[str, Float64]:
    """Return gradients with respect to means, covariances, viewmat and intrinsics, by name: eqs. (159) to (166).

    Each has its argument's shape. The gradient of the covariances is symmetric. Culled Gaussians have zero gradients.

    gradients: gradients with respect to means2d, depths, conics and compensations, by name; each is optional.
    """
    seen = projected.visible
    p, j = projected.points[seen], projected.jacobians[seen]
    count = len(p)

    def given(name: str, *width: int) -> Float64:
        return np.asarray(gradients[name], np.float64)[seen] if name in gradients else np.zeros((count, *width))

    d_means2d, d_depths, d_conics = given("means2d", 2), given("depths"), given("conics", 3)
    d_compensations = given("compensations")
    a, b, c = projected.conics[seen].T
    conic = np.array([[a, b], [b, c]]).transpose(2, 0, 1)
    g = np.array([[d_conics[:, 0], d_conics[:, 1] / 2], [d_conics[:, 1] / 2, d_conics[:, 2]]]).transpose(2, 0, 1)
    v = -conic @ g @ conic
    if d_compensations.any():
        half = 0.5 * d_compensations * projected.compensations[seen]
        raw = projected.covariances[seen] - view.eps2d * np.eye(2)
        v += half[:, None, None] * (np.linalg.inv(raw) - conic)
    rotation = view.viewmat[:3, :3]
    sigma = covariances[seen]
    t = j @ rotation
    d_t = 2 * v @ t @ sigma
    d_j = d_t @ rotation.T
    d_rotation = np.einsum("nai,naj->ij", j, d_t)

    d_intrinsics = np.zeros((3, 3))
    d_intrinsics[:2, 2] = d_means2d.sum(axis=0)
    d_focal = (d_j * j).sum(axis=(0, 2)) / view.focal
    if view.model == "ortho":
        d_p = np.concatenate([d_means2d * view.focal, np.zeros((count, 1))], axis=1)
        d_focal += (p[:, :2] * d_means2d).sum(axis=0)
    elif view.model == "fisheye":
        d_p, by_focal = _fisheye_grad(view, p, d_means2d, d_j)
        d_focal += by_focal
    else:
        d_p, by_focal, by_centre = _pinhole_grad(view, p, j, projected.clamped[seen], d_means2d, d_j)
        d_focal += by_focal
        d_intrinsics[:2, 2] -= by_centre
    d_p[:, 2] += d_depths
    d_intrinsics[[0, 1], [0, 1]] = d_focal
    d_viewmat = np.zeros((4, 4))
    d_viewmat[:3, :3] = d_rotation + d_p.T @ means[seen]
    d_viewmat[:3, 3] = d_p.sum(axis=0)
    d_means, d_covariances = np.zeros_like(means), np.zeros_like(covariances)
    d_means[seen] = d_p @ rotation
    d_covariances[seen] = t.transpose(0, 2, 1) @ v @ t
    return {"means": d_means, "covariances": d_covariances, "viewmat": d_viewmat, "intrinsics": d_intrinsics}

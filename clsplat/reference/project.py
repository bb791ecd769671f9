# SPDX-License-Identifier: Apache-2.0
"""Projection of Gaussians to the image plane, and its gradient: float64 twin of kernels/project*.cl.

Equation numbers are those of docs/gradients.md. The arithmetic is in the precision of the parameters: with
np.longdouble the twin's own rounding can be held against more digits.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64, Int64
from clsplat.camera import Camera, Window
from clsplat.reference.sh import sh_basis_grad
from clsplat.reference.sort import depth_order
from clsplat.spherical_harmonics import sh_basis

Bool = NDArray[np.bool_]

ALPHA_MIN = 1.0 / 255.0
LOW_PASS = 0.3
LOW_PASS_ANTIALIASED = 0.1
LEAST_COMPENSATION = 0.005
COLOUR_LIMIT = 1e9
BOX_SLACK = 0.1
"""Added to the reach q <= 2 ln(255 o) of a Gaussian's box, so that alphas down to 5 % under 1/255 are looked at
and margins up to that are true."""


@dataclass(frozen=True, eq=False)
class Footprint:
    """One Gaussian on the pixels of a box that has all that show it: dx, dy to (h, w), pixel centre minus mean, or of
    rays the same on the tangent plane; falloff (h, w) = exp(-q / 2); raw (h, w) = opacity times falloff, not yet
    clamped."""

    box: tuple[slice, slice]
    dx: Float64
    dy: Float64
    falloff: Float64
    raw: Float64


@dataclass(frozen=True, eq=False)
class Seen(ABC):
    """N Gaussians as a camera of any projection sees them. depths (N,): z in the camera, or the distance; opacities
    (N,): 0 to 1; colors (N, 3); visible (N,)."""

    depths: Float64
    opacities: Float64
    colors: Float64
    visible: Bool

    @property
    def order(self) -> Int64:
        """Rows of the visible ones, front to back."""
        return depth_order(self.depths, self.visible)

    @abstractmethod
    def footprint(self, gaussian: int, width: int, height: int) -> Footprint | None:
        """One of them on the image; None where it misses that."""

    @abstractmethod
    def conic(self, gaussian: int) -> Float64:
        """a, b, c with which q is a dx^2 + 2 b dx dy + c dy^2, of one of them."""

    def by_mean(self, gaussian: int, splat: Footprint) -> tuple[Float64, Float64]:
        """Derivatives of -q / 2 by the mean in each pixel, along the axes of dx and dy: eq. (25)."""
        a, b, c = self.conic(gaussian)
        return a * splat.dx + b * splat.dy, b * splat.dx + c * splat.dy


@dataclass(frozen=True, eq=False)
class Projected(Seen):
    """N Gaussians on the image plane; rows that are not visible are zero.

    means2d (N, 2): pixels; covariances (N, 3): sxx, sxy, syy in px^2; conics (N, 3): a, b, c of the inverse,
    q = a dx^2 + 2 b dx dy + c dy^2; whitening (N, 3): l11, l12, l22 of eq. (8); half_extents (N, 2): pixels, of
    the box in which alpha reaches 1/255; visible: passed eq. (13). A visible Gaussian may still lie wholly off the
    image.
    """

    means2d: Float64
    covariances: Float64
    conics: Float64
    whitening: Float64
    half_extents: Float64

    def conic(self, gaussian: int) -> Float64:
        found: Float64 = self.conics[gaussian]
        return found

    def footprint(self, gaussian: int, width: int, height: int) -> Footprint | None:
        """Eqs. (9), (14) on the box that alpha >= 1/255 can reach."""
        opacity = self.opacities[gaussian]
        reach = 2 * np.log(opacity / ALPHA_MIN) + BOX_SLACK
        half = np.sqrt(reach * self.covariances[gaussian, [0, 2]])
        mean = self.means2d[gaussian]
        size = np.array([width, height])
        # clipped as floats: a mean far off the image need not fit an integer
        first = np.clip(np.ceil(mean - half - 0.5), 0, size).astype(np.int64)
        stop = np.clip(np.floor(mean + half - 0.5) + 1, 0, size).astype(np.int64)
        if (first >= stop).any():
            return None
        dx = np.arange(first[0], stop[0])[None, :] + 0.5 - mean[0]
        dy = np.arange(first[1], stop[1])[:, None] + 0.5 - mean[1]
        a, b, c = self.conics[gaussian]
        falloff = np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        return Footprint((slice(first[1], stop[1]), slice(first[0], stop[0])), dx, dy, falloff, opacity * falloff)


@dataclass(frozen=True, eq=False)
class _Geometry:
    """Intermediate values that projection and its gradient share: p (N, 3) in the camera, ratios (N, 2) clamped x/z and
    y/z, unclamped (N, 2) bool, jacobian (N, 2, 3), rotations (N, 3, 3) and scales (N, 3) of the Gaussians, and half (N,
    2, 3) = M of eq. (5)."""

    p: Float64
    ratios: Float64
    unclamped: Bool
    jacobian: Float64
    rotations: Float64
    scales: Float64
    half: Float64


def rotation_matrices(quaternions: Float64) -> Float64:
    """R(q / |q|): raw quaternions (N, 4), w x y z -> (N, 3, 3). A zero quaternion gives NaN."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def frustum_limits(camera: Camera) -> Float64:
    """Lower and upper bound of x/z and y/z in the Jacobian, ((x, y), (x, y)): eq. (3)."""
    window = camera.window or Window(0, 0, camera.width, camera.height)
    size = np.array([window.width, window.height], np.float64)
    focal = np.array([camera.fx, camera.fy], np.float64)
    centre = np.array([camera.cx, camera.cy], np.float64)
    margin = window.clamp * 0.5 * size / focal
    return np.stack([-centre / focal - margin, (size - centre) / focal + margin])


def _geometry(means: Float64, quaternions: Float64, log_scales: Float64, camera: Camera) -> _Geometry:
    """Eqs. (1), (3), (4), (5); orthographic: (16) of docs/cameras.md."""
    p = means @ camera.rotation.T + camera.translation
    jacobian = np.zeros((len(p), 2, 3), p.dtype)
    if camera.projection == "orthographic":
        ratios, unclamped = np.zeros((len(p), 2)), np.zeros((len(p), 2), np.bool_)
        jacobian[:, 0, 0] = camera.fx
        jacobian[:, 1, 1] = camera.fy
    else:
        z = p[:, 2]
        raw = p[:, :2] / z[:, None]
        low, high = frustum_limits(camera)
        ratios, unclamped = np.clip(raw, low, high), (raw > low) & (raw < high)
        jacobian[:, 0, 0] = camera.fx / z
        jacobian[:, 1, 1] = camera.fy / z
        jacobian[:, 0, 2] = -camera.fx * ratios[:, 0] / z
        jacobian[:, 1, 2] = -camera.fy * ratios[:, 1] / z
    rotations = rotation_matrices(quaternions)
    scales = np.exp(log_scales)
    half = jacobian @ camera.rotation @ (rotations * scales[:, None, :])
    return _Geometry(p, ratios, unclamped, jacobian, rotations, scales, half)


def view_directions(means: Float64, camera: Camera) -> tuple[Float64, Float64]:
    """Unit vectors from the camera to the means (N, 3), and the distances (N, 1). An orthographic camera looks along
    its axis everywhere, as if from infinitely far: (17) of docs/cameras.md."""
    if camera.projection == "orthographic":
        return np.tile(camera.rotation[2], (len(means), 1)), np.full((len(means), 1), np.inf)
    offsets = means - camera.position
    distances: Float64 = np.linalg.norm(offsets, axis=1, keepdims=True)
    return offsets / distances, distances


def project(
    means: Float64,
    quaternions: Float64,
    log_scales: Float64,
    opacity_logits: Float64,
    sh: Float64,
    camera: Camera,
    sh_degree: int,
    *,
    antialiased: bool = False,
) -> Projected:
    """Eqs. (1) to (13), of an orthographic camera with (15) to (17) of docs/cameras.md: arrays as in `Gaussians`,
    float64; sh_degree is the one in use, bands above it are unread; antialiased: with (83)."""
    low_pass = LOW_PASS_ANTIALIASED if antialiased else LOW_PASS
    with np.errstate(all="ignore"):  # what overflows or divides by zero is culled below
        geometry = _geometry(means, quaternions, log_scales, camera)
        z = geometry.p[:, 2]
        focal = np.array([camera.fx, camera.fy])
        by = z[:, None] if camera.projection == "perspective" else 1.0
        means2d = focal * geometry.p[:, :2] / by + np.array([camera.cx, camera.cy])
        if camera.window is not None:
            means2d -= [camera.window.x, camera.window.y]

        m1, m2 = geometry.half[:, 0], geometry.half[:, 1]
        length1, length2 = (m1 * m1).sum(axis=1), (m2 * m2).sum(axis=1)
        sxx, sxy, syy = length1 + low_pass, (m1 * m2).sum(axis=1), length2 + low_pass
        cross = np.cross(m1, m2)
        det0 = (cross * cross).sum(axis=1)
        det = det0 + low_pass * (length1 + length2) + low_pass**2
        l11 = np.sqrt(syy / det)
        whitening = np.stack([l11, -(sxy / syy) * l11, 1 / np.sqrt(syy)], axis=1)
        conics = np.stack([syy / det, -sxy / det, sxx / det], axis=1)

        opacities = 1 / (1 + np.exp(-opacity_logits))
        if antialiased:
            opacities = opacities * compensation(det0, det)
        reach = 2 * np.log(opacities / ALPHA_MIN)
        half_extents = np.sqrt(reach[:, None] * np.stack([sxx, syy], axis=1))

        directions, _ = view_directions(means, camera)
        basis = sh_basis(directions, sh_degree)
        colors = np.maximum(0.0, 0.5 + np.einsum("nk,nkc->nc", basis, sh[:, : basis.shape[1]]))

        visible = (
            (z > max(camera.near, 0.0))
            & (z < camera.far)
            & (opacities > ALPHA_MIN)
            & (det > 0)
            & (colors < COLOUR_LIMIT).all(axis=1)
        )
        for values in (means2d, whitening, conics, half_extents, colors):
            visible &= np.isfinite(values).all(axis=1)

    def shown(values: Float64) -> Float64:
        mask = visible if values.ndim == 1 else visible[:, None]
        return np.where(mask, values, 0.0)

    return Projected(
        means2d=shown(means2d),
        covariances=shown(np.stack([sxx, sxy, syy], axis=1)),
        conics=shown(conics),
        whitening=shown(whitening),
        half_extents=shown(half_extents),
        depths=shown(z),
        opacities=shown(opacities),
        colors=shown(colors),
        visible=visible,
    )


def compensation(det0: Float64, det: Float64) -> Float64:
    """Eq. (83), of the determinants (N,) of covariances without the low-pass and with it."""
    return np.maximum(np.sqrt(det0 / det), LEAST_COMPENSATION)


def compensation_grad(plain: Float64, filtered: Float64, d_logs: Float64) -> tuple[Float64, Float64]:
    """Eq. (84): what the compensation has of dL/dSigma, (N, 2, 2), by the covariances without the low-pass and by those
    with it. d_logs (N,): dL/d(ln of the opacity)."""
    free = np.linalg.det(plain) > LEAST_COMPENSATION**2 * np.linalg.det(filtered)
    by_plain, by_filtered = np.zeros_like(plain), np.zeros_like(plain)
    half = 0.5 * d_logs[free, None, None]
    by_plain[free], by_filtered[free] = half * np.linalg.inv(plain[free]), -half * np.linalg.inv(filtered[free])
    return by_plain, by_filtered


def covariance_grad(conics: Float64, d_conics: Float64) -> Float64:
    """Eq. (30), dL/dSigma = -A G A with A the conic matrix: (N, 3), (N, 3) -> (N, 3).

    d_conics is the derivative by the three numbers a, b, c (b stands twice in the matrix). The result is xx, xy, yy
    of the symmetric matrix G with dL = sum_ij G_ij dSigma_ij, so dL/dsxy as one number is twice its xy.
    """
    a, b, c = conics.T
    matrix = np.stack([np.stack([a, b], axis=1), np.stack([b, c], axis=1)], axis=1)
    d_a, d_b, d_c = d_conics.T
    gradient = np.stack([np.stack([d_a, d_b / 2], axis=1), np.stack([d_b / 2, d_c], axis=1)], axis=1)
    result = -matrix @ gradient @ matrix
    return np.stack([result[:, 0, 0], result[:, 0, 1], result[:, 1, 1]], axis=1)


def quaternion_grad(quaternions: Float64, d_rotations: Float64) -> Float64:
    """Eqs. (34), (35): raw quaternions (N, 4), dL/dR (N, 3, 3) -> dL/dq (N, 4), orthogonal to q."""
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    unit = quaternions / norms
    w, x, y, z = unit.T
    g = d_rotations.transpose(1, 2, 0)
    d_unit = 2 * np.stack(
        [
            x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]),
            w * (g[2, 1] - g[1, 2]) + y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) - 2 * x * (g[1, 1] + g[2, 2]),
            w * (g[0, 2] - g[2, 0]) + x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) - 2 * y * (g[0, 0] + g[2, 2]),
            w * (g[1, 0] - g[0, 1]) + x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) - 2 * z * (g[0, 0] + g[1, 1]),
        ],
        axis=1,
    )
    gradient: Float64 = (d_unit - unit * (unit * d_unit).sum(axis=1, keepdims=True)) / norms
    return gradient


def colour_grad(
    means: Float64, sh: Float64, camera: Camera, sh_degree: int, colors: Float64, d_colors: Float64
) -> tuple[Float64, Float64, Float64]:
    """Eqs. (38) to (40): the basis (N, K), the gradient by the colour before its clamp (N, 3), and by the mean through
    the direction it is seen in (N, 3)."""
    directions, distances = view_directions(means, camera)
    basis = sh_basis(directions, sh_degree)
    d_value = np.where(colors > 0, d_colors, 0.0)  # (39)
    of_direction = sh_basis_grad(directions, sh_degree)
    d_directions = np.einsum("nkd,nkc,nc->nd", of_direction, sh[:, : basis.shape[1]], d_value)
    radial = (directions * d_directions).sum(axis=1, keepdims=True)
    return basis, d_value, (d_directions - directions * radial) / distances  # (38), (40)


def _jacobian_grad(
    geometry: _Geometry, camera: Camera, d_covariances: Float64, by_log_opacity: Float64 | None
) -> tuple[Float64, Float64, Float64]:
    """Eqs. (31), (32): dL/dM (N, 2, 3), the Gaussians' R S (N, 3, 3), dL/dJ (N, 2, 3). by_log_opacity (N,): where
    opacities are compensated."""
    gxx, gxy, gyy = d_covariances.T
    d_covariance = np.stack([np.stack([gxx, gxy], axis=1), np.stack([gxy, gyy], axis=1)], axis=1)
    if by_log_opacity is not None:
        plain = geometry.half @ geometry.half.transpose(0, 2, 1)
        d_covariance += sum(compensation_grad(plain, plain + LOW_PASS_ANTIALIASED * np.eye(2), by_log_opacity))
    d_half = 2 * d_covariance @ geometry.half
    factor = geometry.rotations * geometry.scales[:, None, :]
    return d_half, factor, d_half @ (camera.rotation @ factor).transpose(0, 2, 1)


def lens_grad(
    means: Float64,
    quaternions: Float64,
    log_scales: Float64,
    camera: Camera,
    projected: Projected,
    d_means2d: Float64,
    d_covariances: Float64,
    d_opacities: Float64,
    *,
    antialiased: bool = False,
) -> Float64:
    """Eqs. (144), (145): gradient (4,) by ln fx, ln fy, cx and cy of a flat camera. Arguments as of `project_grad`."""
    assert not camera.kind.rays
    rows = np.flatnonzero(projected.visible)
    geometry = _geometry(means[rows], quaternions[rows], log_scales[rows], camera)
    by_log_opacity = d_opacities[rows] * projected.opacities[rows] if antialiased else None
    _, _, d_jacobian = _jacobian_grad(geometry, camera, d_covariances[rows], by_log_opacity)
    perspective = camera.projection == "perspective"
    z = geometry.p[:, 2] if perspective else np.ones(len(rows))
    by_log_focal, by_centre = [], []
    for axis, focal in enumerate((camera.fx, camera.fy)):
        along, lean = d_jacobian[:, axis, axis], d_jacobian[:, axis, 2]
        free = geometry.unclamped[:, axis]
        places = focal * geometry.p[:, axis] / z * d_means2d[rows, axis]
        follows = np.where(free, geometry.jacobian[:, axis, 2] * lean, 0.0)
        by_log_focal.append((places + geometry.jacobian[:, axis, axis] * along + follows).sum())
        beyond = np.where(~free & perspective, lean / z, 0.0)
        by_centre.append((d_means2d[rows, axis] + beyond).sum())
    return np.array([*by_log_focal, *by_centre])


def project_grad(
    means: Float64,
    quaternions: Float64,
    log_scales: Float64,
    opacity_logits: Float64,
    sh: Float64,
    camera: Camera,
    sh_degree: int,
    projected: Projected,
    d_means2d: Float64,
    d_covariances: Float64,
    d_opacities: Float64,
    d_colors: Float64,
    *,
    antialiased: bool = False,
) -> dict[str, Float64]:
    """Eqs. (31) to (41), antialiased with (84): gradients by the five parameter arrays, keyed by their names; zero
    where culled.

    projected: what `project` made; d_means2d (N, 2), d_covariances (N, 3): xx, xy, yy as in (28), d_opacities (N,),
    d_colors (N, 3). Of an orthographic camera J does not change, and no colour follows the mean. Those of rays:
    `reference.rays`.
    """
    assert not camera.kind.rays
    rows = np.flatnonzero(projected.visible)
    geometry = _geometry(means[rows], quaternions[rows], log_scales[rows], camera)
    x, y, z = geometry.p.T
    by_log_opacity = d_opacities[rows] * projected.opacities[rows] if antialiased else None
    d_half, factor, d_jacobian = _jacobian_grad(geometry, camera, d_covariances[rows], by_log_opacity)
    d_factor = (geometry.jacobian @ camera.rotation).transpose(0, 2, 1) @ d_half  # (32)
    d_log_scales = (d_factor * factor).sum(axis=1)  # (33)
    d_quaternions = quaternion_grad(quaternions[rows], d_factor * geometry.scales[:, None, :])

    if camera.projection == "orthographic":
        d_p = d_means2d[rows] * [camera.fx, camera.fy]
        d_p = np.concatenate([d_p, np.zeros((len(rows), 1))], axis=1)
    else:
        # (36): the Jacobian's entries by z and by the clamped ratios; a clamped ratio does not move with the mean
        d00, d02, d11, d12 = d_jacobian[:, 0, 0], d_jacobian[:, 0, 2], d_jacobian[:, 1, 1], d_jacobian[:, 1, 2]
        d_z = (-camera.fx * d00 + camera.fx * geometry.ratios[:, 0] * d02) / z**2
        d_z += (-camera.fy * d11 + camera.fy * geometry.ratios[:, 1] * d12) / z**2
        d_ratio_x = np.where(geometry.unclamped[:, 0], -camera.fx * d02 / z, 0.0)
        d_ratio_y = np.where(geometry.unclamped[:, 1], -camera.fy * d12 / z, 0.0)
        # (37): the mean itself is projected unclamped
        d_ratio_x = d_ratio_x + camera.fx * d_means2d[rows, 0]
        d_ratio_y = d_ratio_y + camera.fy * d_means2d[rows, 1]
        d_z -= (d_ratio_x * x + d_ratio_y * y) / z**2
        d_p = np.stack([d_ratio_x / z, d_ratio_y / z, d_z], axis=1)

    basis, d_value, d_by_colour = colour_grad(
        means[rows], sh[rows], camera, sh_degree, projected.colors[rows], d_colors[rows]
    )
    count = basis.shape[1]
    d_means = d_p @ camera.rotation + d_by_colour

    opacities = projected.opacities[rows]
    gradients = {
        "means": np.zeros_like(means),
        "quaternions": np.zeros_like(quaternions),
        "log_scales": np.zeros_like(log_scales),
        "opacity_logits": np.zeros_like(opacity_logits),
        "sh": np.zeros_like(sh),
    }
    gradients["means"][rows] = d_means
    gradients["quaternions"][rows] = d_quaternions
    gradients["log_scales"][rows] = d_log_scales
    logits = opacity_logits[rows]
    gradients["opacity_logits"][rows] = d_opacities[rows] * opacities / (1 + np.exp(logits))  # (41)
    gradients["sh"][rows, :count] = basis[:, :, None] * d_value[:, None, :]
    return gradients

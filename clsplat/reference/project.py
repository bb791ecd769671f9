# SPDX-License-Identifier: Apache-2.0
"""Projection of Gaussians to the image plane, and its gradient: float64 twin of kernels/project*.cl.

Equation numbers refer to docs/gradients.md. The arithmetic is in the precision of the parameters: with np.longdouble,
the twin's own rounding errors can be measured.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Bool, Float64, Int64
from clsplat.camera import Camera
from clsplat.cameras.model import PlaneProjection
from clsplat.reference.sh import sh_basis_grad
from clsplat.reference.sort import depth_order
from clsplat.spherical_harmonics import sh_basis

ALPHA_MIN = 1.0 / 255.0
"""Smallest alpha with which a Gaussian is added to a pixel."""
LOW_PASS_PX2 = 0.3
"""Variance added to the diagonal of projected covariances, in square pixels."""
LOW_PASS_ANTIALIASED_PX2 = 0.1
"""Variance added to the diagonal of projected covariances of antialiased models, in square pixels."""
MIN_COMPENSATION = 0.005
"""Smallest factor by which an antialiased model's opacities are compensated for the low-pass."""
COLOUR_LIMIT = 1e9
"""Gaussians with a colour channel of this value or more are culled."""
BOX_SLACK = 0.1
"""Amount added to the bound q <= 2 ln(255 opacity) of a Gaussian's box. The box then holds alphas down to 5 % below
1/255, and margins between alphas and 1/255 are correct up to 5 %."""

PARAMETER_NAMES = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
"""The arrays of `Gaussians` that `project` takes, in the order of its arguments."""


@dataclass(frozen=True, eq=False)
class Footprint:
    """A Gaussian's falloff on a box of pixels. It has no effect on other pixels.

    box: slices of the picture's rows and columns.
    dx, dy: broadcastable to (h, w), pixel centre minus mean; for camera models along rays, on the tangent plane.
    falloff: (h, w), exp(-q / 2), with q as in `Seen.conic`.
    raw: (h, w), opacity times falloff: alpha before it is limited to 0.99.
    """

    box: tuple[slice, slice]
    dx: Float64
    dy: Float64
    falloff: Float64
    raw: Float64


@dataclass(frozen=True, eq=False)
class Seen(ABC):
    """N projected Gaussians, for a camera of any projection.

    depths: (N,), z in the camera's axes; for camera models along rays, the distance.
    opacities: (N,), 0 to 1.
    colors: (N, 3).
    visible: (N,), False for culled Gaussians.
    """

    depths: Float64
    opacities: Float64
    colors: Float64
    visible: Bool

    @property
    def order(self) -> Int64:
        """Indices of the visible Gaussians, front to back."""
        return depth_order(self.depths, self.visible)

    @abstractmethod
    def footprint(self, gaussian: int, width: int, height: int) -> Footprint | None:
        """Return the footprint of a Gaussian on the image; None for a Gaussian outside the image."""

    @abstractmethod
    def conic(self, gaussian: int) -> Float64:
        """Return the conic a, b, c of a Gaussian: q = a dx^2 + 2 b dx dy + c dy^2."""

    def by_mean(self, gaussian: int, splat: Footprint) -> tuple[Float64, Float64]:
        """Return derivatives of -q / 2 at each pixel of a footprint with respect to the mean's x and y: eq. (25)."""
        a, b, c = self.conic(gaussian)
        return a * splat.dx + b * splat.dy, b * splat.dx + c * splat.dy


@dataclass(frozen=True, eq=False)
class ProjectedTwin(Seen):
    """N Gaussians on the image plane. Rows of Gaussians that are not visible are zero.

    means2d: (N, 2), pixels.
    covariances: (N, 3), sxx, sxy, syy in px^2.
    conics: (N, 3), a, b, c of the inverse, q = a dx^2 + 2 b dx dy + c dy^2.
    whitening: (N, 3), l11, l12, l22 of eq. (8).
    half_extents: (N, 2), in pixels, of the box in which alpha reaches 1/255.
    visible: (N,), True if eq. (13) holds. A visible Gaussian may still lie entirely outside the image.
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
        """Return the footprint of a Gaussian on the box in which its alpha can reach 1/255: eqs. (9) and (14)."""
        opacity = self.opacities[gaussian]
        reach = 2 * np.log(opacity / ALPHA_MIN) + BOX_SLACK
        half = np.sqrt(reach * self.covariances[gaussian, [0, 2]])
        mean = self.means2d[gaussian]
        size = np.array([width, height])
        # Clip before conversion: the mean of a Gaussian far off the image may overflow an integer.
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
    """Intermediate values that projection and its gradient share.

    p: (N, 3), the means in the camera's axes.
    plane: the projection of p, linearised at p.
    rotations, scales: (N, 3, 3) and (N, 3), of the Gaussians.
    half: (N, 2, 3), M of eq. (5); the projected covariance without low-pass is M M^T.
    """

    p: Float64
    plane: PlaneProjection
    rotations: Float64
    scales: Float64
    half: Float64


def rotation_matrices(quaternions: Float64) -> Float64:
    """Return rotation matrices (N, 3, 3) of raw quaternions (N, 4), w x y z. A zero quaternion gives NaN."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def _geometry(means: Float64, quaternions: Float64, log_scales: Float64, camera: Camera) -> _Geometry:
    """Compute the values that projection and its gradient share: eqs. (1), (3) to (5), or (16) of docs/cameras.md."""
    p = means @ camera.rotation.T + camera.translation
    plane = camera.model.projected(camera, p)
    rotations = rotation_matrices(quaternions)
    scales = np.exp(log_scales)
    half = plane.jacobian @ camera.rotation @ (rotations * scales[:, None, :])
    return _Geometry(p, plane, rotations, scales, half)


def view_directions(means: Float64, camera: Camera) -> tuple[Float64, Float64]:
    """Return unit vectors (N, 3) from the camera to the means, and distances (N, 1).

    For a camera with parallel rays, all vectors are its axis and distances are infinite: eq. (17) of docs/cameras.md.
    """
    if camera.model.parallel:
        return np.tile(camera.rotation[2], (len(means), 1)), np.full((len(means), 1), np.inf)
    offsets = means - camera.position
    distances: Float64 = np.linalg.norm(offsets, axis=1, keepdims=True)
    return offsets / distances, distances


def _pixels_of(p: Float64, camera: Camera) -> Float64:
    """Return pixels (N, 2) of points p (N, 3) in the camera's axes, relative to the camera's window: eq. (2)."""
    focal = np.array([camera.fx, camera.fy])
    means2d: Float64 = focal * p[:, :2] / camera.model.divisors(p[:, 2])[:, None] + np.array([camera.cx, camera.cy])
    return means2d if camera.window is None else means2d - [camera.window.x, camera.window.y]


@dataclass(frozen=True, eq=False)
class _Ellipses:
    """Ellipses of N Gaussians on the image, with fields as in `ProjectedTwin`.

    plain_determinants, determinants: (N,), of the covariances without and with the low-pass.
    """

    covariances: Float64
    conics: Float64
    whitening: Float64
    plain_determinants: Float64
    determinants: Float64


def _ellipses(half: Float64, low_pass: float) -> _Ellipses:
    """Compute the ellipses from M (N, 2, 3) of eq. (5): eqs. (6) to (8)."""
    m1, m2 = half[:, 0], half[:, 1]
    length1, length2 = (m1 * m1).sum(axis=1), (m2 * m2).sum(axis=1)
    sxx, sxy, syy = length1 + low_pass, (m1 * m2).sum(axis=1), length2 + low_pass
    cross = np.cross(m1, m2)
    det0 = (cross * cross).sum(axis=1)
    det = det0 + low_pass * (length1 + length2) + low_pass**2
    l11 = np.sqrt(syy / det)
    whitening = np.stack([l11, -(sxy / syy) * l11, 1 / np.sqrt(syy)], axis=1)
    conics = np.stack([syy / det, -sxy / det, sxx / det], axis=1)
    return _Ellipses(np.stack([sxx, sxy, syy], axis=1), conics, whitening, det0, det)


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
) -> ProjectedTwin:
    """Project Gaussians: eqs. (1) to (13), and for an orthographic camera (15) to (17) of docs/cameras.md.

    The arrays are those of `Gaussians`, in float64.

    sh_degree: the SH degree in use; higher degrees are ignored.
    antialiased: compensate opacities for the low-pass, eq. (83).
    """
    with np.errstate(all="ignore"):  # Gaussians whose values overflow or are divided by zero are culled below
        geometry = _geometry(means, quaternions, log_scales, camera)
        z, means2d = geometry.p[:, 2], _pixels_of(geometry.p, camera)
        ellipses = _ellipses(geometry.half, LOW_PASS_ANTIALIASED_PX2 if antialiased else LOW_PASS_PX2)
        opacities = 1 / (1 + np.exp(-opacity_logits))
        if antialiased:
            opacities = opacities * compensation(ellipses.plain_determinants, ellipses.determinants)
        reach = 2 * np.log(opacities / ALPHA_MIN)
        half_extents = np.sqrt(reach[:, None] * ellipses.covariances[:, [0, 2]])

        directions, _ = view_directions(means, camera)
        basis = sh_basis(directions, sh_degree)
        colors = np.maximum(0.0, 0.5 + np.einsum("nk,nkc->nc", basis, sh[:, : basis.shape[1]]))

        visible = (
            (z > max(camera.near, 0.0))
            & (z < camera.far)
            & (opacities > ALPHA_MIN)
            & (ellipses.determinants > 0)
            & (colors < COLOUR_LIMIT).all(axis=1)
        )
        for values in (means2d, ellipses.whitening, ellipses.conics, half_extents, colors):
            visible &= np.isfinite(values).all(axis=1)

    def shown(values: Float64) -> Float64:
        mask = visible if values.ndim == 1 else visible[:, None]
        return np.where(mask, values, 0.0)

    return ProjectedTwin(
        means2d=shown(means2d),
        covariances=shown(ellipses.covariances),
        conics=shown(ellipses.conics),
        whitening=shown(ellipses.whitening),
        half_extents=shown(half_extents),
        depths=shown(z),
        opacities=shown(opacities),
        colors=shown(colors),
        visible=visible,
    )


def compensation(det0: Float64, det: Float64) -> Float64:
    """Return factors (N,) of the opacities that compensate for the low-pass: eq. (83).

    det0, det: (N,), determinants of the projected covariances without and with the low-pass.
    """
    return np.maximum(np.sqrt(det0 / det), MIN_COMPENSATION)


def compensation_grad(plain: Float64, filtered: Float64, d_logs: Float64) -> tuple[Float64, Float64]:
    """Return the gradients (N, 2, 2) with respect to `plain` and `filtered` through the compensation alone: eq. (84).

    plain, filtered: (N, 2, 2), the covariances without and with the low-pass.
    d_logs: (N,), gradient of the loss with respect to ln(opacity).
    """
    free = np.linalg.det(plain) > MIN_COMPENSATION**2 * np.linalg.det(filtered)
    by_plain, by_filtered = np.zeros_like(plain), np.zeros_like(plain)
    half = 0.5 * d_logs[free, None, None]
    by_plain[free], by_filtered[free] = half * np.linalg.inv(plain[free]), -half * np.linalg.inv(filtered[free])
    return by_plain, by_filtered


def covariance_grad(conics: Float64, d_conics: Float64) -> Float64:
    """Return the gradient (N, 3) with respect to covariances: xx, xy, yy of dL/dSigma. Eq. (30).

    dL/dSigma = -A G A, where A is the conic matrix and G the gradient with respect to it. As Sigma is symmetric, the
    derivative with respect to its off-diagonal number sxy is twice the entry xy.

    conics, d_conics: (N, 3), a, b, c, and the derivatives with respect to them. b occurs twice in A.
    """
    a, b, c = conics.T
    matrix = np.stack([np.stack([a, b], axis=1), np.stack([b, c], axis=1)], axis=1)
    d_a, d_b, d_c = d_conics.T
    gradient = np.stack([np.stack([d_a, d_b / 2], axis=1), np.stack([d_b / 2, d_c], axis=1)], axis=1)
    result = -matrix @ gradient @ matrix
    return np.stack([result[:, 0, 0], result[:, 0, 1], result[:, 1, 1]], axis=1)


def quaternion_grad(quaternions: Float64, d_rotations: Float64) -> Float64:
    """Return the gradient (N, 4) with respect to raw quaternions, to which it is orthogonal: eqs. (34), (35).

    d_rotations: (N, 3, 3), the gradient with respect to the rotation matrices.
    """
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
    """Return the SH basis (N, K), and the gradients (N, 3) with respect to unclamped colours and to means.

    Unclamped colours are those before the clamp at 0. Means act on colours through the viewing direction: eqs. (38) to
    (40).

    colors, d_colors: (N, 3), the clamped colours, and the gradient of the loss with respect to them.
    """
    directions, distances = view_directions(means, camera)
    basis = sh_basis(directions, sh_degree)
    d_value = np.where(colors > 0, d_colors, 0.0)  # (39)
    of_direction = sh_basis_grad(directions, sh_degree)
    d_directions = np.einsum("nkd,nkc,nc->nd", of_direction, sh[:, : basis.shape[1]], d_value)
    radial = (directions * d_directions).sum(axis=1, keepdims=True)
    return basis, d_value, (d_directions - directions * radial) / distances  # (38), (40)


@dataclass(frozen=True, eq=False)
class ProjectedGradients:
    """Gradients of a loss with respect to the results of `project`.

    means2d: (N, 2).
    covariances: (N, 3), xx, xy, yy as from `covariance_grad`.
    opacities: (N,).
    colors: (N, 3).
    """

    means2d: Float64
    covariances: Float64
    opacities: Float64
    colors: Float64


def _jacobian_grad(
    geometry: _Geometry, camera: Camera, d_covariances: Float64, by_log_opacity: Float64 | None
) -> tuple[Float64, Float64, Float64]:
    """Return dL/dM (N, 2, 3), the matrices R S (N, 3, 3) of the Gaussians, and dL/dJ (N, 2, 3): eqs. (31), (32).

    d_covariances: (N, 3), gradient with respect to the covariances, as from `covariance_grad`.
    by_log_opacity: (N,), gradient with respect to ln(opacity) if opacities are compensated, otherwise None.
    """
    gxx, gxy, gyy = d_covariances.T
    d_covariance = np.stack([np.stack([gxx, gxy], axis=1), np.stack([gxy, gyy], axis=1)], axis=1)
    if by_log_opacity is not None:
        plain = geometry.half @ geometry.half.transpose(0, 2, 1)
        d_covariance += sum(compensation_grad(plain, plain + LOW_PASS_ANTIALIASED_PX2 * np.eye(2), by_log_opacity))
    d_half = 2 * d_covariance @ geometry.half
    factor = geometry.rotations * geometry.scales[:, None, :]
    return d_half, factor, d_half @ (camera.rotation @ factor).transpose(0, 2, 1)


def lens_grad(
    means: Float64,
    quaternions: Float64,
    log_scales: Float64,
    camera: Camera,
    projected: ProjectedTwin,
    by: ProjectedGradients,
    *,
    antialiased: bool = False,
) -> Float64:
    """Return the gradient (4,) with respect to ln fx, ln fy, cx and cy of the camera: eqs. (144), (145).

    by: gradients with respect to `projected`, the result of `project`.
    """
    assert not camera.model.along_rays
    rows = np.flatnonzero(projected.visible)
    geometry = _geometry(means[rows], quaternions[rows], log_scales[rows], camera)
    by_log_opacity = by.opacities[rows] * projected.opacities[rows] if antialiased else None
    _, _, d_jacobian = _jacobian_grad(geometry, camera, by.covariances[rows], by_log_opacity)
    z = camera.model.divisors(geometry.p[:, 2])
    by_log_focal, by_centre = [], []
    for axis, focal in enumerate((camera.fx, camera.fy)):
        along, lean = d_jacobian[:, axis, axis], d_jacobian[:, axis, 2]
        free = geometry.plane.unclamped[:, axis]
        places = focal * geometry.p[:, axis] / z * by.means2d[rows, axis]
        follows = np.where(free, geometry.plane.jacobian[:, axis, 2] * lean, 0.0)
        by_log_focal.append((places + geometry.plane.jacobian[:, axis, axis] * along + follows).sum())
        beyond = np.where(~free, lean / z, 0.0)
        by_centre.append((by.means2d[rows, axis] + beyond).sum())
    return np.array([*by_log_focal, *by_centre])


def project_grad(
    arrays: Mapping[str, Float64],
    camera: Camera,
    sh_degree: int,
    projected: ProjectedTwin,
    by: ProjectedGradients,
    *,
    antialiased: bool = False,
) -> dict[str, Float64]:
    """Return gradients with respect to the five parameter arrays, by name; zero where culled: eqs. (31) to (41), (84).

    arrays: the parameters, keyed by their names in `project`.
    projected: the result of `project`.
    by: gradients with respect to `projected`.

    For an orthographic camera J is constant, and colours do not depend on the means. `reference.rays` has the gradients
    for models along rays.
    """
    assert not camera.model.along_rays
    rows = np.flatnonzero(projected.visible)
    seen = {name: array[rows] for name, array in arrays.items()}
    geometry = _geometry(seen["means"], seen["quaternions"], seen["log_scales"], camera)
    opacities, d_opacities = projected.opacities[rows], by.opacities[rows]
    by_log_opacity = d_opacities * opacities if antialiased else None
    d_half, factor, d_jacobian = _jacobian_grad(geometry, camera, by.covariances[rows], by_log_opacity)
    d_factor = (geometry.plane.jacobian @ camera.rotation).transpose(0, 2, 1) @ d_half  # (32)
    d_p = camera.model.mean_grad(camera, geometry.p, geometry.plane, d_jacobian, by.means2d[rows])
    basis, d_value, d_by_colour = colour_grad(
        seen["means"], seen["sh"], camera, sh_degree, projected.colors[rows], by.colors[rows]
    )
    gradients = {name: np.zeros_like(arrays[name]) for name in PARAMETER_NAMES}
    gradients["means"][rows] = d_p @ camera.rotation + d_by_colour
    gradients["quaternions"][rows] = quaternion_grad(seen["quaternions"], d_factor * geometry.scales[:, None, :])
    gradients["log_scales"][rows] = (d_factor * factor).sum(axis=1)  # (33)
    gradients["opacity_logits"][rows] = d_opacities * opacities / (1 + np.exp(seen["opacity_logits"]))  # (41)
    gradients["sh"][rows, : basis.shape[1]] = basis[:, :, None] * d_value[:, None, :]
    return gradients

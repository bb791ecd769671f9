# SPDX-License-Identifier: Apache-2.0
"""Gaussians projected to tangent planes and evaluated along the rays of pixels, and their gradient, in float64.

Twin of kernels/project_rays.cl, and of blending and project_grad.cl with the define RAYS. Equation numbers refer to
docs/cameras.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.reference.blend import BlendGradients
from clsplat.reference.cameras import cam_from_pixel, pixel_grid
from clsplat.reference.project import (
    ALPHA_MIN,
    LOW_PASS_ANTIALIASED_PX2,
    LOW_PASS_PX2,
    Footprint,
    Seen,
    colour_grad,
    compensation,
    compensation_grad,
    covariance_grad,
    quaternion_grad,
    rotation_matrices,
    view_directions,
)
from clsplat.reference.render import parameters
from clsplat.spherical_harmonics import sh_basis


@dataclass(frozen=True, eq=False)
class Tangents(Seen):
    """Gaussians on planes tangent to the unit sphere around the camera, each at the direction of its mean.

    directions: (N, 3), unit directions of the means in the camera's axes.
    right, down: (N, 3), the axes of the tangent planes.
    covariances: (N, 2, 2), covariances on the tangent planes, with the low-pass.
    rays: (P, 3), unit directions of the camera's pixels; 0 for a pixel without a ray.
    """

    directions: Float64
    right: Float64
    down: Float64
    covariances: Float64
    rays: Float64

    def footprint(self, gaussian: int, width: int, height: int) -> Footprint:
        """Return the Gaussian's footprint on the whole image: eq. (14)."""
        along = self.rays @ self.directions[gaussian]
        ahead = along > 0
        safe = np.where(ahead, along, 1.0)
        at = np.stack([self.rays @ self.right[gaussian], self.rays @ self.down[gaussian]], axis=1) / safe[:, None]
        q = np.einsum("ni,ij,nj->n", at, np.linalg.inv(self.covariances[gaussian]), at)
        falloff = np.where(ahead, np.exp(-0.5 * q), 0.0).reshape(height, width)
        dx, dy = at.T.reshape(2, height, width)
        return Footprint((slice(height), slice(width)), dx, dy, falloff, self.opacities[gaussian] * falloff)

    def conic(self, gaussian: int) -> Float64:
        (a, b), (_, c) = np.linalg.inv(self.covariances[gaussian])
        return np.array([a, b, c])

    def by_mean(self, gaussian: int, splat: Footprint) -> tuple[Float64, Float64]:
        """Return derivatives of -q / 2 at each pixel of a footprint with respect to the mean's x and y: eq. (21).

        The coordinates x and y are on the tangent plane, which rotates with the mean.
        """
        by_x, by_y = super().by_mean(gaussian, splat)
        q = splat.dx * by_x + splat.dy * by_y
        return by_x + q * splat.dx, by_y + q * splat.dy


def tangents(gaussians: Gaussians, camera: Camera) -> Tangents:
    """Project Gaussians to tangent planes of the unit sphere around the camera: eqs. (8) to (13), and (30)."""
    arrays = parameters(gaussians)
    means = arrays["means"]
    p = means @ camera.rotation.T + camera.translation
    depths = np.linalg.norm(p, axis=1)
    directions = p / depths[:, None]
    right, down, pixels = camera.model.footprints(camera, directions)
    axes = camera.rotation @ rotation_matrices(arrays["quaternions"]) * np.exp(arrays["log_scales"])[:, None, :]
    half = np.stack([right, down], axis=1) @ axes / depths[:, None, None]
    plain, low_pass = (
        half @ half.transpose(0, 2, 1),
        LOW_PASS_ANTIALIASED_PX2 if gaussians.antialiased else LOW_PASS_PX2,
    )
    covariances = plain + low_pass * pixels @ pixels.transpose(0, 2, 1)
    opacities = 1 / (1 + np.exp(-arrays["opacity_logits"]))
    if gaussians.antialiased:
        opacities = opacities * compensation(np.linalg.det(plain), np.linalg.det(covariances))
    basis = sh_basis(view_directions(means, camera)[0], gaussians.sh_degree)
    colors = np.maximum(0.0, 0.5 + np.einsum("nk,nkc->nc", basis, arrays["sh"][:, : basis.shape[1]]))
    along = p[:, 2] if camera.model.flat else depths
    visible = (along > camera.near) & (along < camera.far) & (opacities > ALPHA_MIN)
    visible &= camera.model.shows(camera, p)
    rays = np.nan_to_num(cam_from_pixel(camera, pixel_grid(camera))[1])
    return Tangents(depths, opacities, colors, visible, directions, right, down, covariances, rays)


def pixel_sides(pixels: Float64) -> Float64:
    """Return the sides (N, 2) of a pixel along the tangent plane's axes, in radians.

    pixels: (N, 2, 2), footprints of pixels as from `CameraModel.footprints`.
    """
    sides: Float64 = np.linalg.norm(pixels, axis=2)
    return sides


def tangents_grad(gaussians: Gaussians, camera: Camera, seen: Tangents, screen: BlendGradients) -> dict[str, Float64]:
    """Return gradients with respect to the five parameter arrays, by name; zero where culled: eqs. (22) to (29).

    seen: the result of `tangents`.
    screen: gradients with respect to the projected Gaussians, from blending.
    """
    rows = np.flatnonzero(seen.visible)
    arrays = parameters(gaussians)
    means, quaternions = arrays["means"][rows], arrays["quaternions"][rows]
    depths, directions = seen.depths[rows], seen.directions[rows]
    plane = np.stack([seen.right[rows], seen.down[rows]], axis=1)
    rotations, scales = rotation_matrices(quaternions), np.exp(arrays["log_scales"][rows])
    factor = rotations * scales[:, None, :]
    axes = camera.rotation @ factor
    half = plane @ axes / depths[:, None, None]

    conics = np.stack([seen.conic(row) for row in rows.tolist()]) if len(rows) else np.zeros((0, 3))
    gxx, gxy, gyy = covariance_grad(conics, screen.conics[rows]).T
    d_covariance = np.stack([np.stack([gxx, gxy], axis=1), np.stack([gxy, gyy], axis=1)], axis=1)
    d_low_pass, low_pass = d_covariance, LOW_PASS_PX2
    if gaussians.antialiased:
        by_log_opacity = screen.opacities[rows] * seen.opacities[rows]
        by_plain, by_filtered = compensation_grad(
            half @ half.transpose(0, 2, 1), seen.covariances[rows], by_log_opacity
        )
        d_low_pass, low_pass = d_covariance + by_filtered, LOW_PASS_ANTIALIASED_PX2
        d_covariance = d_low_pass + by_plain
    d_half = 2 * d_covariance @ half
    d_factor = (plane @ camera.rotation / depths[:, None, None]).transpose(0, 2, 1) @ d_half
    d_log_scales = (d_factor * factor).sum(axis=1)
    d_quaternions = quaternion_grad(quaternions, d_factor * scales[:, None, :])

    ahead = np.einsum("ni,nij->nj", directions, axes) / depths[:, None]
    turn = screen.means2d[rows] - np.einsum("nij,nj->ni", d_half, ahead)
    turn += camera.model.low_pass_grad(camera, directions, d_low_pass, low_pass)
    size = (d_half * half).sum(axis=(1, 2))
    d_p = (np.einsum("ni,nij->nj", turn, plane) - size[:, None] * directions) / depths[:, None]
    of_colour = (arrays["sh"][rows], camera, gaussians.sh_degree, seen.colors[rows], screen.colors[rows])
    basis, d_value, d_by_colour = colour_grad(means, *of_colour)
    opacities = seen.opacities[rows]

    gradients = {name: np.zeros_like(array) for name, array in arrays.items()}
    gradients["means"][rows] = d_p @ camera.rotation + d_by_colour
    gradients["quaternions"][rows] = d_quaternions
    gradients["log_scales"][rows] = d_log_scales
    logits = arrays["opacity_logits"][rows]
    gradients["opacity_logits"][rows] = screen.opacities[rows] * opacities / (1 + np.exp(logits))
    gradients["sh"][rows, : basis.shape[1]] = basis[:, :, None] * d_value[:, None, :]
    return gradients

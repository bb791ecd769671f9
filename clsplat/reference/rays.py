# SPDX-License-Identifier: Apache-2.0
"""Gaussians of equirectangular and fisheye pictures in float64: twin of kernels/project_rays.cl and of a ray's alphas.
Equation numbers are those of docs/cameras.md."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.reference.cameras import cam_from_pixel, pixel_grid
from clsplat.reference.project import (
    ALPHA_MIN,
    LOW_PASS,
    LOW_PASS_ANTIALIASED,
    Footprint,
    Seen,
    compensation,
    rotation_matrices,
    view_directions,
)
from clsplat.reference.render import parameters
from clsplat.spherical_harmonics import sh_basis


@dataclass(frozen=True, eq=False)
class Tangents(Seen):
    """directions, right, down (N, 3): the mean's direction and the axes of the plane that touches there, in the camera;
    covariances (N, 2, 2) on it, with the low-pass; rays (P, 3): unit directions of the camera's pixels, 0 without."""

    directions: Float64
    right: Float64
    down: Float64
    covariances: Float64
    rays: Float64

    def footprint(self, gaussian: int, width: int, height: int) -> Footprint:
        """(14), at every pixel of the image."""
        along = self.rays @ self.directions[gaussian]
        ahead = along > 0
        safe = np.where(ahead, along, 1.0)
        at = np.stack([self.rays @ self.right[gaussian], self.rays @ self.down[gaussian]], axis=1) / safe[:, None]
        q = np.einsum("ni,ij,nj->n", at, np.linalg.inv(self.covariances[gaussian]), at)
        falloff = np.where(ahead, np.exp(-0.5 * q), 0.0).reshape(height, width)
        dx, dy = at.T.reshape(2, height, width)
        return Footprint((slice(height), slice(width)), dx, dy, falloff, self.opacities[gaussian] * falloff)


def footprints(directions: Float64, camera: Camera) -> tuple[Float64, Float64, Float64]:
    """(9), (10): right, down (N, 3) and what a pixel is on the tangent plane, (N, 2, 2), columns by u and v."""
    x, y, z = directions.T
    zero = np.zeros_like(x)
    pixels = np.zeros((len(x), 2, 2))
    if camera.projection == "equirectangular":
        level = np.hypot(x, z)
        safe = np.where(level > 0, level, 1.0)
        s, c = np.where(level > 0, x / safe, 0.0), np.where(level > 0, z / safe, 1.0)
        right, down = np.stack([c, zero, -s], axis=1), np.stack([-y * s, level, -y * c], axis=1)
        pixels[:, 0, 0] = np.maximum(level, 0.5 / camera.fy) / camera.fx
        pixels[:, 1, 1] = 1 / camera.fy
        return right, down, pixels
    across = np.hypot(x, y)
    safe = np.where(across > 0, across, 1.0)
    c, s = np.where(across > 0, x / safe, 1.0), np.where(across > 0, y / safe, 0.0)
    right, down = np.stack([z * c, z * s, -across], axis=1), np.stack([-s, c, zero], axis=1)
    theta = np.arctan2(across, z)
    around = np.maximum(np.sinc(theta / np.pi), 0.5 / (np.pi * camera.fx))
    pixels[:, 0, 0], pixels[:, 0, 1] = c / camera.fx, s / camera.fy
    pixels[:, 1, 0], pixels[:, 1, 1] = -s * around / camera.fx, c * around / camera.fy
    return right, down, pixels


def tangents(gaussians: Gaussians, camera: Camera) -> Tangents:
    """(8) to (13)."""
    arrays = parameters(gaussians)
    means = arrays["means"]
    p = means @ camera.rotation.T + camera.translation
    depths = np.linalg.norm(p, axis=1)
    directions = p / depths[:, None]
    right, down, pixels = footprints(directions, camera)
    axes = camera.rotation @ rotation_matrices(arrays["quaternions"]) * np.exp(arrays["log_scales"])[:, None, :]
    half = np.stack([right, down], axis=1) @ axes / depths[:, None, None]
    plain, low_pass = half @ half.transpose(0, 2, 1), LOW_PASS_ANTIALIASED if gaussians.antialiased else LOW_PASS
    covariances = plain + low_pass * pixels @ pixels.transpose(0, 2, 1)
    opacities = 1 / (1 + np.exp(-arrays["opacity_logits"]))
    if gaussians.antialiased:
        opacities = opacities * compensation(np.linalg.det(plain), np.linalg.det(covariances))
    basis = sh_basis(view_directions(means, camera)[0], gaussians.sh_degree)
    colors = np.maximum(0.0, 0.5 + np.einsum("nk,nkc->nc", basis, arrays["sh"][:, : basis.shape[1]]))
    visible = (depths > camera.near) & (opacities > ALPHA_MIN)
    rays = np.nan_to_num(cam_from_pixel(camera, pixel_grid(camera))[1])
    return Tangents(depths, opacities, colors, visible, directions, right, down, covariances, rays)

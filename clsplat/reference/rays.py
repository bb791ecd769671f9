# SPDX-License-Identifier: Apache-2.0
"""Gaussians of pictures along rays in float64, and their gradient: twin of kernels/project_rays.cl, of
a ray's alphas and of project_grad.cl with RAYS. Equation numbers are those of docs/cameras.md."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.reference.blend import BlendGradients
from clsplat.reference.cameras import cam_from_pixel, pixel_grid, radii
from clsplat.reference.project import (
    ALPHA_MIN,
    LOW_PASS,
    LOW_PASS_ANTIALIASED,
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

    def conic(self, gaussian: int) -> Float64:
        (a, b), (_, c) = np.linalg.inv(self.covariances[gaussian])
        return np.array([a, b, c])

    def by_mean(self, gaussian: int, splat: Footprint) -> tuple[Float64, Float64]:
        """(21): the plane turns with the mean, which moves what is far from it by more."""
        by_x, by_y = super().by_mean(gaussian, splat)
        q = splat.dx * by_x + splat.dy * by_y
        return by_x + q * splat.dx, by_y + q * splat.dy


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
    along, around, _, _ = pixel_angles(camera, np.arctan2(across, z))
    pixels[:, 0, 0], pixels[:, 0, 1] = c * along / camera.fx, s * along / camera.fy
    pixels[:, 1, 0], pixels[:, 1, 1] = -s * around / camera.fx, c * around / camera.fy
    return right, down, pixels


def tangents(gaussians: Gaussians, camera: Camera) -> Tangents:
    """(8) to (13), and (30)."""
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
    along = p[:, 2] if camera.kind.flat else depths
    visible = (along > camera.near) & (along < camera.far) & (opacities > ALPHA_MIN)
    if any(camera.radial):
        visible &= np.arctan2(np.hypot(p[:, 0], p[:, 1]), p[:, 2]) < camera.fold[0]
    rays = np.nan_to_num(cam_from_pixel(camera, pixel_grid(camera))[1])
    return Tangents(depths, opacities, colors, visible, directions, right, down, covariances, rays)


def pixel_sides(pixels: Float64) -> Float64:
    """Sides of a pixel along the axes of the tangent plane, (N, 2), of (10): it brings gradients there to pixels."""
    sides: Float64 = np.linalg.norm(pixels, axis=2)
    return sides


def low_pass_grad(directions: Float64, camera: Camera, gradients: Float64, low_pass: float) -> Float64:
    """(26) to (28), B: the gradient by a step of the mean's direction along the plane's axes, (N, 2), of what the
    low-pass of so many square pixels adds; gradients (N, 2, 2) by the covariance."""
    x, y, z = directions.T
    g11, g12, g22 = gradients[:, 0, 0], gradients[:, 0, 1], gradients[:, 1, 1]
    result = np.zeros((len(directions), 2))
    if camera.projection == "equirectangular":
        level = np.hypot(x, z)
        free = level > 0.5 / camera.fy
        across = np.where(free, level, 0.5 / camera.fy) / camera.fx
        around = y / np.where(level > 0, level, np.inf)
        result[:, 0] = 2 * low_pass * g12 * around * (across**2 - camera.fy**-2)
        result[:, 1] = -2 * low_pass * g11 * np.where(free, across * y / camera.fx, 0.0)
        return result
    r = np.hypot(x, y)
    safe = np.where(r > 0, r, 1.0)
    c, s = np.where(r > 0, x / safe, 1.0), np.where(r > 0, y / safe, 0.0)
    theta = np.arctan2(r, z)
    p, q, dp, dq = pixel_angles(camera, theta)
    wide, more = camera.fx**-2, camera.fy**-2 - camera.fx**-2
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


def pixel_angles(camera: Camera, theta: Float64) -> tuple[Float64, Float64, Float64, Float64]:
    """Radians a radian's pixels, away from the axis of a fisheye or a perspective camera and around it, at the angle
    theta (N,), and the derivatives of the two by theta: p, q of (19) or (30), p', q'."""
    if camera.projection == "perspective":
        sine, cosine = np.sin(theta), np.cos(theta)
        return cosine**2, cosine, -2 * sine * cosine, -sine
    radius, slope, bend = radii(camera, theta)
    with np.errstate(all="ignore"):
        ratio = np.where(theta > 1e-6, np.sin(theta) / radius, 1.0)
        least = 0.5 / (np.pi * camera.fx)
        near_axis = -theta * (1 / 3 + 2 * camera.radial[0])
        d_around = np.where(theta > 1e-4, (np.cos(theta) - ratio * slope) / radius, near_axis)
    return 1 / slope, np.maximum(ratio, least), -bend / slope**2, np.where(ratio > least, d_around, 0.0)


def tangents_grad(gaussians: Gaussians, camera: Camera, seen: Tangents, screen: BlendGradients) -> dict[str, Float64]:
    """(22) to (29): gradients by the five parameter arrays, keyed by their names; zero where culled."""
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
    d_low_pass, low_pass = d_covariance, LOW_PASS
    if gaussians.antialiased:
        by_log_opacity = screen.opacities[rows] * seen.opacities[rows]
        by_plain, by_filtered = compensation_grad(
            half @ half.transpose(0, 2, 1), seen.covariances[rows], by_log_opacity
        )
        d_low_pass, low_pass = d_covariance + by_filtered, LOW_PASS_ANTIALIASED
        d_covariance = d_low_pass + by_plain
    d_half = 2 * d_covariance @ half
    d_factor = (plane @ camera.rotation / depths[:, None, None]).transpose(0, 2, 1) @ d_half
    d_log_scales = (d_factor * factor).sum(axis=1)
    d_quaternions = quaternion_grad(quaternions, d_factor * scales[:, None, :])

    ahead = np.einsum("ni,nij->nj", directions, axes) / depths[:, None]
    turn = screen.means2d[rows] - np.einsum("nij,nj->ni", d_half, ahead)
    turn += low_pass_grad(directions, camera, d_low_pass, low_pass)
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

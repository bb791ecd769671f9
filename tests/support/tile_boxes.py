# SPDX-License-Identifier: Apache-2.0
"""Gaussians whose box of pixels reaches a tile, in float64: the count that kernels/project*.cl makes, over 0 or not.

Equation numbers refer to docs/cameras.md.
"""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Bool, Float64
from clsplat.camera import Camera
from clsplat.cameras.fisheye import Fisheye, radii
from clsplat.layouts.columns import TILE
from clsplat.reference.project import ALPHA_MIN, LOW_PASS_PX2, project, rotation_matrices

TILE_SLACK = 0.01
"""kernels/shared/tile.h"""
BOX_SLACK = 0.1
"""kernels/project_rays.cl"""
LEAST_AHEAD = 1e-4
"""kernels/shared/camera/perspective_rays.h"""


def reach_a_tile(
    means: Float64, quaternions: Float64, log_scales: Float64, opacity_logits: Float64, camera: Camera
) -> Bool:
    """True (N,) for Gaussians with a tile of the camera's picture."""
    shapes = (quaternions, log_scales, opacity_logits)
    return (_along_rays if camera.model.along_rays else _on_plane)(means, *shapes, camera)


def _on_plane(
    means: Float64, quaternions: Float64, log_scales: Float64, opacity_logits: Float64, camera: Camera
) -> Bool:
    twin = project(means, quaternions, log_scales, opacity_logits, np.zeros((len(means), 1, 3)), camera, 0)
    return twin.visible & _in_grid(twin.means2d - twin.half_extents, twin.means2d + twin.half_extents, camera)


def _in_grid(low: Float64, high: Float64, camera: Camera, slack: float = TILE_SLACK) -> Bool:
    """True (N,) for boxes (N, 2) that reach a pixel centre of a tile."""
    grid = TILE * -(-np.array([camera.width, camera.height]) // TILE)
    return np.asarray(((high + slack >= 0.5) & (low - slack <= grid - 0.5)).all(axis=1))


def _along_rays(
    means: Float64, quaternions: Float64, log_scales: Float64, opacity_logits: Float64, camera: Camera
) -> Bool:
    p = means @ camera.rotation.T + camera.translation
    distances = np.linalg.norm(p, axis=1)
    with np.errstate(all="ignore"):
        directions = p / distances[:, None]
        right, down, pixels = camera.model.footprints(camera, directions)
        axes = camera.rotation @ rotation_matrices(quaternions) * np.exp(log_scales)[:, None, :]
        half = np.stack([right, down], axis=1) @ axes / distances[:, None, None]
        covariances = half @ half.transpose(0, 2, 1) + LOW_PASS_PX2 * pixels @ pixels.transpose(0, 2, 1)
        opacities = 1 / (1 + np.exp(-opacity_logits))
        xx, xy, yy = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
        largest = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
        reach = np.sqrt(2 * np.log(opacities / ALPHA_MIN) * largest) * 1.0001
        depths = p[:, 2] if camera.model.flat else distances
        shown = (depths > camera.near) & (depths < camera.far) & (opacities > ALPHA_MIN)
        shown &= (xx < 1e15) & (yy < 1e15) & camera.model.shows(camera, p)
        box_of = _of_panorama if camera.model.wraps else _of_borders if camera.model.flat else _of_fisheye
        shown &= box_of(directions, reach, camera)
        return np.asarray(shown)


def _pixels(low: Float64, high: Float64, camera: Camera) -> tuple[Float64, Float64]:
    """Boxes in pixels of the window, from boxes (N, 2) in focal lengths."""
    window = camera.window
    corner = np.array([window.x, window.y]) if window else np.zeros(2)
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy]) - corner
    return focal * low + centre, focal * high + centre


def _of_borders(f: Float64, reach: Float64, camera: Camera) -> Bool:
    """Eq. (32)."""
    sine = reach / np.hypot(reach, 1)
    low, high = np.full((len(f), 2), -np.inf), np.full((len(f), 2), np.inf)
    for axis in range(2):
        along, z = f[:, axis], f[:, 2]
        level = np.hypot(along, z)
        ratio = sine / level
        cosine = np.sqrt(1 - ratio * ratio)
        for end, side in ((low, 1), (high, -1)):
            ahead = cosine * z + side * ratio * along
            finite = (sine < 0.999 * level) & (ahead > LEAST_AHEAD * level)
            end[:, axis] = np.where(finite, (cosine * along - side * ratio * z) / ahead, -side * np.inf)
    return _in_grid(*_pixels(low, high, camera), camera, TILE_SLACK + BOX_SLACK)


def _of_fisheye(f: Float64, reach: Float64, camera: Camera) -> Bool:
    assert isinstance(camera.model, Fisheye)
    sine, cap, fold = reach / np.hypot(reach, 1), np.arctan(reach), camera.fold[0]
    across = np.hypot(f[:, 0], f[:, 1])
    theta = np.arctan2(across, f[:, 2])
    outer = radii(camera, np.minimum(theta + cap, fold))[0]
    ring = (sine < 0.999 * across) & (theta > cap) & (theta + cap < fold)
    ratio, along = sine / across, f[:, :2] / across[:, None]
    near = radii(camera, np.maximum(theta - cap, 0))[0] * np.sqrt(1 - ratio**2)
    middle = (0.5 * (near + outer))[:, None] * along
    half = np.abs(along) * (0.5 * (outer - near))[:, None] + np.abs(along[:, ::-1]) * (outer * ratio)[:, None]
    middle, half = np.where(ring[:, None], middle, 0), np.where(ring[:, None], half, outer[:, None])
    return _in_grid(*_pixels(middle - half, middle + half, camera), camera, TILE_SLACK + BOX_SLACK)


def _of_panorama(f: Float64, reach: Float64, camera: Camera) -> Bool:
    sine, cap = reach / np.hypot(reach, 1), np.arctan(reach)
    level = np.hypot(f[:, 0], f[:, 2])
    latitude, longitude = np.arctan2(f[:, 1], level), np.arctan2(f[:, 0], f[:, 2])
    whole = ~(sine < 0.999 * level)
    half = np.where(whole, np.pi, np.arcsin(np.minimum(sine / level, 1)))
    low, high = np.stack([longitude - half, latitude - cap], 1), np.stack([longitude + half, latitude + cap], 1)
    reached = np.zeros(len(f), np.bool_)
    for turn in range(-3, 4):
        moved = np.array([2 * np.pi * turn, 0.0])
        reached |= _in_grid(*_pixels(low + moved, high + moved, camera), camera, TILE_SLACK + BOX_SLACK)
    return reached

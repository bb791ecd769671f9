# SPDX-License-Identifier: Apache-2.0
"""Up axis and focus point of a scene, estimated from its cameras. The world is not changed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera

COLMAP_UP = (0.0, -1.0, 0.0)
"""Up axis of a world that has the axes of a level camera, whose y axis points down in COLMAP's convention."""

MIN_RIGHT_SPREAD = 0.05
"""Minimum mean square of the cameras' x axes along their second principal axis, from which on the x axes span a plane.

For cameras that look in all directions around it is 0.5.
"""


def up_axis(cameras: Sequence[Camera]) -> Float64:
    """Estimate the world's up direction, a unit vector (3,), from how the photographers held their cameras.

    People tilt cameras up and down but hold them level sideways, so up is the direction most nearly at right angles to
    every camera's x axis. If these axes do not span a plane (all photographs from one side), up is the mean of the
    cameras' up axes.
    """
    right = np.stack([camera.rotation[0] for camera in cameras])
    mean_up = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
    spread, axes = np.linalg.eigh(right.T @ right / len(cameras))
    up: Float64 = axes[:, 0]
    if spread[1] < MIN_RIGHT_SPREAD or abs(up @ mean_up) < 0.2 * np.linalg.norm(mean_up):
        up = mean_up if np.linalg.norm(mean_up) > 1e-6 else -cameras[0].rotation[1]
    up = up / np.linalg.norm(up)
    return up if up @ mean_up >= 0 else -up


def median_roll(cameras: Sequence[Camera]) -> float | None:
    """Return the median angle of the cameras' x axes from level in radians, for up as from `up_axis`.

    Returns None if the x axes span no plane, as of photographs from one side. Their up direction also depends on how
    far the cameras are tilted up or down.
    """
    right = np.stack([camera.rotation[0] for camera in cameras])
    if np.linalg.eigvalsh(right.T @ right / len(cameras))[1] < MIN_RIGHT_SPREAD:
        return None
    return float(np.median(np.abs(np.arcsin(np.clip(right @ up_axis(cameras), -1, 1)))))


def focus_point(cameras: Sequence[Camera]) -> Float64:
    """The point (3,) that the cameras look at: the least-squares nearest point to all optical axes.

    If the axes are nearly parallel, or most cameras have the point behind them, it is a point ahead of the cameras
    instead, at a distance equal to their spread.
    """
    positions = np.stack([camera.position for camera in cameras])
    forward = np.stack([camera.rotation[2] for camera in cameras])
    # the squared distance from x to the axis through c along f is |P (x - c)|^2 with P = 1 - f f^T
    projections = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    normal = projections.mean(axis=0)
    ahead = forward.mean(axis=0)
    if np.linalg.eigvalsh(normal)[0] > 1e-3:
        point: Float64 = np.linalg.solve(normal, np.einsum("nij,nj->i", projections, positions) / len(cameras))
        if np.mean(np.einsum("nj,nj->n", forward, point - positions) > 0) > 0.5:
            return point
    spread = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())
    return np.asarray(positions.mean(axis=0) + ahead / np.linalg.norm(ahead) * (spread or 1.0))

# SPDX-License-Identifier: Apache-2.0
"""Rays through the pixels of the demo town's photographs, and rectangles of the picture that contain boxes."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32, Float64
from clsplat.camera import Camera
from clsplat.cameras.model import CameraModel

SAMPLES = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
"""Offsets x, y of a pixel's four rays from the pixel's centre, in pixels."""
NEAR_METRES = 0.05
"""Distance of a perspective camera's near plane in metres."""
_ANGLES = 1 << 16
"""Number of angles in the table by which a fisheye's image radius is converted to an angle from the axis."""
_CIRCLE = 32
"""Number of directions on the edge of the cone around a box. Their pixels bound the box in a fisheye picture."""
Planes = tuple[Float32, Float32, Float32]
LensKey = tuple[CameraModel, int, int, float, float, float, float, tuple[float, ...]]


def lens_key(camera: Camera) -> LensKey:
    """Return a camera's model, size and intrinsics without its pose, as the key under which its rays are cached."""
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return (camera.model, camera.width, camera.height, *intrinsics, camera.radial)


@lru_cache(maxsize=16)
def _local_rays(key: LensKey, first: int, last: int, places: tuple[tuple[float, float], ...]) -> Planes:
    """Compute ray directions in the camera's axes, as three arrays that broadcast to (places, rows, columns).

    key: the camera, as from `lens_key`. first, last: the rays are of the pixels in rows [first, last).
    places: offsets x, y of each pixel's rays from its centre, in pixels.
    """
    model, width, _, fx, fy, cx, cy, radial = key
    across, down = np.array(places).T
    a = ((np.arange(width) + 0.5 + across[:, None] - cx) / fx)[:, None, :]
    b = ((np.arange(first, last) + 0.5 + down[:, None] - cy) / fy)[:, :, None]
    if model.is_pinhole:
        planes = (a, b, np.ones((1, 1, 1)))
    elif model.wraps:
        planes = (np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a))
    else:
        angles = np.linspace(0, np.pi, _ANGLES)
        radius = np.hypot(a, b)
        theta = np.interp(radius, _fisheye_radius(radial, angles), angles)
        ratio = np.sin(theta) / np.maximum(radius, 1e-12)
        planes = (ratio * a, ratio * b, np.cos(theta))
    x, y, z = (np.asarray(plane, np.float32) for plane in planes)
    return x, y, z


def world_rays(
    camera: Camera, first: int, last: int, places: tuple[tuple[float, float], ...] = SAMPLES
) -> tuple[Float32, Float32, Float32]:
    """Return x, y and z of ray directions in the world, (places, rows, columns) each, of pixels in rows [first, last).

    Directions of a perspective camera have a depth of 1, other directions a length of 1.

    places: offsets x, y of each pixel's rays from its centre, in pixels.
    """
    local = _local_rays(lens_key(camera), first, last, places)
    rotation = camera.rotation.astype(np.float32)
    x, y, z = (rotation[0, k] * local[0] + rotation[1, k] * local[1] + rotation[2, k] * local[2] for k in range(3))
    return x, y, z


def rectangles(camera: Camera, low: Float64, high: Float64) -> NDArray[np.int32]:
    """Return rectangles (n, 4) of the picture that contain boxes: first row, end row, first column, end column.

    The ends are exclusive. The rectangle of a box outside the picture is empty. In a panorama columns may lie beyond
    the edges, where the picture repeats.

    low, high: (n, 3), lowest and highest corners of the boxes, relative to the camera's centre, along the world's axes.
    """
    if camera.is_pinhole:
        bounds = _flat_bounds(camera, low, high)
    elif camera.model.wraps:
        bounds = _panorama_bounds(camera, low, high)
    else:
        bounds = _fisheye_bounds(camera, low, high)
    left, right, top, bottom = bounds.T
    wide = camera.width if camera.model.wraps else 0
    edges = (
        np.clip(np.floor(top - 1), 0, camera.height),
        np.clip(np.ceil(bottom + 1), 0, camera.height),
        np.clip(np.floor(left - 1), -wide, camera.width + wide),
        np.clip(np.ceil(right + 1), -wide, camera.width + wide),
    )
    return np.stack(edges, axis=1).astype(np.int32)


_CORNERS = np.array([[(k >> axis) & 1 for axis in range(3)] for k in range(8)], np.bool_)
_EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b).bit_count() == 1])


def _flat_bounds(camera: Camera, low: Float64, high: Float64) -> Float64:
    """Return bounds (n, 4) of boxes in a perspective picture, in pixels: left, right, top, bottom.

    Parts of boxes that are nearer than the near plane do not count.

    low, high: (n, 3), lowest and highest corners of the boxes, relative to the camera's centre, along the world's axes.
    """
    corners = np.where(_CORNERS, high[:, None], low[:, None]) @ camera.rotation.T
    begins, ends = corners[:, _EDGES[:, 0]], corners[:, _EDGES[:, 1]]
    rise = ends[..., 2] - begins[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (NEAR_METRES - begins[..., 2]) / rise
        cut = begins + share[..., None] * (ends - begins)
    points = np.concatenate([corners, cut], axis=1)
    seen = np.concatenate([corners[..., 2] > NEAR_METRES, (share > 0) & (share < 1)], axis=1)
    depth = np.where(seen, np.maximum(points[..., 2], NEAR_METRES), 1.0)
    with np.errstate(invalid="ignore"):
        x = camera.cx + camera.fx * points[..., 0] / depth
        y = camera.cy + camera.fy * points[..., 1] / depth
    sides = [
        np.where(seen, values, fill).min(axis=1) if fill > 0 else np.where(seen, values, fill).max(axis=1)
        for values in (x, y)
        for fill in (1e9, -1e9)
    ]
    return np.stack(sides, axis=1)


def _cones(low: Float64, high: Float64) -> tuple[Float64, Float64]:
    """Return cones from the origin around boxes: vectors (n, 3) to the boxes' middles, and half angles (n,)."""
    middle, radius = (low + high) / 2, np.linalg.norm(high - low, axis=1) / 2
    distance = np.linalg.norm(middle, axis=1)
    inside = distance <= radius * 1.001
    return middle, np.where(inside, np.pi, np.arcsin(np.where(inside, 0.0, radius) / np.where(inside, 1.0, distance)))


def _panorama_bounds(camera: Camera, low: Float64, high: Float64) -> Float64:
    middle, angle = _cones(low, high)
    x, y, z = (middle @ camera.rotation.T).T
    level = np.hypot(x, z)
    longitude, latitude = np.arctan2(x, z), np.arctan2(y, level)
    reach = np.cos(latitude) - np.sin(np.minimum(angle, np.pi / 2))
    pole = (reach <= 0) | (np.abs(latitude) + angle >= np.pi / 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        half = np.where(pole, np.pi, np.arcsin(np.clip(np.sin(angle) / np.cos(latitude), -1, 1)))
    left, right = longitude - half, longitude + half
    left, right = np.where(pole, -np.pi, left), np.where(pole, np.pi, right)
    return np.stack(
        [
            camera.cx + camera.fx * left,
            camera.cx + camera.fx * right,
            camera.cy + camera.fy * np.maximum(latitude - angle, -np.pi / 2),
            camera.cy + camera.fy * np.minimum(latitude + angle, np.pi / 2),
        ],
        axis=1,
    )


def _fisheye_bounds(camera: Camera, low: Float64, high: Float64) -> Float64:
    middle, angle = _cones(low, high)
    axis = (middle @ camera.rotation.T) / np.maximum(np.linalg.norm(middle, axis=1), 1e-9)[:, None]
    angle = np.minimum(angle * 1.02 + 1e-3, np.pi)
    theta = np.arccos(np.clip(axis[:, 2], -1, 1))
    helper = np.where(np.abs(axis[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    across = np.cross(axis, helper)
    across /= np.linalg.norm(across, axis=1)[:, None]
    other = np.cross(axis, across)
    turn = np.linspace(0, 2 * np.pi, _CIRCLE, endpoint=False)[None, :, None]
    circle = np.cos(turn) * across[:, None] + np.sin(turn) * other[:, None]
    edge = np.cos(angle)[:, None, None] * axis[:, None] + np.sin(angle)[:, None, None] * circle
    away = np.arctan2(np.hypot(edge[..., 0], edge[..., 1]), edge[..., 2])
    radius = _fisheye_radius(camera.radial, away)
    level = np.maximum(np.hypot(edge[..., 0], edge[..., 1]), 1e-12)
    x = camera.cx + camera.fx * radius * edge[..., 0] / level
    y = camera.cy + camera.fy * radius * edge[..., 1] / level
    bounds = np.stack([x.min(axis=1), x.max(axis=1), y.min(axis=1), y.max(axis=1)], axis=1)
    whole = theta + angle >= np.pi  # the backward direction is imaged on the whole edge of the picture
    bounds[whole] = (-1e9, 1e9, -1e9, 1e9)
    return bounds


def _fisheye_radius(radial: tuple[float, ...], theta: Float64) -> Float64:
    """Return image radii, in focal lengths, at angles `theta` from the axis: eq. (18) of docs/cameras.md.

    radial: k1 to k4. With the town's values, radii increase up to 180 degrees, so that every direction has a pixel.
    """
    square, series = theta * theta, np.zeros_like(theta)
    for coefficient in reversed(radial):
        series = (series + coefficient) * square
    return theta * (1 + series)

# SPDX-License-Identifier: Apache-2.0
"""Rays through pixels and projection of points to pixels, in float64, by the formulas of clsplat/cameras/.

Equation numbers refer to docs/cameras.md.
"""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera


def cam_from_pixel(camera: Camera, pixels: Float64) -> tuple[Float64, Float64]:
    """Return origins and unit directions (N, 3), in the camera's axes, of the rays through pixels: eqs. (2) to (5).

    Pixels beyond 180 degrees from a fisheye's axis, or beyond a pole of an equirectangular image, get NaN.

    pixels: (N, 2); (0.5, 0.5) is the centre of the first pixel.
    """
    pixels = np.asarray(pixels, np.float64)
    a = (pixels[:, 0] - camera.cx) / camera.fx
    b = (pixels[:, 1] - camera.cy) / camera.fy
    return camera.model.rays_of(camera, a, b)


def pixel_from_cam(camera: Camera, points: Float64) -> tuple[Float64, Float64]:
    """Return pixels (N, 2) and depths (N,) of points (N, 3) in the camera's axes: eqs. (2) to (5).

    Points without a pixel get NaN: behind a perspective or orthographic camera, beyond the angle at which a fisheye
    folds over, or straight behind a fisheye. The near and far planes are ignored, and pixels may lie outside the image.
    """
    a, b, depths = camera.model.places_of(camera, np.asarray(points, np.float64))
    u = camera.model.wrapped(camera, camera.cx + camera.fx * a)
    return np.stack([u, camera.cy + camera.fy * b], axis=1), depths


def pixel_from_world(camera: Camera, points: Float64) -> tuple[Float64, Float64]:
    """Return pixels (N, 2) and depths (N,) of points (N, 3) in the world: eq. (1), then `pixel_from_cam`."""
    return pixel_from_cam(camera, np.asarray(points, np.float64) @ camera.rotation.T + camera.translation)


def pixel_grid(camera: Camera) -> Float64:
    """Return the centres of all pixels (height * width, 2), row by row.

    For a camera with a window, centres are relative to the whole frame.
    """
    x, y = (camera.window.x, camera.window.y) if camera.window else (0, 0)
    u, v = np.meshgrid(x + np.arange(camera.width) + 0.5, y + np.arange(camera.height) + 0.5)
    return np.stack([u.ravel(), v.ravel()], axis=1)

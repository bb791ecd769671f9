# SPDX-License-Identifier: Apache-2.0
"""Every projection in float64, pixel to ray and world to pixel: the definition. Equation numbers are those of
docs/cameras.md."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera


def cam_from_pixel(camera: Camera, pixels: Float64) -> tuple[Float64, Float64]:
    """Origins (N, 3) and unit directions (N, 3) of the rays of pixels (N, 2) in the camera's axes: eqs. (2) to (5).

    pixels: (0.5, 0.5) is the centre of the first. A pixel without a ray (a fisheye's beyond half a turn, an
    equirectangular one beyond a pole) has NaN.
    """
    pixels = np.asarray(pixels, np.float64)
    a = (pixels[:, 0] - camera.cx) / camera.fx
    b = (pixels[:, 1] - camera.cy) / camera.fy
    zero, one = np.zeros_like(a), np.ones_like(a)
    origins = np.zeros((len(a), 3))
    if camera.projection == "perspective":
        directions = np.stack([a, b, one], axis=1)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    elif camera.projection == "orthographic":
        origins = np.stack([a, b, zero], axis=1)
        directions = np.stack([zero, zero, one], axis=1)
    elif camera.projection == "fisheye":
        radius = np.hypot(a, b)
        theta = angles(camera, radius)
        # sin(theta) / theta, also on the axis; np.sinc(x) is sin(pi x) / (pi x)
        ratio = np.sinc(theta / np.pi) * np.where(radius > 0, theta / np.where(radius > 0, radius, 1.0), 1.0)
        directions = np.stack([ratio * a, ratio * b, np.cos(theta)], axis=1)
        directions[radius > camera.fold[1]] = np.nan
    else:
        directions = np.stack([np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a)], axis=1)
        directions[np.abs(b) > np.pi / 2] = np.nan
    return origins, directions


def pixel_from_cam(camera: Camera, points: Float64) -> tuple[Float64, Float64]:
    """Pixels (N, 2) and depths (N,) of points (N, 3) in the camera's axes: eqs. (2) to (5).

    A point without a pixel (behind a perspective or an orthographic camera, straight behind a fisheye, where a whole
    circle shows it, or beyond its fold-over) has NaN pixels. near and far are not looked at. A pixel may lie
    beyond the image.
    """
    x, y, z = np.asarray(points, np.float64).T
    if camera.projection == "perspective":
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = np.where(z > 0, x / z, np.nan), np.where(z > 0, y / z, np.nan)
        depths = z
    elif camera.projection == "orthographic":
        a, b = np.where(z > 0, x, np.nan), np.where(z > 0, y, np.nan)
        depths = z
    elif camera.projection == "fisheye":
        across = np.hypot(x, y)
        theta = np.arctan2(across, z)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(across > 0, radii(camera, theta)[0] / across, np.where(z > 0, 0.0, np.nan))
        if any(camera.radial):
            ratio = np.where(theta < camera.fold[0], ratio, np.nan)
        a, b = ratio * x, ratio * y
        depths = np.hypot(across, z)
    else:
        level = np.hypot(x, z)
        a, b = np.arctan2(x, z), np.arctan2(y, level)
        depths = np.hypot(level, y)
        a = np.where(depths > 0, a, np.nan)
    pixels = np.stack([camera.cx + camera.fx * a, camera.cy + camera.fy * b], axis=1)
    if camera.projection == "equirectangular":
        pixels[:, 0] = wrapped(camera, pixels[:, 0])
    return pixels, depths


def radii(camera: Camera, theta: Float64) -> tuple[Float64, Float64, Float64]:
    """Distances of a fisheye's directions from the picture's middle in focal lengths, by their angles from the axis:
    eq. (18); and the first and second derivative."""
    powers, factors = 2 * np.arange(5), np.array([1.0, *camera.radial])
    series = theta[:, None] ** powers
    radius, slope = theta * (series @ factors), series @ (factors * (powers + 1))
    bend = theta * (series[:, :4] @ (factors * (powers + 1) * powers)[1:])
    return radius, slope, bend


def angles(camera: Camera, radius: Float64) -> Float64:
    """The inverse of `radii`, by bisection; the distance itself where nothing is bent."""
    if not any(camera.radial):
        return radius
    low, high = np.zeros_like(radius), np.full_like(radius, camera.fold[0])
    for _ in range(50):
        middle = 0.5 * (low + high)
        over = radii(camera, middle)[0] > radius
        low, high = np.where(over, low, middle), np.where(over, middle, high)
    return 0.5 * (low + high)


def period(camera: Camera) -> float:
    """Pixels of a whole turn in an equirectangular image: its width, where it shows one."""
    return 2 * np.pi * camera.fx


def wrapped(camera: Camera, u: Float64) -> Float64:
    """u (N,) of an equirectangular camera moved by whole turns to at most half a turn from the image's middle: eq. (6).

    So a panorama of a whole turn has every u in [0, width), whatever its cx.
    """
    turn = period(camera)
    low = 0.5 * (camera.width - turn)
    moved: Float64 = low + np.mod(u - low, turn)
    return np.where(moved >= low + turn, low, moved)  # np.mod of a tiny negative number rounds up to `turn` itself


def pixel_from_world(camera: Camera, points: Float64) -> tuple[Float64, Float64]:
    """Pixels (N, 2) and depths (N,) of points (N, 3) in the world: eq. (1), then as `pixel_from_cam`."""
    return pixel_from_cam(camera, np.asarray(points, np.float64) @ camera.rotation.T + camera.translation)


def pixel_grid(camera: Camera) -> Float64:
    """The centres of all pixels, (height * width, 2), row by row; in the frame, where the camera has a window."""
    x, y = (camera.window.x, camera.window.y) if camera.window else (0, 0)
    u, v = np.meshgrid(x + np.arange(camera.width) + 0.5, y + np.arange(camera.height) + 0.5)
    return np.stack([u.ravel(), v.ravel()], axis=1)

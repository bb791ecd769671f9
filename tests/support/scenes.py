# SPDX-License-Identifier: Apache-2.0
"""Tiny deterministic scenes, named after the conditions that they test. Each is a pair (Gaussians, Camera)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians

Scene = tuple[Gaussians, Camera]
Limits = tuple[float, float]


def make_gaussians(
    means: Float64, quaternions: Float64, log_scales: Float64, opacities: Float64, sh: Float64
) -> Gaussians:
    """Gaussians from float64 arrays, with opacities 0 to 1 instead of logits."""
    logits = np.log(opacities) - np.log1p(-opacities)
    return Gaussians(
        np.ascontiguousarray(means, np.float32),
        np.ascontiguousarray(quaternions, np.float32),
        np.ascontiguousarray(log_scales, np.float32),
        np.ascontiguousarray(logits, np.float32),
        np.ascontiguousarray(sh, np.float32),
    )


def random_sh(rng: np.random.Generator, count: int, degree: int = 3, rest: float = 0.15) -> Float64:
    """Coefficients (count, K, 3) of colours within about 0 to 1, bands above 0 with standard deviation `rest`."""
    sh: Float64 = rng.normal(0.0, rest, (count, (degree + 1) ** 2, 3))
    sh[:, 0] = rng.uniform(-1.5, 1.5, (count, 3))
    return sh


def straight_camera(width: int, height: int, focal: float | None = None) -> Camera:
    """A camera at the world's origin that looks along +z, with a central principal point.

    focal: focal length; None means the width.
    """
    focal = float(width) if focal is None else focal
    return Camera(width, height, focal, focal, width / 2, height / 2, np.eye(3), np.zeros(3))


def tilted_camera(width: int, height: int, focal: float | None = None) -> Camera:
    """A rotated, moved camera with fx != fy and the principal point off the centre. Looks about along +z."""
    focal = float(width) if focal is None else focal
    axis = np.array([0.3, -0.5, 0.2])
    angle = 0.25
    axis = axis / np.linalg.norm(axis)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    rotation = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    position = np.array([0.1, -0.2, -0.3])
    return Camera(width, height, focal, 1.1 * focal, 0.42 * width, 0.57 * height, rotation, -rotation @ position)


def world_from_pixels(camera: Camera, pixels: Float64, depths: Float64) -> Float64:
    """World points (N, 3) that `camera` sees at pixels (N, 2) and depths (N,)."""
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    p = np.concatenate([(pixels - centre) / focal * depths[:, None], depths[:, None]], axis=1)
    points: Float64 = (p - camera.translation) @ camera.rotation
    return points


def one(width: int = 48, height: int = 32) -> Scene:
    """A single anisotropic Gaussian near the middle."""
    gaussians = make_gaussians(
        np.array([[0.1, -0.05, 4.0]]),
        np.array([[0.8, 0.1, -0.3, 0.5]]),
        np.log([[0.5, 0.2, 0.1]]),
        np.array([0.7]),
        random_sh(np.random.default_rng(1), 1),
    )
    return gaussians, straight_camera(width, height)


def overlap(count: int = 40, width: int = 40, height: int = 30, seed: int = 4) -> Scene:
    """Anisotropic overlapping Gaussians with quaternions of any length, and the tilted camera.

    A fifth has means outside the image, where the Jacobian's ratios are clamped, and reaches into it.
    """
    rng = np.random.default_rng(seed)
    camera = tilted_camera(width, height)
    size = np.array([width, height])
    pixels = rng.uniform(-0.05, 1.05, (count, 2)) * size
    depths = rng.uniform(2.0, 6.0, count)
    log_scales = np.log(depths[:, None] / camera.fx * rng.uniform(0.7, 6.0, (count, 3)))
    outside = count // 5
    angles = rng.uniform(0, 2 * np.pi, outside)
    side = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    side /= np.abs(side).max(axis=1, keepdims=True)
    pixels[:outside] = (0.5 + 0.72 * side) * size
    log_scales[:outside] += np.log(3.0)
    quaternions = rng.normal(size=(count, 4)) * rng.uniform(0.3, 3.0, (count, 1))
    sh = random_sh(rng, count)
    opacities = rng.uniform(0.05, 0.9, count)
    return make_gaussians(world_from_pixels(camera, pixels, depths), quaternions, log_scales, opacities, sh), camera


def _placed(
    rng: np.random.Generator, camera: Camera, pixels: Float64, depths: Float64, axes: Float64, opacities: Limits
) -> Scene:
    """Gaussians at pixels (N, 2) and depths (N,), with axes (N, 3) in pixels and opacities from a range."""
    log_scales = np.log(depths[:, None] / camera.fx * axes)
    sh = random_sh(rng, len(depths))
    opaque = rng.uniform(*opacities, len(depths))
    means, quaternions = world_from_pixels(camera, pixels, depths), rng.normal(size=(len(depths), 4))
    return make_gaussians(means, quaternions, log_scales, opaque, sh), camera


def many_per_tile(count: int = 500, width: int = 48, height: int = 32) -> Scene:
    """Gaussians with all means in the tile at pixel (16, 0), so faint that most of them are blended."""
    rng = np.random.default_rng(5)
    pixels = np.array([16.0, 0.0]) + rng.uniform(1.0, 15.0, (count, 2))
    depths = rng.uniform(1.0, 9.0, count)
    axes = rng.uniform(0.5, 3.0, (count, 3))
    return _placed(rng, straight_camera(width, height), pixels, depths, axes, (0.006, 0.12))


def saturating(count: int = 60, width: int = 40, height: int = 36) -> Scene:
    """Nearly opaque layers. Alpha is clamped at 0.99, and pixels become opaque after different numbers of Gaussians."""
    rng = np.random.default_rng(6)
    pixels = rng.uniform(0.1, 0.9, (count, 2)) * np.array([width, height])
    axes = rng.uniform(3.0, 9.0, (count, 3))
    return _placed(rng, straight_camera(width, height), pixels, np.linspace(1.5, 5.0, count), axes, (0.9, 0.9999))


def off_frustum(count: int = 64, width: int = 40, height: int = 30) -> Scene:
    """Gaussians outside the frustum, behind the camera and near the near plane; some reach into the image.

    Many are beyond the clamp of the Jacobian. An eighth has opacities around 1/255.
    """
    rng = np.random.default_rng(7)
    camera = tilted_camera(width, height)
    angles = rng.uniform(0, 2 * np.pi, count)
    pixels = np.array([width, height]) * (
        0.5 + rng.uniform(0.6, 3.0, (count, 1)) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    )
    depths = rng.uniform(1.0, 4.0, count)
    depths[: count // 4] *= -1
    depths[count // 4 : count // 2] = camera.near * np.linspace(0.2, 2.0, count // 2 - count // 4)
    log_scales = np.log(np.abs(depths)[:, None] / camera.fx * rng.uniform(3.0, 25.0, (count, 3)))
    opacities = rng.uniform(0.1, 0.9, count)
    opacities[::8] = rng.uniform(0.5, 1.5, len(opacities[::8])) / 255
    sh = random_sh(rng, count)
    means = world_from_pixels(camera, pixels, depths)
    return make_gaussians(means, rng.normal(size=(count, 4)), log_scales, opacities, sh), camera


def needles(count: int = 48, width: int = 64, height: int = 48) -> Scene:
    """Needles with axis ratios around 10,000. Only the low-pass filter keeps their 2D covariances invertible."""
    rng = np.random.default_rng(8)
    pixels = rng.uniform(0.0, 1.0, (count, 2)) * np.array([width, height])
    depths = rng.uniform(2.0, 6.0, count)
    axes = np.array([100.0, 0.01, 0.01]) * rng.uniform(0.2, 2.0, (count, 3))
    return _placed(rng, tilted_camera(width, height), pixels, depths, axes, (0.1, 0.9))


def equal_depth(count: int = 40, width: int = 40, height: int = 32) -> Scene:
    """Overlapping Gaussians at exactly the same float32 depth, so that only their indices order them."""
    rng = np.random.default_rng(9)
    pixels = rng.uniform(0.2, 0.8, (count, 2)) * np.array([width, height])
    axes = rng.uniform(1.0, 5.0, (count, 3))
    return _placed(rng, straight_camera(width, height), pixels, np.full(count, 3.0), axes, (0.2, 0.9))


def random_cloud(count: int, seed: int, width: int, height: int, degree: int = 3) -> Scene:
    """Gaussians like those of a trained scene: log-normal sizes, all opacities, and means in and around the image."""
    rng = np.random.default_rng(seed)
    camera = tilted_camera(width, height)
    pixels = rng.uniform(-0.1, 1.1, (count, 2)) * np.array([width, height])
    depths = rng.uniform(1.0, 10.0, count)
    pixels_per_axis = np.sqrt(width * height / max(count, 1)) * 0.5
    sizes = pixels_per_axis * np.exp(rng.normal(0.0, 0.6, (count, 1)) + rng.normal(0.0, 0.6, (count, 3)))
    log_scales = np.log(depths[:, None] / camera.fx * sizes)
    quaternions = rng.normal(size=(count, 4)) * rng.uniform(0.5, 2.0, (count, 1))
    sh = random_sh(rng, count, degree)
    opacities = rng.beta(0.8, 0.8, count) * 0.994 + 0.003
    return make_gaussians(world_from_pixels(camera, pixels, depths), quaternions, log_scales, opacities, sh), camera


def in_float64(gaussians: Gaussians) -> Gaussians:
    """The Gaussians in float64, so that the step of a difference quotient is not rounded away."""
    arrays: dict[str, Any] = {name: np.asarray(values, np.float64) for name, values in gaussians.arrays().items()}
    return replace(gaussians, **arrays)


def antialiased(scene: Scene) -> Scene:
    """The scene with an antialiased model."""
    return replace(scene[0], antialiased=True), scene[1]


def orthographic(scene: Scene, middle: float = 4.0) -> Scene:
    """The scene with an orthographic camera, which shows the plane at the depth `middle` at the same size."""
    gaussians, camera = scene
    return gaussians, replace(camera, fx=camera.fx / middle, fy=camera.fy / middle, projection="orthographic")


NAMED: dict[str, Callable[[], Scene]] = {
    "one": one,
    "overlap": overlap,
    "many_per_tile": many_per_tile,
    "saturating": saturating,
    "off_frustum": off_frustum,
    "needles": needles,
    "equal_depth": equal_depth,
    "random_cloud": lambda: random_cloud(300, 11, 70, 50),
}
"""All scenes by name, as functions without arguments, for `pytest.mark.parametrize`."""

ANTIALIASED = {f"antialiased {name}": lambda make=make: antialiased(make()) for name, make in NAMED.items()}
"""The scenes of NAMED with antialiased models, by name."""

SHAPE_MATTERS = ("overlap", "many_per_tile", "saturating")
"""Scenes for which kernels differ by shape: their tiles have several batches, or pixels that become opaque."""

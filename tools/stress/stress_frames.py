# SPDX-License-Identifier: Apache-2.0
"""Stress test of blending and its gradient: compare tiny frames and crops of large ones with the twin, per pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pipeline import BACKGROUND, Pipeline
from stress_cases import DEGREE, Cloud, camera_of
from stress_projection import in_order

from clsplat.camera import Camera
from clsplat.device.context import Device
from clsplat.gaussians import Gaussians
from clsplat.reference import render as reference
from clsplat.reference.blend import blend
from clsplat.reference.project import project
from clsplat.reference.render import parameters

Array = NDArray[Any]
Scene = tuple[Gaussians, Camera]
GROUPS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
BAND = 1e-4
"""Relative distance of alpha or transmittance from a threshold within which float32 may decide differently. Pixels with
such a decision are in the band."""


def scene_of(
    rng: np.random.Generator, count: int, width: int, height: int, *, low: float = 0.5, high: float = 6.0
) -> tuple[Cloud, Camera]:
    """Gaussians all over an image of this size, with axes of `low` to `high` pixels."""
    camera = replace(camera_of(rng), width=width, height=height, fx=50.0, fy=55.0)
    camera = replace(camera, cx=width * rng.uniform(0.3, 0.7), cy=height * rng.uniform(0.3, 0.7))
    cloud = Cloud(
        camera=camera,
        pixels=rng.uniform(-0.1, 1.1, (count, 2)) * (width, height),
        depths=rng.uniform(1.0, 10.0, count),
        axes=np.exp(rng.uniform(np.log(low), np.log(high), (count, 3))),
        quaternions=rng.normal(size=(count, 4)),
        logits=rng.normal(0.0, 2.0, count),
        sh=rng.normal(0.0, 0.4, (count, (DEGREE + 1) ** 2, 3)),
    )
    return cloud, camera


def _made(cloud: Cloud) -> Scene:
    return cloud.gaussians(), cloud.camera


def counts(rng: np.random.Generator) -> Scene:
    """A number of Gaussians around a power of two: 2^k - 1, 2^k or 2^k + 1."""
    count = max(0, 2 ** int(rng.integers(0, 10)) + int(rng.integers(-1, 2)))
    return _made(scene_of(rng, count, 40, 24)[0])


def sizes(rng: np.random.Generator) -> Scene:
    """An image of a size such as 1x1, 1xN or Nx1. Most sizes are not multiples of a tile."""
    width, height = (int(rng.choice([1, 1, 2, 15, 16, 17, 31, 33, 50])) for _ in range(2))
    return _made(scene_of(rng, 48, width, height)[0])


def equal_depth(rng: np.random.Generator) -> Scene:
    cloud, camera = scene_of(rng, 64, 32, 32)
    cloud.camera = replace(camera, rotation=np.eye(3), translation=np.zeros(3))  # else rounding makes depths differ
    cloud.depths[:] = rng.choice([1.0, 3.0, 1e4])
    return _made(cloud)


def saturated(rng: np.random.Generator) -> Scene:
    """Gaussians with alphas at the cap, so that pixels become opaque before the end of their lists."""
    cloud, _ = scene_of(rng, 64, 32, 24, low=2.0, high=12.0)
    cloud.logits = rng.uniform(2, 30, 64)
    return _made(cloud)


def faint(rng: np.random.Generator) -> Scene:
    """Many layers of Gaussians with alphas around 1/255."""
    cloud, _ = scene_of(rng, 400, 24, 24, low=2.0, high=12.0)
    cloud.logits = np.log(rng.uniform(0.8, 3, 400) / 254)
    return _made(cloud)


def needles(rng: np.random.Generator) -> Scene:
    cloud, _ = scene_of(rng, 64, 64, 40)
    cloud.axes = np.array([60.0, 0.01, 0.01]) * rng.uniform(0.2, 2, (64, 3))
    return _made(cloud)


def one_pixel(rng: np.random.Generator) -> Scene:
    """10,000 Gaussians with means on one pixel."""
    cloud, _ = scene_of(rng, 10_000, 20, 20, low=0.2, high=2.0)
    cloud.pixels = 10 + rng.uniform(0.4, 0.6, (10_000, 2))
    cloud.logits = rng.uniform(-5.5, -3, 10_000)
    return _made(cloud)


def whole_image(rng: np.random.Generator) -> Scene:
    """Two Gaussians that are larger than the image, one before or behind all the others, and many small ones."""
    cloud, _ = scene_of(rng, 40, 100, 70)
    cloud.axes[:2] = 10 ** rng.uniform(2, 4, (2, 3))
    cloud.depths[0] = rng.choice([0.5, 20.0])
    return _made(cloud)


def off_frustum(rng: np.random.Generator) -> Scene:
    """Gaussians with means outside the image or behind the camera, many of which reach into the image."""
    cloud, _ = scene_of(rng, 64, 40, 30, low=5.0, high=60.0)
    angle = rng.uniform(0, 2 * np.pi, 64)
    aside = 0.5 + rng.uniform(0.6, 2.5, (64, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    cloud.pixels = aside * (40, 30)
    cloud.depths[:8] *= -1
    return _made(cloud)


def bright(rng: np.random.Generator) -> Scene:
    """Gaussians with colours far outside [0, 1]."""
    cloud, _ = scene_of(rng, 64, 32, 24)
    cloud.sh *= 10 ** rng.uniform(0, 6, (64, 1, 1))
    return _made(cloud)


_ALL = (counts, sizes, equal_depth, saturated, faint, needles, one_pixel, whole_image, off_frustum, bright)
SCENES = {make.__name__: make for make in _ALL}


@dataclass(frozen=True, eq=False)
class FrameOutcome:
    """Comparison of a frame with its twin.

    image: largest difference of a pixel outside the band, relative to the frame's largest colour.
    pixels, band: number of pixels, and of pixels in the band.
    flips: largest relative difference of a pixel in the band.
    norms: by parameter group, the sums of |difference|^2 and |wanted|^2.
    each: by parameter group, the relative error of each Gaussian's gradient.
    finite: True if image and gradients are finite.
    """

    image: float
    pixels: int
    band: int
    flips: float
    norms: dict[str, tuple[float, float]]
    each: dict[str, Array]
    finite: bool


def compare(device: Device, scene: Scene, rng: np.random.Generator) -> FrameOutcome:
    """Compare a frame with its twin, and its gradient for a random image gradient that is 0 in the band."""
    gaussians, camera = scene
    run = Pipeline.run(device, scene)
    image = run.image
    wanted = reference.forward(gaussians, camera, BACKGROUND)
    blended = wanted.blended
    assert blended.margin is not None
    band = blended.margin < BAND
    scale = max(1.0, float(wanted.projected.colors.max(initial=0)))
    error = np.abs(image - blended.image).max(axis=2) / scale
    d_image = rng.normal(size=(camera.height, camera.width, 3))
    d_image[band] = 0
    got, _ = run.backward(d_image)
    by = reference.render_grad(gaussians, camera, d_image, BACKGROUND)
    norms, each = {}, {}
    finite = bool(np.isfinite(image).all())
    for name in GROUPS:
        found, want = getattr(got, name).astype(float), by.parameters[name]
        finite &= bool(np.isfinite(found).all())
        inner = tuple(range(1, want.ndim))
        off, size = np.sqrt(((found - want) ** 2).sum(axis=inner)), np.sqrt((want**2).sum(axis=inner))
        norms[name] = (float((off**2).sum()), float((size**2).sum()))
        each[name] = off[size > 0] / size[size > 0]
    out = error[~band].max(initial=0.0), int(band.size), int(band.sum()), error[band].max(initial=0.0)
    return FrameOutcome(float(out[0]), out[1], out[2], float(out[3]), norms, each, finite)


def compare_8k(device: Device, rng: np.random.Generator, *, count: int = 2000, crops: int = 12) -> FrameOutcome:
    """Compare crops of a frame of 7680 x 4320 with the twin. Gradients do not depend on the size, and are left out."""
    width, height, side = 7680, 4320, 64
    cloud, _ = scene_of(rng, count, width, height, low=0.5, high=200.0)
    cloud.camera = replace(cloud.camera, fx=6000.0, fy=6100.0)
    cloud.axes[:2] = 10 ** rng.uniform(3, 4, (2, 3))
    scene = _made(cloud)
    image = Pipeline.run(device, scene).image
    projected = project(*in_order(parameters(scene[0])), scene[1], DEGREE)
    worst = flips = 0.0
    band = 0
    scale = max(1.0, float(projected.colors.max()))
    for _ in range(crops):
        x, y = (int(rng.choice(np.array([0, size - side, rng.integers(0, size - side)]))) for size in (width, height))
        moved = replace(projected, means2d=projected.means2d - (x, y))
        blended = blend(moved, side, side, BACKGROUND)
        assert blended.margin is not None
        near = blended.margin < BAND
        error = np.abs(image[y : y + side, x : x + side] - blended.image).max(axis=2) / scale
        worst, flips = max(worst, float(error[~near].max())), max(flips, float(error[near].max(initial=0)))
        band += int(near.sum())
    return FrameOutcome(worst, crops * side * side, band, flips, {}, {}, bool(np.isfinite(image).all()))

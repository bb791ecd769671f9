# SPDX-License-Identifier: Apache-2.0
"""Frozen scenes of the self-test: synthetic models and cameras that have the same bits on every machine.

All numbers come from an integer hash and are multiples of a power of two. So they do not depend on NumPy's generators
or on mathematical libraries. The digests in digests.json belong to these scenes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.gaussians import Gaussians
from clsplat.stages.device_camera import padded_size

HASH_STEPS = 1 << 12
"""Number of equally spaced values from which `evenly` chooses."""


def hashed(seed: int, count: int) -> NDArray[np.uint64]:
    """Random numbers (count,) uint64: a part of the sequence of SplitMix64 (Steele, Lea and Flood 2014)."""
    with np.errstate(over="ignore"):
        z = (np.arange(1, count + 1, dtype=np.uint64) + np.uint64(seed << 32)) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))


def evenly(seed: int, shape: tuple[int, ...], low: float, high: float, steps: int = HASH_STEPS) -> NDArray[np.float64]:
    """Random numbers in [low, high) with few binary digits, so that each is exact in float32.

    steps: number of equally spaced values from which numbers are chosen.
    """
    values = (hashed(seed, int(np.prod(shape))) >> np.uint64(20)) % np.uint64(steps)
    return low + (high - low) / steps * values.astype(np.float64).reshape(shape)


def keys(seed: int, count: int, bits: int) -> NDArray[np.uint32]:
    """Sort keys (count,) of `bits` bits; each value occurs about three times."""
    pool = (hashed(seed, count // 3 + 1) >> np.uint64(64 - bits)).astype(np.uint32)
    return pool[(hashed(seed + 1, count) % np.uint64(len(pool))).astype(np.int64)]


@dataclass(frozen=True, eq=False)
class Frozen:
    """A frozen scene: a model, a camera that views it, a background colour, and a photograph for the loss.

    photograph: planes (3, rows, stride), zero in the padding.
    """

    name: str
    gaussians: Gaussians
    camera: Camera
    background: Float32
    photograph: Float32


def padded(camera: Camera, seed: int, low: float, high: float) -> Float32:
    """Planes (3, rows, stride) of random values in [low, high), with zeros in the padding."""
    height, width = camera.height, camera.width
    planes = np.zeros((3, *padded_size(width, height)), np.float32)
    planes[:, :height, :width] = evenly(seed, (3, height, width), low, high)
    return planes


def cloud(name: str, count: int, width: int, height: int, seed: int) -> Frozen:
    """A scene of Gaussians of all sizes, orientations and opacities, inside and around the view of a tilted camera.

    The principal point is not in the middle. Some Gaussians are behind the camera, some at its near plane, and some
    have an opacity below 1/255. The SH degree is 3.
    """
    unit = 0.125
    z = evenly(seed, (count,), 1.5, 8.5)
    sides = evenly(seed + 1, (count, 2), -0.75, 0.75)
    means = np.stack([z * sides[:, 0], z * sides[:, 1] * 0.75, z], axis=1)
    means[: count // 16, 2] *= -1
    means[count // 16 : count // 8, 2] *= unit * unit
    log_scales = evenly(seed + 2, (count, 1), -4.0, -1.5) + evenly(seed + 3, (count, 3), -1.0, 1.0)
    quaternions = evenly(seed + 4, (count, 4), -1.0, 1.0)
    quaternions[:, 0] = evenly(seed + 5, (count,), 0.25, 1.25)
    sh = evenly(seed + 6, (count, 16, 3), -0.25, 0.25)
    sh[:, 0] = evenly(seed + 7, (count, 3), -1.5, 1.5)
    model = _gaussians(means, quaternions, log_scales, evenly(seed + 8, (count,), -6.5, 5.0), sh)
    translation = np.array([unit, -2 * unit, 4 * unit])
    camera = Camera(width, height, width, width + 4.0, 0.4375 * width, 0.5625 * height, _rotation(), translation)
    return _frozen(name, model, camera)


def wall() -> Frozen:
    """A scene of nearly opaque layers, two at each depth.

    Alpha reaches its cap, pixels become opaque after a few layers, and Gaussians of equal depth are ordered by index.
    """
    count, width, height = 64, 40, 36
    depths = 1.5 + 0.0625 * (np.arange(count) // 2)
    sides = evenly(11, (count, 2), -0.5, 0.5)
    means = np.stack([depths * sides[:, 0], depths * sides[:, 1], depths], axis=1)
    log_scales = evenly(12, (count, 3), -2.5, -0.5)
    quaternions = evenly(13, (count, 4), -1.0, 1.0)
    quaternions[:, 0] = evenly(14, (count,), 0.25, 1.25)
    sh = evenly(15, (count, 4, 3), -0.25, 0.25)
    sh[:, 0] = evenly(16, (count, 3), -1.5, 1.5)
    model = _gaussians(means, quaternions, log_scales, evenly(17, (count,), 2.0, 9.0), sh)
    camera = Camera(width, height, float(width), float(width), width / 2, height / 2, np.eye(3), np.zeros(3))
    return _frozen("wall", model, camera)


def scenes(*, quick: bool) -> list[Frozen]:
    """The frozen scenes on which the self-test runs: two if `quick`, otherwise three."""
    few = [cloud("cloud", 240, 70, 45, 1), wall()]
    return few if quick else [*few, cloud("crowd", 1500, 120, 75, 41)]


def _frozen(name: str, model: Gaussians, camera: Camera) -> Frozen:
    return Frozen(name, model, camera, np.array([0.125, 0.25, 0.5], np.float32), padded(camera, 32, 0.0, 1.0))


def _gaussians(*arrays: NDArray[np.float64]) -> Gaussians:
    means, quaternions, log_scales, opacity_logits, sh = (np.ascontiguousarray(values, np.float32) for values in arrays)
    return Gaussians(means, quaternions, log_scales, opacity_logits, sh)


def _rotation() -> NDArray[np.float64]:
    """The rotation matrix of the quaternion (15, 2, -3, 1), w first. Each entry is a quotient of integers."""
    return np.array([[219, -42, -86], [18, 229, -66], [94, 54, 213]]) / 239

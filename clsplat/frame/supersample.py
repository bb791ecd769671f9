# SPDX-License-Identifier: Apache-2.0
"""Supersampling: a larger frame, filtered."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import Camera
from clsplat.config.pictures import Filter, FramingConfig
from clsplat.errors import InputError
from clsplat.frame.draw import Draw, Planes, in_two
from clsplat.frame.window import crop

_RADII: dict[Filter, float] = {"box": 0.5, "blackman-harris": 1.5}


def filter_taps(config: FramingConfig) -> NDArray[np.float32]:
    """Weights of the samples across a pixel and its margins, symmetric; they add up to 1."""
    samples, radius = config.supersample, _RADII[config.filter]
    margin = samples * _margin(config)
    at = (np.arange(-margin, samples + margin) + 0.5) / samples - 0.5
    if config.filter == "box":
        weights = np.ones(len(at))
    else:
        turn = np.pi * (at / radius + 1)
        weights = 0.35875 - 0.48829 * np.cos(turn) + 0.14128 * np.cos(2 * turn) - 0.01168 * np.cos(3 * turn)
    return np.asarray(weights / weights.sum(), np.float32)


def _margin(config: FramingConfig) -> int:
    """Pixels beyond the picture that its filter looks at."""
    return int(np.ceil(_RADII[config.filter] - 0.5))


def finer(camera: Camera, config: FramingConfig) -> Camera:
    """The camera that a supersampled picture is drawn with: larger, with the margin that its filter looks at.

    Raises InputError for a panorama, which has nothing around it, where the filter looks beyond a pixel.
    """
    margin, samples = _margin(config), config.supersample
    if margin == 0:
        return camera.resized(camera.width * samples, camera.height * samples)
    if camera.projection == "equirectangular":
        raise InputError(f"--filter {config.filter}: needs pixels beyond a panorama's edges, expected box")
    padded = crop(camera, -margin, -margin, camera.width + 2 * margin, camera.height + 2 * margin)
    return padded.resized(padded.width * samples, padded.height * samples)


def supersampled(draw: Draw, config: FramingConfig) -> Draw:
    """rgb and alpha from a frame `supersample` times larger, filtered; other channels as without.

    `draw` has to give rgb in linear light: what falls on a pixel adds up in that alone. The sums are in the same order
    wherever the picture is in its frame.
    """
    samples = config.supersample
    if samples == 1:
        return draw
    taps = filter_taps(config)

    def shrunk(plane: Float32, axis: int, size: int) -> Float32:
        parts = [slice(None)] * plane.ndim
        total: Float32 | None = None
        for at, weight in enumerate(taps):
            parts[axis] = slice(at, at + samples * (size - 1) + 1, samples)
            part = weight * plane[tuple(parts)]
            total = part if total is None else total + part
        assert total is not None
        return total

    def filtered(camera: Camera, names: Collection[str]) -> Planes:
        planes = draw(finer(camera, config), names)
        return {name: shrunk(shrunk(plane, 0, camera.height), 1, camera.width) for name, plane in planes.items()}

    return in_two(filtered, draw)

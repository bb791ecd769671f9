# SPDX-License-Identifier: Apache-2.0
"""Pairs of pictures that hurt, and their planes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.stages.device_camera import padded_size

Array = NDArray[Any]


def pictures(rng: np.random.Generator) -> tuple[Array, Array]:
    """A render and a photograph: noise, flat, dark, nearly the same."""
    height, width = (int(rng.choice([1, 5, 16, 17, 40])) for _ in range(2))
    y = rng.random((height, width, 3)) ** rng.choice([0.2, 1.0, 8.0])
    if rng.random() < 0.3:
        y[:] = rng.random(3)
    apart = 10 ** rng.uniform(-4, 0)
    x = np.clip(y + rng.normal(0, apart, y.shape), 0, 1.5)
    return x.astype(np.float32), np.clip(y, 0, 1).astype(np.float32)


def padded(image: Array) -> Array:
    """Planes (C, rows, stride) of an image (H, W, C), whole tiles, zero right of it and below."""
    height, width, channels = image.shape
    planes = np.zeros((channels, *padded_size(width, height)), np.float32)
    planes[:, :height, :width] = image.transpose(2, 0, 1)
    return planes


def cropped(planes: Array, height: int, width: int) -> Array:
    """The image (H, W, C) in planes."""
    return planes[:, :height, :width].transpose(1, 2, 0)

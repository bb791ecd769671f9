# SPDX-License-Identifier: Apache-2.0
"""Alpha: colours with and without it multiplied in, and over a background."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32

Image = NDArray[Any]


def background_colour(name: str) -> tuple[float, float, float]:
    """The colour behind held-out views: white, or black also for "random"."""
    return (1.0, 1.0, 1.0) if name == "white" else (0.0, 0.0, 0.0)


def composite(image: Image, background: ArrayLike) -> Image:
    """(H, W, 3) floats: the image, with straight alpha if it has four channels, over the colour `background` (3,)."""
    pixels: Image = image
    if np.issubdtype(image.dtype, np.integer):
        pixels = image.astype(np.float32) / np.iinfo(image.dtype).max
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[:, :, 3:]
    over: Image = pixels[:, :, :3] * alpha + np.asarray(background, pixels.dtype) * (1 - alpha)
    return over


def associate(image: Float32) -> Float32:
    """(H, W, 4) with straight alpha to premultiplied."""
    return np.concatenate([image[:, :, :3] * image[:, :, 3:], image[:, :, 3:]], axis=2)


def unassociate(image: Float32) -> Float32:
    """(H, W, 4) with premultiplied alpha to straight. Colour without any alpha is kept as it is."""
    alpha = image[:, :, 3:]
    return np.concatenate([image[:, :, :3] / np.where(alpha > 0, alpha, np.float32(1)), alpha], axis=2)

# SPDX-License-Identifier: Apache-2.0
"""Conversion between straight and premultiplied alpha, and compositing over a background."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.arrays import Float32

Image = NDArray[Any]


def background_colour(name: str) -> tuple[float, float, float]:
    """Return the background colour of held-out views: white for "white", black for any other name such as "random"."""
    return (1.0, 1.0, 1.0) if name == "white" else (0.0, 0.0, 0.0)


def composite(image: Image, background: ArrayLike) -> Image:
    """Composite an image over the colour `background` (3,), by straight alpha in its fourth channel if it has one.

    Returns floats (H, W, 3); integers are scaled to [0, 1].
    """
    pixels: Image = image
    if np.issubdtype(image.dtype, np.integer):
        pixels = image.astype(np.float32) / np.iinfo(image.dtype).max
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[:, :, 3:]
    over: Image = pixels[:, :, :3] * alpha + np.asarray(background, pixels.dtype) * (1 - alpha)
    return over


def associate(image: Float32) -> Float32:
    """Premultiply the colours of an image (H, W, 4) by its straight alpha."""
    return np.concatenate([image[:, :, :3] * image[:, :, 3:], image[:, :, 3:]], axis=2)


def unassociate(image: Float32) -> Float32:
    """Convert an image (H, W, 4) from premultiplied to straight alpha. Colours with alpha 0 do not change."""
    alpha = image[:, :, 3:]
    return np.concatenate([image[:, :, :3] / np.where(alpha > 0, alpha, np.float32(1)), alpha], axis=2)

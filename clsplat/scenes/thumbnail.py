# SPDX-License-Identifier: Apache-2.0
"""Thumbnails and sharpness of photographs, from which `clsplat.scenes.analysis` derives findings about a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32

THUMBNAIL_SIDE_PX = 96
"""Maximum longer side of a thumbnail in pixels. It suffices, as findings concern large parts of a picture."""
SHARPNESS_SIDE_PX = 800
"""Longer side in pixels at which sharpness is measured. Blur that is invisible at this size is invisible in training
too."""
SHARPNESS_SCALE_RATIO = 4
"""Ratio of the two scales whose gradients are compared to measure sharpness."""
REC601_LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue in Rec. 601 luma."""


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A thumbnail and measurements of its photograph.

    pixels: (h, w, 3), colours as stored.
    transparent: fraction of the photograph's pixels that are transparent.
    sharpness: result of `sharpness_of`.
    """

    pixels: Float32
    transparent: float
    sharpness: float


def thumbnail_of(image: Float32) -> Thumbnail:
    """Compute the thumbnail of a picture (H, W, 3 or 4)."""
    middle = reduced(image[:, :, :3], SHARPNESS_SIDE_PX)
    transparent = float((image[:, :, 3] < 0.5).mean()) if image.shape[2] == 4 else 0.0
    return Thumbnail(reduced(middle, THUMBNAIL_SIDE_PX), transparent, sharpness_of(middle @ REC601_LUMA))


def reduced(image: Float32, side: int) -> Float32:
    """Downscale an image by an integer factor to a longer side of at most `side` pixels, by averaging pixels."""
    factor = -(-max(image.shape[:2]) // side)
    if factor == 1:
        return image
    height, width = (max(length // factor, 1) for length in image.shape[:2])
    if min(image.shape[:2]) < factor:
        return np.ascontiguousarray(image[::factor, ::factor])
    cut = image[: height * factor, : width * factor]
    down = np.add.reduce(cut.reshape(height, factor, width * factor, -1), axis=1)
    across = np.add.reduce(down.reshape(height, width, factor, -1), axis=2)
    return np.asarray(across / np.float32(factor * factor), np.float32)


def sharpness_of(grey: NDArray[np.float32]) -> float:
    """Return the sharpness of a grey picture (H, W): its mean gradient, relative to that of a smaller copy.

    The copy is SHARPNESS_SCALE_RATIO times smaller. Sharpness is 1 / SHARPNESS_SCALE_RATIO for a smooth picture and
    larger for a sharper one, nearly independent of content and brightness. It is 1 for a featureless picture.
    """
    coarse = reduced(grey[:, :, None], max(max(grey.shape) // SHARPNESS_SCALE_RATIO, 1))[:, :, 0]
    if min(coarse.shape) < 2:
        return 1.0
    fine, rough = (sum(float(np.abs(np.diff(each, axis=axis)).mean()) for axis in (0, 1)) for each in (grey, coarse))
    return fine / rough if rough > 1e-4 else 1.0

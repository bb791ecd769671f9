# SPDX-License-Identifier: Apache-2.0
"""A glance at a photograph: what is kept of its pixels for findings about the scene (`clsplat.scenes.findings`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32

SIDE = 96
"""Pixels of the longer side, at most: a finding is about large parts of a picture."""
SHARP_SIDE = 800
"""Pixels of the longer side at which sharpness is measured: blur that is lost in them is lost in training too."""
COARSER = 4
"""Factor between the two scales whose differences are compared for it."""
GREY = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, eq=False)
class Glance:
    """pixels (h, w, 3), small, as stored; transparent: share of pixels that are; sharpness: see `sharpness_of`."""

    pixels: Float32
    transparent: float
    sharpness: float


def glance_at(image: Float32) -> Glance:
    """A glance at a picture (H, W, 3 or 4)."""
    middle = reduced(image[:, :, :3], SHARP_SIDE)
    transparent = float((image[:, :, 3] < 0.5).mean()) if image.shape[2] == 4 else 0.0
    return Glance(reduced(middle, SIDE), transparent, sharpness_of(middle @ GREY))


def reduced(image: Float32, side: int) -> Float32:
    """The means of whole squares of pixels, so that the longer side has at most `side`."""
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
    """Differences of neighbouring pixels (H, W) by those of a picture COARSER times smaller: 1 / COARSER where all is
    smooth, more the sharper it is, whatever it shows and however bright it is. 1 where there is nothing to see."""
    coarse = reduced(grey[:, :, None], max(max(grey.shape) // COARSER, 1))[:, :, 0]
    if min(coarse.shape) < 2:
        return 1.0
    fine, rough = (sum(float(np.abs(np.diff(each, axis=axis)).mean()) for axis in (0, 1)) for each in (grey, coarse))
    return fine / rough if rough > 1e-4 else 1.0

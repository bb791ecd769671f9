# SPDX-License-Identifier: Apache-2.0
"""Masks of a view's pixels that show the region of a training. They follow the camera, not the photograph's file."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Bool


@dataclass(frozen=True)
class RegionMask:
    """Mask of the undistorted picture's pixels that a training of a region uses, compressed in main memory.

    width, height: size of the mask in pixels. It is applied to pictures of any size.
    packed: the mask's bits, compressed by zlib.
    """

    width: int
    height: int
    packed: bytes

    @classmethod
    def of(cls, pixels: Bool) -> RegionMask:
        """Compress a mask (H, W), True for pixels that are used."""
        height, width = pixels.shape
        return cls(width, height, zlib.compress(np.packbits(pixels).tobytes(), level=1))

    def pixels(self, width: int, height: int) -> Bool:
        """The mask (height, width) at another size: that of the nearest pixel."""
        bits = np.frombuffer(zlib.decompress(self.packed), np.uint8)
        own = np.unpackbits(bits, count=self.width * self.height).reshape(self.height, self.width).astype(np.bool_)
        rows = (2 * np.arange(height) + 1) * self.height // (2 * height)
        columns = (2 * np.arange(width) + 1) * self.width // (2 * width)
        return np.asarray(own[np.ix_(rows, columns)])

    def masked(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return a decoded photograph (H, W, 3 to 5), as `training.supervision.decoding.stored` makes it, with five
        channels and zeros in pixels that are not used.

        image: uint8 or float32.
        """
        height, width, channels = image.shape
        one = np.full((height, width, 1), 255 if image.dtype == np.uint8 else 1, image.dtype)
        whole = np.concatenate([image, *[one] * (5 - channels)], axis=2)
        whole[~self.pixels(width, height)] = 0
        return whole

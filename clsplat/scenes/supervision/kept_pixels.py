# SPDX-License-Identifier: Apache-2.0
"""Masks that follow the camera, not the photograph's file: pixels of an undistorted picture that a training keeps."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Bool, Float32


@dataclass(frozen=True)
class KeptPixels:
    """Mask of the pixels of a view that a training keeps, compressed in main memory.

    width, height: size of the mask in pixels. It is applied to pictures of any size.
    packed: the mask's bits, compressed by zlib.
    """

    width: int
    height: int
    packed: bytes

    @classmethod
    def of(cls, mask: Bool) -> KeptPixels:
        """Compress a mask (H, W), True for pixels that are kept."""
        height, width = mask.shape
        return cls(width, height, zlib.compress(np.packbits(mask).tobytes(), level=1))

    def mask(self, width: int, height: int) -> Bool:
        """The mask (height, width) at another size: that of the nearest pixel."""
        bits = np.frombuffer(zlib.decompress(self.packed), np.uint8)
        own = np.unpackbits(bits, count=self.width * self.height).reshape(self.height, self.width).astype(np.bool_)
        rows = (2 * np.arange(height) + 1) * self.height // (2 * height)
        columns = (2 * np.arange(width) + 1) * self.width // (2 * width)
        return np.asarray(own[np.ix_(rows, columns)])

    def applied(self, image: Float32) -> Float32:
        """Return a picture (H, W, 3 to 5), as from `View.load_masked`, with five channels and zeros where a pixel is
        not kept."""
        height, width, channels = image.shape
        opacity = image[:, :, 3:4] if channels > 3 else np.ones((height, width, 1), np.float32)
        counts = image[:, :, 4:] if channels > 4 else np.ones((height, width, 1), np.float32)
        whole = np.concatenate([image[:, :, :3], opacity, counts], axis=2)
        return np.where(self.mask(width, height)[:, :, None], whole, np.float32(0))

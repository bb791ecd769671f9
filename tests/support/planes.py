# SPDX-License-Identifier: Apache-2.0
"""Images as planes of whole tiles, as the kernels have them."""

from __future__ import annotations

import numpy as np

from clsplat.stages.device_camera import padded_size


def padded(image: np.ndarray, beside: float = 0.0) -> np.ndarray:
    """Planes (C, rows, stride) float32 of an image (H, W, C); beside: value right of it and below."""
    height, width, channels = image.shape
    planes = np.full((channels, *padded_size(width, height)), beside, np.float32)
    planes[:, :height, :width] = image.transpose(2, 0, 1)
    return planes

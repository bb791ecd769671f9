# SPDX-License-Identifier: Apache-2.0
"""EXIF orientation: rotation and mirroring of pixels."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T", bound=np.generic)


def turned(image: NDArray[T], orientation: int) -> NDArray[T]:
    """Rotate and mirror an image (H, W, ...) by its EXIF orientation, 1 to 8."""
    if orientation >= 5:
        image = image.transpose(1, 0, 2)
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    return image

# SPDX-License-Identifier: Apache-2.0
"""The training views' pixels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from clsplat.scenes.scene import View


class Photographs:
    """The training views' pixels at one resolution, decoded once each; uint8 where that holds them exactly."""

    def __init__(self, views: list[View]) -> None:
        self._views = views
        self._factor = 0.0
        self._held: dict[int, NDArray[Any]] = {}

    def load(self, index: int, factor: float) -> NDArray[Any]:
        """View `index` at 1/factor of its size, (H, W, 3 or 4), straight alpha."""
        if factor != self._factor:
            self._factor = factor
            self._held.clear()
        if index not in self._held:
            camera = self._views[index].camera
            image: NDArray[np.float32] = self._views[index].load(
                max(int(camera.width / factor), 1), max(int(camera.height / factor), 1)
            )
            levels = np.rint(image * 255)
            exact = (
                np.array_equal((levels / np.float32(255)).astype(np.float32), image)
                and 0 <= levels.min() <= levels.max() <= 255
            )
            self._held[index] = levels.astype(np.uint8) if exact else np.ascontiguousarray(image, np.float32)
        return self._held[index]

# SPDX-License-Identifier: Apache-2.0
"""Known depths of the training views, as a step compares the render's with them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import NEAR, Camera
from clsplat.config.depth import DECAY
from clsplat.config.training import TrainConfig
from clsplat.scenes.scene import View
from clsplat.stages.device_camera import padded_size
from clsplat.stages.loss import DEPTH_PIXEL_BYTES, DepthAims

NEAREST = 1e6
"""One over the least depth that is taken for one, in parts of the scene's extent: what is nearer is a damaged map's."""


def pixel_bytes(config: TrainConfig) -> int:
    """Bytes of a pixel on the device, where depths are compared."""
    return DEPTH_PIXEL_BYTES if config.depth_use else 0


def weight_at(config: TrainConfig, step: int) -> float:
    """Weight of the depth loss in step number `step`."""
    fall: float = DECAY ** (step / config.iterations)
    return config.depth_weight * fall


class Depths:
    """Known depths of all training views at one resolution; nothing where the settings ask for none."""

    def __init__(self, config: TrainConfig, views: list[View], extent: float, near: float = NEAR) -> None:
        self._config, self._views, self._extent, self._near = config, views, extent, near
        self._held: dict[int, tuple[tuple[int, int], tuple[NDArray[np.int64], Float32, Float32]]] = {}

    def aims(self, view: int, camera: Camera, step: int, photograph: NDArray[Any] | None = None) -> DepthAims | None:
        """The depths that a view's render is compared with, of the size of the step's camera; None where none are.
        photograph: the view's (H, W, 3 to 5), where the fifth channel is a mask, under which no depth counts."""
        if not self._config.depth_use:
            return None
        width, height = camera.width, camera.height
        pixels, nearness, weights = self._known(view, width, height, photograph)
        rows, stride = padded_size(width, height)
        planes = np.zeros((2, rows, stride), np.float32)
        at = pixels // width, pixels % width
        of_distances = camera.depths_of_distances()
        planes[0][at] = nearness if of_distances is None else nearness * of_distances[at]
        planes[1][at] = weights
        total = float(weights.sum(dtype=np.float64))
        factor = weight_at(self._config, step) * self._extent / total if total > 0 else 0.0
        return DepthAims(planes, factor)

    def _known(
        self, view: int, width: int, height: int, photograph: NDArray[Any] | None
    ) -> tuple[NDArray[np.int64], Float32, Float32]:
        size, held = (width, height), self._held.get(view)
        if held is None or held[0] != size:
            of, nothing = self._views[view], np.empty(0, np.float32)
            found = None if of.depth is None else of.depth.at(of.camera.resized(*size).before(self._near), of.lens)
            pixels, nearness, weights = found or (np.empty(0, np.int64), nothing, nothing)
            counts = nearness * self._extent < NEAREST
            if photograph is not None and photograph.shape[2] == 5:
                counts &= photograph[:, :, 4].ravel()[pixels] > 0
            held = self._held[view] = size, (pixels[counts], nearness[counts], weights[counts])
        return held[1]

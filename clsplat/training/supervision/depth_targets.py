# SPDX-License-Identifier: Apache-2.0
"""Known depths of the training views, which the depth loss compares with rendered depths.

The weight of the depth loss: `config/training.py`; its fall: `config/depth.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32
from clsplat.camera import DEFAULT_NEAR_PLANE, Camera
from clsplat.config.depth import DEPTH_WEIGHT_END_FRACTION
from clsplat.config.training import TrainConfig
from clsplat.scenes.scene import View
from clsplat.stages.device_camera import padded_size
from clsplat.stages.loss_terms import DEPTH_PIXEL_BYTES, DepthTerm
from clsplat.training.step.component import Component
from clsplat.training.step.inputs import ViewInputs

MAX_TARGET_NEARNESS = 1e6
"""Exclusive upper limit of inverse depth times the length unit. Nearer depths come from damaged depth maps."""


def weight_at(config: TrainConfig, step: int) -> float:
    """Return the weight of the depth loss in step number `step`.

    It falls exponentially, to DEPTH_WEIGHT_END_FRACTION (`config.depth`) of the first weight.
    """
    fall: float = DEPTH_WEIGHT_END_FRACTION ** (step / config.iterations)
    return config.depth_weight * fall


class DepthTargets(Component):
    """Known depths of all training views at one resolution; inactive unless the settings ask for depths.

    near: near plane of the model, in world units.
    pixels: function from a view's index to its photograph (H, W, 3 to 5) at the step's size, on the host. If it is
        None, `join` adds no depths.
    """

    def __init__(
        self,
        config: TrainConfig,
        views: list[View],
        length_unit: float,
        near: float = DEFAULT_NEAR_PLANE,
        pixels: Callable[[int], NDArray[Any]] | None = None,
    ) -> None:
        self._config, self._views, self._length_unit, self._near, self._pixels = (
            config,
            views,
            length_unit,
            near,
            pixels,
        )
        self._held: dict[int, tuple[tuple[int, int], tuple[NDArray[np.int64], Float32, Float32]]] = {}

    @cached_property
    def on(self) -> bool:
        """True if the settings ask for depths."""
        return bool(self._config.depth_use)

    @property
    def pixel_bytes(self) -> int:
        """Bytes per pixel that known depths take on the device."""
        return DEPTH_PIXEL_BYTES if self._config.depth_use else 0

    def join(self, inputs: Sequence[ViewInputs], step: int, count: int) -> Sequence[ViewInputs]:  # noqa: ARG002
        """Return the views, with their known depths.

        step, count: number of the step's last view, and number of Gaussians.
        """
        if not self._config.depth_use or self._pixels is None:
            return inputs
        aims = [self.aims(each.view, each.camera, step, self._pixels(each.view)) for each in inputs]
        return [replace(each, depth=depth) for each, depth in zip(inputs, aims, strict=True)]

    def aims(self, view: int, camera: Camera, step: int, photograph: NDArray[Any] | None = None) -> DepthTerm | None:
        """Depth loss of a view, with its known depths at the size of `camera`; None if the settings ask for no depths.

        step: number of the step, by which the weight of the loss falls.
        photograph: the view's photograph (H, W, 3 to 5). Where its fifth channel, the mask, is 0, the loss leaves out
            known depths. None leaves out none.
        """
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
        factor = weight_at(self._config, step) * self._length_unit / total if total > 0 else 0.0
        return DepthTerm(planes, factor)

    def _known(
        self, view: int, width: int, height: int, photograph: NDArray[Any] | None
    ) -> tuple[NDArray[np.int64], Float32, Float32]:
        size, held = (width, height), self._held.get(view)
        if held is None or held[0] != size:
            of, nothing = self._views[view], np.empty(0, np.float32)
            found = None if of.depth is None else of.depth.at(of.camera.resized(*size).before(self._near), of.lens)
            pixels, nearness, weights = found or (np.empty(0, np.int64), nothing, nothing)
            counts = nearness * self._length_unit < MAX_TARGET_NEARNESS
            if photograph is not None and photograph.shape[2] == 5:
                counts &= photograph[:, :, 4].ravel()[pixels] > 0
            held = self._held[view] = size, (pixels[counts], nearness[counts], weights[counts])
        return held[1]

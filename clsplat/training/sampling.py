# SPDX-License-Identifier: Apache-2.0
"""Mip-Splatting's filter in space: no Gaussian gets smaller than the training pictures can show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.stages.device_gaussians import AnyGaussians
from clsplat.stages.sampling import limit_scales, sampling_limits, upload_cameras

EVERY = 100
"""Steps from one look at the cameras to the next: the means move slowly."""


class SamplingFilter:
    """The least scales of a model in training, by the cameras of its pictures at their full size; nothing where the
    settings ask for none."""

    def __init__(self, config: TrainConfig, device: Device, work: Workspace, cameras: Sequence[Camera]) -> None:
        self._device, self._work, self._on = device, work, config.antialiased
        self._least: DeviceArray | None = None  # (n,), None where they have to be worked out before the next step
        if not self._on:
            return
        self._cameras = upload_cameras(device, cameras)

    def is_due(self, step: int, views: int) -> bool:
        """True if the least scales are worked out before the `views` steps that end with this one."""
        return self._on and (self._least is None or (step - 1) % EVERY < views)

    def renew(self, gaussians: AnyGaussians) -> None:
        """Work out the least scales, and apply them."""
        self._least = allocate(self._device, (gaussians.count,), np.float32)
        sampling_limits(self._device, self._work, gaussians, self._cameras, self._least)
        self.apply(gaussians)

    def apply(self, gaussians: AnyGaussians) -> None:
        """Make no scale less than it may be."""
        if self._least is not None:
            limit_scales(self._device, self._work, gaussians, self._least)

    def forget(self) -> None:
        """Forget the least scales: rows have moved."""
        self._least = None

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of a checkpoint, by name."""
        return {} if self._least is None else {"sampling/least": self._least.get()}

    def load(self, arrays: Mapping[str, NDArray[Any]], count: int) -> None:
        """Take the arrays of a checkpoint of `count` Gaussians. Raises ValueError where they are of others."""
        least = arrays.get("least") if self._on else None
        if least is not None and least.shape != (count,):
            raise ValueError(f"sampling/least has shape {least.shape}")
        self._least = None if least is None else upload(self._device, np.ascontiguousarray(least, np.float32))

# SPDX-License-Identifier: Apache-2.0
"""Mip-Splatting's filter in space: no Gaussian gets smaller than the training pictures can show."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.stages.device_gaussians import AnyGaussians
from clsplat.stages.sampling import limit_scales, sampling_limits, upload_cameras

EVERY = 100
"""Steps from one look at the cameras to the next: the means move slowly."""


class SamplingFilter:
    """The least scales of a model in training, by the cameras of its pictures at their full size.

    least (n,): None where they have to be worked out before the next step.
    """

    def __init__(self, device: Device, work: Workspace, cameras: Sequence[Camera]) -> None:
        self._device, self._work = device, work
        self._cameras = upload_cameras(device, cameras)
        self.least: DeviceArray | None = None

    def is_due(self, step: int) -> bool:
        """True if the least scales are worked out before this step."""
        return self.least is None or step % EVERY == 1

    def renew(self, gaussians: AnyGaussians) -> None:
        """Work out the least scales, and apply them."""
        self.least = allocate(self._device, (gaussians.count,), np.float32)
        sampling_limits(self._device, self._work, gaussians, self._cameras, self.least)
        self.apply(gaussians)

    def apply(self, gaussians: AnyGaussians) -> None:
        """Make no scale less than it may be."""
        assert self.least is not None, "renewed before a step"
        limit_scales(self._device, self._work, gaussians, self.least)

    def restore(self, least: NDArray[np.float32] | None) -> None:
        """Go on from a checkpoint's least scales (n,), or without."""
        self.least = None if least is None else upload(self._device, np.ascontiguousarray(least, np.float32))

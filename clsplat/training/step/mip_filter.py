# SPDX-License-Identifier: Apache-2.0
"""Mip-Splatting's 3D smoothing filter: no Gaussian becomes smaller than the training photographs can resolve."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config.training import TrainConfig
from clsplat.device.buffers import DeviceArray, Workspace, allocate, upload
from clsplat.device.context import Device
from clsplat.optimisation.trained_region import TrainedRegion
from clsplat.stages.device_camera import upload_cameras
from clsplat.stages.device_gaussians import AnyGaussians, HostArray
from clsplat.stages.sampling import SAMPLING_GAUSSIAN_BYTES, limit_scales, sampling_limits
from clsplat.training.step.component import Component, Named

SAMPLING_LIMIT_INTERVAL_STEPS = 100
"""Number of steps between updates of the 3D filter, the scales' lower limits. Means move too slowly to need more."""


class MipFilter(Component):
    """Lower limits of the Gaussians' scales, from the training cameras at full picture size. Inactive unless the
    settings ask for antialiasing.

    region: the region in which scales have limits, in the coordinates of the means; None for everywhere.
    """

    def __init__(
        self,
        config: TrainConfig,
        device: Device,
        work: Workspace,
        cameras: Sequence[Camera],
        region: TrainedRegion | None = None,
    ) -> None:
        self._device, self._work, self._antialiased, self._region = device, work, config.antialiased, region
        self._least: DeviceArray | None = None  # (n,), lower limits; None until the next step computes them
        if not self.on:
            return
        self._cameras = upload_cameras(device, cameras)

    @property
    def on(self) -> bool:
        """True for antialiased models."""
        return self._antialiased

    @property
    def row_bytes(self) -> int:
        """Bytes per Gaussian that the filter takes on the device."""
        return SAMPLING_GAUSSIAN_BYTES if self.on else 0

    def is_due(self, step: int, views: int) -> bool:
        """True if the limits have to be computed before a step of the training.

        step: number of the last view of this step, counted from the start of the training.
        views: number of views of this step.
        """
        return self.on and (self._least is None or (step - 1) % SAMPLING_LIMIT_INTERVAL_STEPS < views)

    def before_step(self, gaussians: AnyGaussians) -> None:
        """Compute the scales' lower limits, and raise scales that are below them."""
        self._least = allocate(self._device, (gaussians.count,), np.float32)
        sampling_limits(self._device, self._work, gaussians, self._cameras, self._least, self._region)
        self.after_adam(gaussians)

    def after_adam(self, gaussians: AnyGaussians) -> None:
        """Raise each scale that Adam has moved below its lower limit to the limit."""
        if self._least is not None:
            limit_scales(self._device, self._work, gaussians, self._least)

    def rows_moved(self, listed: DeviceArray | HostArray) -> None:  # noqa: ARG002
        """Forget the limits, because rows have moved. The next step computes them anew."""
        self._least = None

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The scales' lower limits, keyed by their name in a checkpoint."""
        return {} if self._least is None else {"sampling/least": self._least.get()}

    def load(self, named: Named, step: int, count: int) -> None:  # noqa: ARG002
        """Load the scales' lower limits, if the checkpoint has any. Raises ValueError unless there is a limit for each
        of the `count` Gaussians.

        named: function from a prefix to the checkpoint's arrays whose names have this prefix.
        step: step of the checkpoint; not used.
        """
        least = named("sampling/").get("least") if self.on else None
        if least is not None and least.shape != (count,):
            raise ValueError(f"sampling/least has shape {least.shape}, expected ({count},)")
        self._least = None if least is None else upload(self._device, np.ascontiguousarray(least, np.float32))

# SPDX-License-Identifier: Apache-2.0
"""Launches loss.cl: L1 + D-SSIM and its gradient."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.device.layout import PAD
from clsplat.device.profile import stage

_STRIPS = 64
"""Strips of a row, on devices that are not CPUs."""


PIXEL_BYTES = 12
"""Bytes of the image's gradient, of each pixel with its padding."""


def strips(device: Device) -> int:
    """Work-items a row."""
    return 1 if device.shape.items == 1 else _STRIPS


def scratch_bytes(height: int, stride: int, channels: int = 3) -> int:
    """Bytes of the moments and partial derivatives."""
    return 4 * channels * height * (5 * (stride + 2 * PAD) + 3 * stride)


def sums_bytes(device: Device, height: int) -> int:
    """Bytes of the partial sums."""
    return 4 * 3 * 3 * height * strips(device)


@dataclass(frozen=True, eq=False)
class Loss:
    """gradient (3, rows, stride); sums (3, ...): partial sums of SSIM, of |x - y| and of its square; copy: the sums
    where a copy to the host is under way."""

    gradient: DeviceArray
    sums: DeviceArray
    samples: int
    weight: float
    copy: Callable[[], NDArray[Any]] | None = None

    def fetched(self) -> Loss:
        """The same, its sums on their way to the host: `read` then does not wait for what comes behind them."""
        return replace(self, copy=self.sums.begin_get())

    def read(self) -> tuple[float, float]:
        """(loss, mean squared error); waits for the device."""
        sums = self.copy() if self.copy is not None else self.sums.get()
        ssim, absolute, squared = sums.reshape(3, -1).sum(axis=1, dtype=np.float64) / self.samples
        return float((1 - self.weight) * absolute + self.weight * (1 - ssim)), float(squared)


@stage("loss")
def loss(
    device: Device,
    work: Workspace,
    image: DeviceArray,
    target: DeviceArray,
    width: int,
    height: int,
    weight: float,
    channels: int = 3,
) -> Loss:
    """(1 - weight) L1 + weight (1 - SSIM) of planes (3, rows, stride), zero right of and below the image.

    channels: 3, or 1 to work on one after the other in a third of the scratch memory.
    """
    _, rows, stride = image.shape
    plane, padded = rows * stride, stride + 2 * PAD
    across = strips(device)
    grid = (across, height, channels)
    samples = 3 * width * height
    moments = work.array("loss_moments", (5, channels, height, padded))
    partials = work.array("loss_partials", (3, channels, height, stride))
    gradient = work.array("image_gradient", (3, rows, stride))
    sums = work.array("loss_sums", (3, 3 * height * across))
    kernels = device.kernels("loss")
    pictures, rows_of = (image, target), (height, stride, plane)
    weights = ((1 - weight) / samples, weight / samples)
    for first in range(0, 3, channels):
        launch_grid(device, kernels.loss_vertical, grid, first, *rows_of, *pictures, moments)
        launch_grid(device, kernels.loss_ssim, grid, first, width, *rows_of, *pictures, moments, partials, sums)
        launch_grid(device, kernels.loss_vertical_grad, grid, first, *rows_of, *pictures, partials, moments)
        launch_grid(
            device, kernels.loss_grad, grid, first, width, *rows_of, *weights, moments, *pictures, gradient, sums
        )
    return Loss(gradient, sums, samples, weight)

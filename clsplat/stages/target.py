# SPDX-License-Identifier: Apache-2.0
"""Launches target.cl: a photograph into the blend's layout."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.device.profile import stage
from clsplat.stages.device_camera import padded_size

SOURCE_BYTES = 16
"""Bytes of each pixel of a photograph: at most RGBA in floats."""
PIXEL_BYTES = 12 + SOURCE_BYTES
"""Bytes of each pixel with its padding: three planes, and the photograph."""


@stage("target")
def target(device: Device, work: Workspace, image: NDArray[Any] | DeviceArray, background: DeviceArray) -> DeviceArray:
    """image (H, W, 3 or 4), uint8 or float32, straight alpha -> planes (3, rows, stride) over the background.

    An image on the host goes up without waiting: it must not change before the device is waited for.
    """
    height, width, channels = image.shape
    rows, stride = padded_size(width, height)
    if isinstance(image, DeviceArray):
        source = image
    else:
        source = work.array("target_source", image.shape, image.dtype)
        source.send(np.ascontiguousarray(image))
    planes = work.array("target", (3, rows, stride))
    kernels = device.kernels("target", **({"BYTES": True} if image.dtype == np.uint8 else {}))
    sizes = (width, height, channels, stride, rows * stride)
    launch_grid(device, kernels.target, (stride, rows), *sizes, source, background, planes)
    device.under_way.append(source.buffer)  # it may be the host's memory
    return planes

# SPDX-License-Identifier: Apache-2.0
"""Launches target.cl: a photograph in the layout of blending."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.device.profile import stage
from clsplat.layouts.columns import TILE
from clsplat.stages.blend import Blended
from clsplat.stages.device_camera import padded_size

SOURCE_PIXEL_BYTES = 16
"""Bytes per pixel of a photograph: at most RGBA in floats."""
MASK_PIXEL_BYTES = 4
"""The most bytes per pixel of a photograph's mask."""
TARGET_PIXEL_BYTES = 12 + SOURCE_PIXEL_BYTES
"""Bytes per pixel with padding: three planes, and the photograph."""


@stage("target")
def target(
    device: Device,
    work: Workspace,
    image: NDArray[Any] | DeviceArray,
    background: DeviceArray,
    blended: Blended | None = None,
    *,
    alpha: bool = False,
) -> DeviceArray:
    """Convert image (H, W, 3 to 5), uint8 or float32 with straight alpha, to planes (3, rows, stride) over the
    background.

    alpha: add a fourth plane, the alpha.

    A fifth channel is a mask, 0 where a pixel does not count. Such pixels become zero in the planes and also in the
    render `blended`, which this changes, and the gradient of blending skips them. An image on the host is uploaded
    without waiting: it must not change until the host has waited for the device.
    """
    if isinstance(image, DeviceArray):
        device.under_way.append(
            image.buffer
        )  # the buffer may be the host's memory, which must live until the kernel has run
        source = image
    else:
        source = work.array("target_source", image.shape, image.dtype)
        source.send(np.ascontiguousarray(image))
    height, width, channels = source.shape
    rows, stride = padded_size(width, height)
    planes = work.array("target", (3 + alpha, rows, stride))
    defines = {"BYTES": True} if source.dtype == np.uint8 else {}
    render: tuple[DeviceArray, ...] = ()
    if channels == 5:
        assert blended is not None, "a mask also changes the render"
        defines["MASKED"], render = True, (blended.image, blended.stops)
    if alpha:
        defines["ALPHA"] = True
    kernels = device.kernels("target", defines)
    sizes = (width, height, channels, stride, rows * stride)
    across = stride // TILE if device.shape.lanes > 1 else stride
    launch_grid(device, kernels.target, (across, rows), *sizes, source, background, planes, *render)
    return planes

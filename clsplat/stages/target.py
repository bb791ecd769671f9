# SPDX-License-Identifier: Apache-2.0
"""Launches target.cl: a photograph into the blend's layout."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.device.layout import TILE
from clsplat.device.profile import stage
from clsplat.stages.blend import Blended
from clsplat.stages.device_camera import padded_size

SOURCE_BYTES = 16
"""Bytes of each pixel of a photograph: at most RGBA in floats."""
MASK_BYTES = 4
"""Bytes of each pixel of a photograph's mask, at most."""
PIXEL_BYTES = 12 + SOURCE_BYTES
"""Bytes of each pixel with its padding: three planes, and the photograph."""


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
    """image (H, W, 3 to 5), uint8 or float32, straight alpha -> planes (3, rows, stride) over the background, with
    `alpha` a fourth of the alpha.

    A fifth channel is a mask, 0 where a pixel does not count. Such pixels are zero in the planes, and in the blended
    image, and the gradient of blending passes them: the render is changed.
    An image on the host goes up without waiting: it must not change before the device is waited for.
    """
    if isinstance(image, DeviceArray):
        device.under_way.append(image.buffer)  # it may be the host's memory
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
        assert blended is not None, "a mask is of a render too"
        defines["MASKED"], render = True, (blended.image, blended.stops)
    if alpha:
        defines["ALPHA"] = True
    kernels = device.kernels("target", **defines)
    sizes = (width, height, channels, stride, rows * stride)
    across = stride // TILE if device.shape.lanes > 1 else stride
    launch_grid(device, kernels.target, (across, rows), *sizes, source, background, planes, *render)
    return planes

# SPDX-License-Identifier: Apache-2.0
"""Launches target.cl: a photograph composited over the background, as planes in the layout of a blended image."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device.buffers import DeviceArray, Workspace
from clsplat.device.context import Device
from clsplat.device.launch import launch_grid
from clsplat.device.profile import stage
from clsplat.layouts.columns import TILE
from clsplat.stages.blend import Blended, tile_items
from clsplat.stages.device_camera import padded_size

SOURCE_PIXEL_BYTES = 16
"""Maximum bytes per pixel of a photograph: RGBA in floats."""
MASK_PIXEL_BYTES = 4
"""Maximum bytes per pixel of a photograph's mask."""
TARGET_PIXEL_BYTES = 12 + SOURCE_PIXEL_BYTES
"""Bytes per pixel that a target takes, padding included: three planes, and the photograph."""


def is_photograph(array: DeviceArray) -> bool:
    """True for a photograph (H, W, 3), False for planes (3, rows, stride): a stride is never 3, but a tile or more."""
    return array.shape[-1] == 3


def sample_defines(photograph: DeviceArray) -> dict[str, object]:
    """Macros for kernels that read `photograph` by kernels/shared/photograph.h."""
    return {"BYTES": True} if photograph.dtype == np.uint8 else {}


def on_device(work: Workspace, image: NDArray[Any] | DeviceArray) -> DeviceArray:
    """Upload an image for `target`, unless it is on the device already. The upload does not wait: the image must not
    change until the host has waited for the device."""
    if isinstance(image, DeviceArray):
        return image
    source = work.array("target_source", image.shape, image.dtype)
    source.send(np.ascontiguousarray(image))
    return source


@stage("target")
def target(
    device: Device,
    work: Workspace,
    image: NDArray[Any] | DeviceArray,
    background: DeviceArray,
    blended: Blended | None = None,
    *,
    alpha: bool = False,
    in_planes: bool = True,
) -> DeviceArray:
    """Composite an image (H, W, 3 to 5), uint8 or float32 with straight alpha, over the background, and return planes
    (3, rows, stride).

    alpha: add a fourth plane, the alpha.
    in_planes: False if only `stages.loss.loss` reads the result. A photograph without alpha and mask is then returned
    as it is if several items share a tile (`tile_items`).

    A fifth channel is a mask, 0 in pixels that the loss leaves out. These pixels become zero in the planes, and in the
    render `blended` too; the gradient of blending skips them. An image on the host is uploaded as `on_device` does.
    """
    source = on_device(work, image)
    device.under_way.append(source.buffer)  # keeps the buffer, which may be host memory, until the kernel has run
    height, width, channels = source.shape
    if not (in_planes or alpha) and is_photograph(source) and tile_items(device) > 1:
        return source
    rows, stride = padded_size(width, height)
    planes = work.array("target", (3 + alpha, rows, stride))
    defines = sample_defines(source)
    render: tuple[DeviceArray, ...] = ()
    if channels == 5:
        assert blended is not None, "a mask needs the render, which it changes"
        defines["MASKED"], render = True, (blended.image, blended.stops)
    if alpha:
        defines["ALPHA"] = True
    kernels = device.kernels("target", defines)
    sizes = (width, height, channels, stride, rows * stride)
    across = stride // TILE if device.shape.lanes > 1 else stride
    launch_grid(device, kernels.target, (across, rows), *sizes, source, background, planes, *render)
    return planes

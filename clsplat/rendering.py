# SPDX-License-Identifier: Apache-2.0
"""The forward pass and its gradient, each on one screen, and the renderer that callers use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config import RasterizerConfig
from clsplat.device.buffers import DeviceArray, Workspace, allocate
from clsplat.device.context import Device, open_device
from clsplat.device.switches import kernel_defines
from clsplat.gaussians import Gaussians
from clsplat.memory import parse_bytes
from clsplat.stages.blend import Blended, blend, blend_grad
from clsplat.stages.duplicate import Pairs, duplicate
from clsplat.stages.project import (
    DeviceGaussians,
    Projected,
    pack_camera,
    project,
    project_grad,
    tiles_of,
    upload_gaussians,
)
from clsplat.stages.ranges import TileLists, tile_lists

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Frame:
    """One forward pass: every stage's arrays, valid until the rasterizer's next forward pass."""

    camera: Camera
    camera_array: DeviceArray
    background: DeviceArray
    projected: Projected
    pairs: Pairs
    lists: TileLists
    blended: Blended


class Rasterizer:
    """The pipeline on one device, with the memory that it works in, which can be another's."""

    def __init__(self, device: Device, config: RasterizerConfig | None = None, work: Workspace | None = None) -> None:
        self.config = config or RasterizerConfig()
        self.device = device.with_switches(kernel_defines(self.config))
        self.work = work or Workspace(device)

    def forward(self, gaussians: DeviceGaussians, camera: Camera, background: DeviceArray) -> Frame:
        """Project, sort by depth, duplicate, sort by tile, blend (Kerbl et al. 2023, algorithm 2)."""
        device, work = self.device, self.work
        camera_array = work.array("camera", (len(pack := pack_camera(camera)),))
        camera_array.set(pack)
        tiles_x, tiles_y = tiles_of(camera)
        projected = project(device, work, gaussians, camera, camera_array)
        pairs = duplicate(device, work, projected, (tiles_x, tiles_y))
        lists = tile_lists(device, work, pairs, tiles_x * tiles_y)
        blended = blend(device, work, lists, projected.splats, background, camera.width, camera.height)
        return Frame(camera, camera_array, background, projected, pairs, lists, blended)

    def backward(
        self,
        gaussians: DeviceGaussians,
        frame: Frame,
        image_gradient: DeviceArray,
        gradients: DeviceGaussians,
        *,
        absolute: bool = False,
    ) -> DeviceArray:
        """Fill the visible rows of `gradients`; returns the gradient of the means on the image, (n, 2), in pixels."""
        device, work = self.device, self.work
        slots = blend_grad(
            device,
            work,
            frame.lists,
            frame.projected.splats,
            frame.background,
            frame.blended,
            image_gradient,
            absolute=absolute,
        )
        screen = work.array("screen", (gaussians.count, 2))
        project_grad(
            device,
            gaussians,
            frame.camera_array,
            frame.projected,
            frame.pairs.first_slots,
            slots,
            gradients,
            screen,
            absolute=absolute,
        )
        return screen


@dataclass(frozen=True, eq=False)
class RenderResult:
    """image (H, W, 3) float32, composited over the background; alpha (H, W) float32."""

    image: Float32
    alpha: Float32


class Renderer:
    """Renders models; keeps the last one on the device. It can work in another's rasterizer and its memory."""

    def __init__(
        self,
        device: Device | None = None,
        rasterizer: Rasterizer | None = None,
        *,
        config: RasterizerConfig | None = None,
    ) -> None:
        self.device = device or open_device()
        self._rasterizer = rasterizer or Rasterizer(self.device, config)
        self._background = allocate(self.device, (3,), np.float32)
        self._held: tuple[Gaussians, DeviceGaussians] | None = None

    def render(
        self, gaussians: Gaussians | DeviceGaussians, camera: Camera, background: Sequence[float] = (0.0, 0.0, 0.0)
    ) -> RenderResult:
        """Render one view. A Gaussians object is taken to be unchanged for as long as it is the same object."""
        if isinstance(gaussians, Gaussians):
            if self._held is None or self._held[0] is not gaussians:
                self._held = (gaussians, upload_gaussians(self.device, gaussians))
            on_device = self._held[1]
        else:
            on_device = gaussians
        self._background.set(np.asarray(background, np.float32))
        blended = self._rasterizer.forward(on_device, camera, self._background).blended
        height, width = camera.height, camera.width
        planes = blended.image.get()[:, :height, :width]
        alpha: Float32 = np.float32(1) - blended.transmittance.get()[:height, :width]
        return RenderResult(np.ascontiguousarray(planes.transpose(1, 2, 0)), alpha)


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    device: str | None = None,
    max_device_mem: str | int | None = None,
) -> RenderResult:
    """Render one view on the device that `device` names (see `clsplat devices`), with at most `max_device_mem` of its
    memory, such as "256MiB". Raises DeviceError."""
    return Renderer(open_device(device, parse_bytes(max_device_mem))).render(gaussians, camera, background)

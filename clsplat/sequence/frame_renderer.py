# SPDX-License-Identifier: Apache-2.0
"""One frame: from a model and a camera to the layers of its file, and to what stands in the file's header."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from clsplat.camera import Camera
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import Device, open_device, select
from clsplat.errors import DriverError, InputError
from clsplat.frame.deep_exr import write_deep
from clsplat.frame.draw import COLOUR, Layers
from clsplat.frame.pipeline import Pictures
from clsplat.rendering.renderer import Renderer
from clsplat.selftest.result import CHANNELS, DEEP, FORWARD, RAYS
from clsplat.selftest.trust import require
from clsplat.sequence.task import RenderOptions, Task, camera_after, header, picture_camera

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians

TRANSFERS = ("read", "write", "fill")
"""Names of what a device's recorder notes that are no kernels."""


def as_it_is(layers: Layers) -> Layers:
    """The same layers."""
    return layers


@dataclass(frozen=True)
class Shaded:
    """A frame before it is encoded. layers: None for one that was written strip by strip; seconds: time that it took;
    kernel_ms, transfer_ms: the device's, None if not asked for; blank: True if nothing of the model is in it, None
    where that was not looked at; finish: the rest of the work on the layers, which the encoding thread does."""

    layers: Layers | None
    seconds: float
    kernel_ms: float | None = None
    transfer_ms: float | None = None
    blank: bool | None = None
    finish: Callable[[Layers], Layers] = as_it_is


Shader = Callable[[Task], Shaded]


class FrameShader:
    """Renders frames of one model on one device. A frame that is too large to be held is written as well."""

    def __init__(self, renderer: Any, gaussians: Gaussians, options: RenderOptions) -> None:
        """renderer: a `Renderer`. Raises InputError for settings and colour spaces that make no sense."""
        self.options = options
        self._renderer, self._gaussians = renderer, gaussians
        self._rays_tested = False
        self._pictures = Pictures(
            renderer, gaussians, options.pictures, background=options.background, recorded=options.recorded
        )

    def check(self, tasks: Sequence[Task]) -> None:
        """Raise InputError for a frame that the file's kind cannot hold as it has to be rendered here."""
        for task in tasks:
            if self.options.encoding.parts == "several" and self._in_strips(task):
                camera = picture_camera(task, self.options)
                raise InputError(
                    f"--parts several: a picture of {camera.width}x{camera.height} is written in strips here, "
                    "expected one part"
                )

    def __call__(self, task: Task) -> Shaded:
        """The frame. Raises ClsplatError where it cannot be rendered, or, if it is written here, not be written."""
        self._trust(task.camera)
        start, options, pictures = time.monotonic(), self.options, self._pictures
        if options.deep is None and not self._in_strips(task):
            layers, finish = pictures.unfinished(task.at, options.channels, camera_after(task, options))
            blank = pictures.is_blank(layers)
            return Shaded(layers, time.monotonic() - start, blank=blank, finish=finish)
        encoding, head = options.encoding, header(task, options)
        if options.deep is None:
            after = camera_after(task, options)
            pictures.write(task.path, task.at, options.channels, encoding, head, after)
        else:
            model, camera = (self._renderer, self._gaussians), picture_camera(task, options)
            write_deep(task.path, *model, camera, options.deep, encoding, head, pictures.colours)
        return Shaded(None, time.monotonic() - start)

    def _trust(self, camera: Camera) -> None:
        """Self-test what panoramas and fisheyes need before the first of them."""
        if camera.kind.flat or self._rays_tested:
            return

        device = self._renderer.device
        if require(device, RAYS) is not device:  # too late to draw in another shape
            raise DriverError(
                f"{device.name}: the driver failed in the shape {device.shape.label}; another works, call again"
            )
        self._rays_tested = True

    def _in_strips(self, task: Task) -> bool:
        camera = picture_camera(task, self.options)
        return not task.is_video and self._pictures.rows(camera, self.options.channels) < camera.height


def open_shader(
    gaussians: Gaussians,
    options: RenderOptions,
    rasterizer: RasterizerConfig,
    *,
    device: str | None = None,
    memory_limit: int | None = None,
    profile: bool = False,
) -> FrameShader | _Recorded:
    """A function that renders frames of the model on the device that `device` names. Raises DeviceError.

    profile: note what the device is busy with.
    """
    opened: Any = _profiled(device, memory_limit) if profile else open_device(device, memory_limit)
    beside = DEEP if options.deep is not None else CHANNELS if set(options.channels) - set(COLOUR) else ()
    opened = require(opened, (*FORWARD, *beside))
    shader = FrameShader(Renderer(opened, config=rasterizer), gaussians, options)
    return _Recorded(shader, opened) if profile else shader


class _Recorded:
    """A shader whose device notes what it is busy with."""

    def __init__(self, shader: FrameShader, opened: Any) -> None:
        self._shader, self._device = shader, opened
        self.check = shader.check

    def __call__(self, task: Task) -> Shaded:
        with self._device.recorder.recording(self._device, wait=False) as stages:
            shaded = self._shader(task)
        times = [(name, taken) for record in stages.values() for name, taken in record.kernels.items()]
        kernels = sum(taken for name, taken in times if name not in TRANSFERS)
        return replace(shaded, kernel_ms=kernels, transfer_ms=sum(taken for _, taken in times) - kernels)


def _profiled(device: str | None, memory_limit: int | None) -> Any:
    opened = Device(select(device), profile=True)
    opened.memory.limit = memory_limit
    return opened

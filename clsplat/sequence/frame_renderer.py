# SPDX-License-Identifier: Apache-2.0
"""One frame: from a model and a camera to the planes of its file."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from clsplat.camera import Camera
from clsplat.config.channels import light_and_rest
from clsplat.config.pictures import DEEP_STRIP_FLOATS
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.context import open_device
from clsplat.device.layout import TILE
from clsplat.errors import DriverError
from clsplat.frame.deep_exr import write_deep
from clsplat.frame.draw import Planes
from clsplat.frame.objects import Matte
from clsplat.frame.pipeline import FramePipeline
from clsplat.frame.strips import check_parts, in_strips, strip_rows, write_in_strips
from clsplat.gaussians import Gaussians
from clsplat.models.edit import exposed
from clsplat.models.placed import Ensemble, kind_of
from clsplat.models.series import Series
from clsplat.rendering.renderer import Renderer
from clsplat.selftest.result import CHANNELS, DEEP, FORWARD, HOLDOUT, RAYS
from clsplat.selftest.trust import require
from clsplat.sequence.holdouts import cut_of
from clsplat.sequence.task import (
    RenderOptions,
    Task,
    camera_after,
    camera_before,
    header,
    lens_of,
    picture_camera,
    sampling_of,
)
from clsplat.stages.holdout import HELD_BYTES, held_bytes

TRANSFERS = ("read", "write", "fill")
"""Names of what a device's recorder notes that are no kernels."""


@dataclass(frozen=True)
class RenderedFrame:
    """A frame before it is encoded. planes: None for one that was written strip by strip; seconds: time that it took;
    finish: the rest of the work on the planes, which the encoding thread does; measured: further values of its
    `Record`; right: planes of the right eye, where one file has both."""

    planes: Planes | None
    seconds: float
    finish: Callable[[Planes], Planes] = lambda planes: planes
    measured: Mapping[str, Any] = field(default_factory=dict)
    right: Planes | None = None


RenderFrame = Callable[[Task], RenderedFrame]


class FrameRenderer:
    """Renders frames of one model, or of several, on one device. A frame that is too large to be held is written as
    well."""

    def __init__(
        self,
        renderer: Any,
        models: Gaussians | Sequence[Gaussians | Series],
        options: RenderOptions,
        mattes: Mapping[str, Matte] | None = None,
    ) -> None:
        """renderer: a `Renderer`; models: one that is taken as it is, or those that the tasks place; mattes: by the
        names of their channels. Raises InputError for settings and colour spaces that make no sense."""
        self.options = options
        several: list[Gaussians | Series] = list(models) if isinstance(models, Sequence) else [models]
        if options.gains:
            several = [model if isinstance(model, Series) else exposed(model, options.gains) for model in several]
        self._renderer, gaussians = renderer, kind_of(several[0])
        self._ensemble = Ensemble(several)
        self._rays_tested = False
        how: dict[str, Any] = {"background": options.background, "recorded": options.recorded, "mattes": mattes}
        self._pipeline = FramePipeline(renderer, gaussians, options.pictures, **how)
        self._objects = sum(len(matte.names) for matte in (mattes or {}).values())

    def check(self, tasks: Sequence[Task]) -> None:
        """Raise InputError for a frame that the file's kind cannot hold as it has to be rendered here."""
        several = self.options.encoding.parts != "one"
        held = HELD_BYTES if self.options.holdout is not None else 0
        for task in (task for task in tasks if not task.is_video and (several or task.right)):
            for camera in (picture_camera(view, self.options) for view in task.views):
                if self._rows(camera, held) < camera.height:
                    check_parts(camera, self.options.encoding, views=len(task.views))

    def __call__(self, task: Task) -> RenderedFrame:
        """The frame. Raises ClsplatError where it cannot be rendered, or, if it is written here, not be written."""
        device = self._renderer.device
        if not device.profile:
            return self._pair(task)
        with device.recorder.recording(wait=False) as stages:
            frame = self._pair(task)
        times = [(name, taken) for record in stages.values() for name, taken in record.kernels.items()]
        kernels = sum(taken for name, taken in times if name not in TRANSFERS)
        device_ms = {"kernel_ms": kernels, "transfer_ms": sum(taken for _, taken in times) - kernels}
        return replace(frame, measured={**frame.measured, **device_ms})

    def _pair(self, task: Task) -> RenderedFrame:
        """The frame, with that of the right eye where its file has both."""
        left = self._frame(task, len(task.views))
        if task.right is None:
            return left
        right = self._frame(task.right, len(task.views))
        blank = {"blank": left.measured["blank"] and right.measured["blank"]}
        return replace(left, right=right.planes, seconds=left.seconds + right.seconds, measured=blank)

    def _frame(self, task: Task, views: int) -> RenderedFrame:
        self._trust(task.camera)
        start, options, pipeline = time.monotonic(), self.options, self._pipeline
        camera, names, encoding = picture_camera(task, options), options.channels, options.encoding
        gaussians, moved = self._placed(task)
        sampling = sampling_of(task, options)
        if options.deep is not None:
            model = (self._renderer, gaussians(sampling.middle))
            above = header(task, options)
            empty = write_deep(task.path, *model, camera, options.deep, encoding, above, pipeline.colours)
            return RenderedFrame(None, time.monotonic() - start, measured={"blank": empty})
        around = camera_after(task, options), camera_before(task, options)
        cut = cut_of(task, options)
        models = (gaussians, moved)
        draw, finish = pipeline.draw(task.at, *around, lens_of(task, options), sampling, cut, *models)
        rows = self._rows(camera, held_bytes(cut(camera)) if cut else 0)
        if rows < camera.height and not task.is_video:
            check_parts(camera, encoding, views)  # again: a deep hold-out takes as much as it has surfaces
            blanks: list[bool | None] = []

            def finished(strip: Camera, names: Collection[str]) -> Planes:
                planes = draw(strip, names)
                blanks.append(pipeline.is_blank(planes, sampling))
                return finish(planes)

            write_in_strips(task.path, finished, camera, names, rows, encoding, header(task, options))
            nothing = None if None in blanks else all(blanks)
            return RenderedFrame(None, time.monotonic() - start, measured={"blank": nothing})
        planes = in_strips(draw, rows)(camera, names)
        blank = pipeline.is_blank(planes, sampling)
        return RenderedFrame(planes, time.monotonic() - start, finish, {"blank": blank})

    def _placed(self, task: Task) -> tuple[Callable[[float], Gaussians], tuple[Gaussians | None, Gaussians | None]]:
        """The frame's models as one, at a time in frames from the frame; and there where motion and backward motion go
        to, None if nothing moves there."""
        ensemble, middle = self._ensemble, sampling_of(task, self.options).middle
        if (placed := task.placed) is None:
            return lambda time: kind_of(ensemble.models[0]), (None, None)

        def moved(channel: str, time: float) -> Gaussians | None:
            return ensemble.moved(placed[middle], placed[time]) if channel in self.options.channels else None

        return lambda time: ensemble.at(placed[time]), (moved("motion", middle + 1), moved("backward", middle - 1))

    def _trust(self, camera: Camera) -> None:
        """Self-test what panoramas and fisheyes need before the first of them."""
        if not camera.kind.rays or self._rays_tested:
            return

        device = self._renderer.device
        if require(device, RAYS) is not device:  # too late to draw in another shape
            raise DriverError(
                f"{device.name}: the driver failed in the shape {device.shape.label}; another works, call again"
            )
        self._rays_tested = True

    def _rows(self, camera: Camera, planes: int) -> int:
        """Rows of the strips that the camera's picture is rendered in, its height where that is none. planes: bytes of
        each pixel for a hold-out."""
        framing = self.options.pictures.framing
        rows = strip_rows(self._renderer.device, camera, self.options.channels, framing, planes)
        floats = self._objects * camera.width * framing.supersample**2  # of all objects' planes
        most = DEEP_STRIP_FLOATS // max(floats, 1)
        return rows if most >= camera.height else min(rows, max(most // TILE, 1) * TILE)


def open_frame_renderer(
    models: Gaussians | Sequence[Gaussians | Series],
    options: RenderOptions,
    rasterizer: RasterizerConfig,
    *,
    device: str | None = None,
    memory_limit: int | None = None,
    profile: bool = False,
    mattes: Mapping[str, Matte] | None = None,
) -> FrameRenderer:
    """A renderer of frames of the models on the device that `device` names. profile: each frame's record has what the
    device was busy with. Raises DeviceError."""
    opened = open_device(device, memory_limit, profile=profile)
    kernels = DEEP if options.deep is not None else CHANNELS if light_and_rest(options.channels)[1] or mattes else ()
    opened = require(opened, (*FORWARD, *kernels, *(HOLDOUT if options.holdout is not None else ())))
    return FrameRenderer(Renderer(opened, config=rasterizer), models, options, mattes)

# SPDX-License-Identifier: Apache-2.0
"""Rendering of one frame: from models and a camera to the planes of its file."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from clsplat.camera import Camera
from clsplat.config.channels import light_and_rest
from clsplat.config.pictures import DEEP_STRIP_FLOATS
from clsplat.config.rasterizer import RasterizerConfig
from clsplat.device.selection import open_device
from clsplat.errors import DriverError, warn
from clsplat.frame.deep_exr import write_deep
from clsplat.frame.draw import Planes, feature_floats, on_tiles
from clsplat.frame.holdout import Cut
from clsplat.frame.lens import INTERPOLATION_MARGIN_PX
from clsplat.frame.mattes import Matte
from clsplat.frame.pipeline import FramePipeline, FrameRequest
from clsplat.frame.samples import finer
from clsplat.frame.strips import check_parts, deep_rows, in_strips, strip_rows, write_in_strips
from clsplat.gaussians import Gaussians
from clsplat.images.holdouts import read_holdout
from clsplat.layouts.columns import TILE
from clsplat.models.edit import exposed
from clsplat.models.instances import Ensemble, kind_of
from clsplat.models.series import ModelSeries
from clsplat.rendering.memory_needs import plan_frame
from clsplat.rendering.memory_plan import Plan
from clsplat.rendering.renderer import Renderer, held_sh
from clsplat.selftest.driver_check import require
from clsplat.selftest.result import CHANNEL_STAGES, DEEP_STAGES, FORWARD_STAGES, HOLDOUT_STAGES, RAY_STAGES
from clsplat.sequence.task import (
    NOT_MEASURED,
    Measured,
    RenderOptions,
    Task,
    camera_after,
    camera_before,
    header,
    lens_of,
    picture_camera,
    sampling_of,
    straight_camera,
    warp_of,
)
from clsplat.stages.deep import DEEP_FLOATS
from clsplat.stages.holdout import HELD_PIXEL_BYTES, held_bytes

TRANSFER_COMMANDS = ("read", "write", "fill")
"""Names of transfers in a device's timing record. All other names are kernels."""


@dataclass(frozen=True)
class RenderedFrame:
    """A rendered frame before it is encoded.

    planes: the frame's channels; None if the frame has been written already, strip by strip or as a deep picture.
    seconds: rendering time.
    finish: function that the encoding thread applies to the planes before it writes them.
    right: planes of the right eye, if one file has both eyes.
    """

    planes: Planes | None
    seconds: float
    finish: Callable[[Planes], Planes] = lambda planes: planes
    measured: Measured = NOT_MEASURED
    right: Planes | None = None


@dataclass(frozen=True)
class DevicePlan:
    """Memory plan of a device, for the job's frame that needs the most memory.

    device: name of the device.
    strips: number of strips in which the frame is rendered.
    """

    device: str
    plan: Plan
    strips: int


RenderFrame = Callable[[Task], RenderedFrame]


class FrameRenderer:
    """Renders frames of one or several models on one device. It also writes frames that are too large for memory."""

    def __init__(
        self,
        renderer: Any,
        models: Gaussians | Sequence[Gaussians | ModelSeries],
        options: RenderOptions,
        mattes: Mapping[str, Matte] | None = None,
    ) -> None:
        """Prepare the models and the pipeline of a job.

        renderer: the `Renderer` of the device.
        models: a single model used as it is, or models that each task places in its world.
        mattes: Cryptomattes by the names of their channels.
        Raises InputError for settings and colour spaces that do not fit together.
        """
        self.options = options
        several: list[Gaussians | ModelSeries] = list(models) if isinstance(models, Sequence) else [models]
        if options.gains:
            several = [model if isinstance(model, ModelSeries) else exposed(model, options.gains) for model in several]
        self._renderer, gaussians = renderer, kind_of(several[0])
        self._ensemble = Ensemble(several)
        self._rays_tested = False
        self._pipeline = FramePipeline(
            renderer,
            gaussians,
            options.pictures,
            background=options.background,
            recorded=options.recorded,
            mattes=mattes,
        )
        self._objects = sum(len(matte.names) for matte in (mattes or {}).values())

    def check(self, tasks: Sequence[Task]) -> None:
        """Raise InputError for a frame that must be rendered in strips on this device, but whose file has several
        parts or views."""
        several = self.options.encoding.parts != "one"
        held = HELD_PIXEL_BYTES if self.options.holdout is not None else 0
        for task in (task for task in tasks if not task.is_video and (several or task.right)):
            for camera in (picture_camera(view, self.options.pictures) for view in task.views):
                if self._rows(camera, held) < camera.height:
                    check_parts(camera, self.options.encoding, views=len(task.views))

    def memory_plan(self, tasks: Sequence[Task]) -> DevicePlan:
        """Return the memory plan of the frame that needs most memory. Raises CapacityError if a frame does not fit."""
        device, options, config = self._renderer.device, self.options, self._renderer.config
        framing, names = options.pictures.framing, set(options.channels)
        models, _ = self._placed(tasks[0])
        gaussians = models(sampling_of(tasks[0], options.pictures).middle)
        floats, moved = held_sh(gaussians, config).floats, tasks[0].placed is not None and "motion" in names
        samples = max(sampling_of(task, options.pictures).pictures for task in tasks)
        plans = []
        cameras = [straight_camera(task, options.pictures) for task in tasks]
        for camera in {(camera.width, camera.height): camera for camera in cameras}.values():
            if options.deep is not None:
                planes = 4 * DEEP_FLOATS * options.deep.bins
                rows = deep_rows(device, camera, options.deep.bins, samples)
            else:
                planes = HELD_PIXEL_BYTES if options.holdout is not None else 0
                rows = self._rows(camera, planes)
            strip = camera.cropped(0, 0, camera.width, rows) if rows < camera.height else camera
            drawn = [(strip, feature_floats(names))]
            if framing.supersample > 1 and (light := light_and_rest(names)[0]):
                drawn.append((finer(strip, framing), feature_floats(light)))
            for part, features in drawn:
                sizes = (on_tiles(part)[0], config, features, planes)
                plan = plan_frame(device, len(gaussians), floats, *sizes, moved)
                plans.append(DevicePlan(device.name, plan, -(-camera.height // rows)))
        return max(plans, key=lambda each: each.plan.need.total)

    def __call__(self, task: Task) -> RenderedFrame:
        """Render a frame. Raises ClsplatError if it cannot be rendered or, in strips, cannot be written."""
        device = self._renderer.device
        if not device.profile:
            return self._pair(task)
        with device.recorder.recording(wait=False) as stages:
            frame = self._pair(task)
        times = [(name, taken) for record in stages.values() for name, taken in record.kernels.items()]
        kernels = sum(taken for name, taken in times if name not in TRANSFER_COMMANDS)
        transfers = sum(taken for _, taken in times) - kernels
        return replace(frame, measured=replace(frame.measured, kernel_ms=kernels, transfer_ms=transfers))

    def _pair(self, task: Task) -> RenderedFrame:
        """Render the frame of a task, and the right eye's frame if the file has both eyes."""
        left = self._frame(task, len(task.views))
        if task.right is None:
            return left
        right = self._frame(task.right, len(task.views))
        measured = Measured(blank=left.measured.blank and right.measured.blank)
        return replace(left, right=right.planes, seconds=left.seconds + right.seconds, measured=measured)

    def _frame(self, task: Task, views: int) -> RenderedFrame:
        self._trust(task.camera)
        start, options, pipeline = time.monotonic(), self.options, self._pipeline
        camera, names, encoding = picture_camera(task, options.pictures), options.channels, options.encoding
        gaussians, moved = self._placed(task)
        frame = FrameRequest(
            task.at,
            camera_after(task, options.pictures),
            camera_before(task, options.pictures),
            lens_of(task, options.pictures),
            sampling_of(task, options.pictures),
            cut := cut_of(task, options),
            gaussians,
            moved,
        )
        if options.deep is not None:
            bins, above = options.deep.bins, header(task, options)
            slices, convert, rows_of = pipeline.draw_deep(bins, frame)
            empty = write_deep(task.path, slices, camera, rows_of(camera), bins, encoding, above, convert)
            return RenderedFrame(None, time.monotonic() - start, measured=Measured(empty))
        draw, finish = pipeline.draw(frame)
        rows = self._rows(camera, held_bytes(cut(camera)) if cut else 0)
        if rows < camera.height and not task.is_video:
            # check again, because the memory of a deep holdout depends on its surfaces
            check_parts(camera, encoding, views)
            blanks: list[bool | None] = []

            def finished(strip: Camera, names: Collection[str]) -> Planes:
                planes = draw(strip, names)
                blanks.append(pipeline.is_blank(planes, frame))
                return finish(planes)

            write_in_strips(task.path, finished, camera, names, rows, encoding, header(task, options))
            nothing = None if None in blanks else all(blanks)
            return RenderedFrame(None, time.monotonic() - start, measured=Measured(nothing))
        planes = in_strips(draw, rows)(camera, names)
        blank = pipeline.is_blank(planes, frame)
        return RenderedFrame(planes, time.monotonic() - start, finish, Measured(blank))

    def _placed(self, task: Task) -> tuple[Callable[[float], Gaussians], tuple[Gaussians | None, Gaussians | None]]:
        """Return a function from a time to the merged models, and the merged models one frame later and one earlier.

        Times are in frames relative to the task's frame. The later and the earlier models are for the channels motion
        and backward. They are None if no model is placed, or the channel is not requested.
        """
        ensemble, middle = self._ensemble, sampling_of(task, self.options.pictures).middle
        if (placed := task.placed) is None:
            return lambda time: kind_of(ensemble.models[0]), (None, None)

        def moved(channel: str, time: float) -> Gaussians | None:
            return ensemble.moved(placed[middle], placed[time]) if channel in self.options.channels else None

        return lambda time: ensemble.at(placed[time]), (moved("motion", middle + 1), moved("backward", middle - 1))

    def _trust(self, camera: Camera) -> None:
        """Run the self-test of projection along rays before the first frame whose camera projects along rays."""
        if not camera.model.along_rays or self._rays_tested:
            return

        device = self._renderer.device
        if require(device, RAY_STAGES) is not device:  # another kernel shape works, but a job keeps its shape
            raise DriverError(
                f"{device.name}: the driver failed in the kernel shape {device.shape.label}, but another shape works; "
                "run the command again"
            )
        self._rays_tested = True

    def _rows(self, camera: Camera, holdout_bytes: int) -> int:
        """Return the number of rows of a strip of the camera's picture, or the picture's height if it needs no strips.

        holdout_bytes: bytes of device memory per pixel that a holdout takes.
        """
        framing = self.options.pictures.framing
        rows = strip_rows(self._renderer.device, camera, self.options.channels, framing, holdout_bytes)
        # a row of pixels takes a float per pixel and Cryptomatte object
        floats = self._objects * camera.width * framing.supersample**2
        most = DEEP_STRIP_FLOATS // max(floats, 1)
        return rows if most >= camera.height else min(rows, max(most // TILE, 1) * TILE)


def cut_of(task: Task, options: RenderOptions) -> Cut | None:
    """Read a frame's holdout; None if the frame has no holdout. Raises InputError for an unreadable file.

    Warns if the rendered picture extends beyond the frame, but the holdout's surfaces end at the frame's edge.
    """
    if task.holdout is None or options.holdout is None:
        return None
    how, pictures, size = options.holdout, options.pictures, (task.camera.width, task.camera.height)
    holdout = read_holdout(task.holdout, size, how.channel, inverse=how.depths == "inverse")
    if how.depths == "ray":
        height, width = holdout.surfaces.counts.shape
        cosines = task.camera.cropped(holdout.x, holdout.y, width, height).cosines()
        holdout = replace(holdout, surfaces=holdout.surfaces if cosines is None else holdout.surfaces.scaled(cosines))
    cut, bent = Cut(holdout), warp_of(task, pictures) is not None
    if _reaches_out(straight_camera(task, pictures), INTERPOLATION_MARGIN_PX + 1 if bent else 0) and cut.goes_on:
        where = "where the warped picture extends beyond it" if bent else "in the overscan"
        warn(f"{task.holdout}: ends at the frame's edge, so nothing is held out {where}; render the CG with overscan")
    return cut


def _reaches_out(camera: Camera, margin: int) -> bool:
    """True if the picture has pixels more than `margin` pixels outside its frame."""
    window = camera.window
    if window is None:
        return False
    ends = (window.x + camera.width - window.width, window.y + camera.height - window.height)
    return max(-window.x, -window.y, *ends) > margin


def open_frame_renderer(
    models: Gaussians | Sequence[Gaussians | ModelSeries],
    options: RenderOptions,
    rasterizer: RasterizerConfig,
    *,
    device: str | None = None,
    memory_limit: int | None = None,
    profile: bool = False,
    mattes: Mapping[str, Matte] | None = None,
    tested: bool = True,
) -> FrameRenderer:
    """Open a device, and create the renderer of a job's frames on it. Raises DeviceError.

    models, mattes: as for `FrameRenderer`.
    device: name as for --device; None for the default device.
    memory_limit: limit of device memory in bytes; None for no limit.
    profile: add the times of kernels and transfers on the device to each frame's record.
    tested: False leaves out the self-test of the driver, for a renderer that only plans memory.
    """
    opened = open_device(device, memory_limit, profile=profile)
    kernels = (
        DEEP_STAGES
        if options.deep is not None
        else CHANNEL_STAGES
        if light_and_rest(options.channels)[1] or mattes
        else ()
    )
    if tested:
        opened = require(opened, (*FORWARD_STAGES, *kernels, *(HOLDOUT_STAGES if options.holdout is not None else ())))
    return FrameRenderer(Renderer(opened, config=rasterizer), models, options, mattes)

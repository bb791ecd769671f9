# SPDX-License-Identifier: Apache-2.0
"""One frame: from a model and a camera to the layers of its file, and to what stands in the file's header."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clsplat.camera import Camera
from clsplat.config.pictures import DeepConfig, PictureConfig
from clsplat.config.training import RasterizerConfig
from clsplat.errors import DriverError, InputError
from clsplat.files import digest, is_file
from clsplat.frame.shutter_and_lens import shutter_middle
from clsplat.frame.window import COLOUR, Layers, framed
from clsplat.images.channels import VIDEO, Encoding, Header, camera_matrices
from clsplat.images.colour import CHROMATICITIES, INTEROP, SRGB
from clsplat.sequence.settings_digest import SETTINGS, digest_of, encoding_of

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians
    from clsplat.shots.motion import Stretch

_FLAT = ("perspective", "orthographic")
"""Projections with an image plane; others have kernels of their own."""
TRANSFERS = ("read", "write", "fill")
"""Names of what a device's recorder notes that are no kernels."""


@dataclass(frozen=True, eq=False)
class Task:
    """A frame to be rendered. number, name: as `paths.Frame`; camera: of the whole frame, in its final size; after: the
    camera that motion goes to, of the same size, where motion is asked for; stretch: where the camera is while the
    shutter is open, None where it stands still; path: of the file; before: see `workers.stamp`.
    """

    number: int
    name: str
    camera: Camera
    path: Path
    after: Camera | None = None
    stretch: Stretch | None = None
    before: tuple[int, ...] | None = None

    def at(self, time: float) -> Camera:
        """The camera of the whole frame at a time in frames from the frame."""
        return self.camera if time == 0 or self.stretch is None else self.stretch.at(time)

    def seen_from(self, near: float) -> Task:
        """The frame of a model whose near plane is there."""
        after = self.after.before(near) if self.after is not None else None
        return replace(self, camera=self.camera.before(near), after=after)

    @property
    def is_video(self) -> bool:
        """Whether the file holds other frames too."""
        return self.path.suffix.lower() == VIDEO


@dataclass(frozen=True)
class RenderOptions:
    """What every frame of a job has in common. channels: of `images.channels.LAYERS`; attributes: of the file's header;
    pictures: what is made of a frame; recorded: the model's colour space; deep: slices of a deep picture, or None;
    drawn: digest of the rasterizer's settings."""

    channels: tuple[str, ...] = ("rgb",)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    encoding: Encoding = field(default_factory=Encoding)
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)
    pictures: PictureConfig = field(default_factory=PictureConfig)
    recorded: str = "sRGB"
    deep: DeepConfig | None = None
    drawn: str = ""


def as_it_is(layers: Layers) -> Layers:
    """The same layers."""
    return layers


@dataclass(frozen=True)
class Shaded:
    """A frame before it is encoded. layers: None for one that was written strip by strip; seconds: that it took;
    kernel_ms, transfer_ms: the device's, None if not asked for; blank: whether nothing of the model is in it,
    None where that was not looked at; finish: what is left to do to the layers, for who
    encodes them, in another thread."""

    layers: Layers | None
    seconds: float
    kernel_ms: float | None = None
    transfer_ms: float | None = None
    blank: bool | None = None
    finish: Callable[[Layers], Layers] = as_it_is


Shader = Callable[[Task], Shaded]


def picture_camera(task: Task, options: RenderOptions) -> Camera:
    """The camera of the picture that is written: its size, its window, the middle of the shutter.

    Raises InputError for a region that is not in the frame.
    """
    middle = task.at(shutter_middle(options.pictures.sampling))
    return framed(middle, options.pictures.framing)


def camera_after(task: Task, options: RenderOptions) -> Camera | None:
    """The camera of the whole frame that motion goes to: a frame later than the middle of the shutter."""
    middle = shutter_middle(options.pictures.sampling)
    return task.after if middle == 0 or task.after is None else task.at(middle + 1)


def settings_digest(task: Task, options: RenderOptions) -> str:
    """Of all that a frame of the model depends on: cameras, channels, encoding, pictures, rasterizer."""
    extension, pictures = task.path.suffix.lower(), options.pictures
    cameras = [picture_camera(task, options)]
    if "motion" in options.channels and (after := camera_after(task, options)) is not None:
        cameras.append(after)
    if pictures.sampling.moves:
        opens, closes = pictures.sampling.shutter
        cameras += [task.at(opens + (closes - opens) * part / 4) for part in range(5)]
    sampling = pictures.sampling if pictures.sampling.on else None
    made = (options.channels, options.background, options.recorded, options.deep, options.drawn)
    colour = replace(pictures.colour, ocio_config=_content(pictures.colour.ocio_config))
    return digest_of(cameras, made, encoding_of(options.encoding, extension), colour, pictures.framing, sampling)


def _content(source: str) -> str:
    """What a file of OpenColorIO's says, as its SHA-256; of another configuration its name."""
    path = Path(source)
    return _digest_at(source, path.stat().st_mtime_ns) if source and is_file(path) else source


@lru_cache(maxsize=8)
def _digest_at(path: str, changed: int) -> str:  # noqa: ARG001  # asked anew where the file has changed
    return digest(path)


def header(task: Task, options: RenderOptions) -> Header:
    """Frame, model, version, settings and colour space; the matrices of a camera that has them; in EXR the window."""
    camera = picture_camera(task, options)
    matrices = camera_matrices(camera)
    attributes = {**options.attributes, "clsplat:frame": task.number, SETTINGS: settings_digest(task, options)}
    space = str(attributes.get("clsplat:colorspace", SRGB))
    if task.path.suffix.lower() != ".exr":
        return Header(attributes, matrices, is_srgb=space == SRGB)
    if "clsplat:colorspace" in attributes and (name := INTEROP.get(space)):
        attributes["colorInteropID"] = name
    return Header(attributes, matrices, camera.window, chromaticities=CHROMATICITIES.get(space, ()))


class FrameShader:
    """Renders frames of one model on one device. A frame that is too large to be held is written as well."""

    def __init__(self, renderer: Any, gaussians: Gaussians, options: RenderOptions) -> None:
        """renderer: a `Renderer`. Raises InputError for settings and colour spaces that make no sense."""
        from clsplat.frame.pipeline import Pictures

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
            from clsplat.frame.deep_exr import write_deep

            model, camera = (self._renderer, self._gaussians), picture_camera(task, options)
            write_deep(task.path, *model, camera, options.deep, encoding, head, pictures.colours)
        return Shaded(None, time.monotonic() - start)

    def _trust(self, camera: Camera) -> None:
        """Self-test what panoramas and fisheyes need before the first of them."""
        if camera.projection in _FLAT or self._rays_tested:
            return
        from clsplat.selftest.result import RAYS
        from clsplat.selftest.trust import require

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
    from clsplat.device.context import open_device
    from clsplat.rendering.rasterizer import Renderer
    from clsplat.selftest.result import CHANNELS, DEEP, FORWARD
    from clsplat.selftest.trust import require

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
    from clsplat.device.context import Device, select

    opened = Device(select(device), profile=True)
    opened.memory.limit = memory_limit
    return opened

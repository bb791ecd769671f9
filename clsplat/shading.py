# SPDX-License-Identifier: Apache-2.0
"""One frame: from a model and a camera to the layers of its file, and to what stands in the file's header."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.config import RasterizerConfig
from clsplat.layers import Encoding, Header, camera_matrices

if TYPE_CHECKING:
    from clsplat.gaussians import Gaussians

Layers = dict[str, NDArray[Any]]
_FIELDS = {"normals": "normal", "position": "position", "motion": "motion"}
"""What the renderer calls the channels that it makes only when asked."""
_PLANES = {"depth": "depth", "median": "median", "first": "first", "count": "count", "id": "index"}
"""And those that it always makes beside colour."""
_FLAT = ("perspective", "orthographic")
"""Projections with an image plane; others have kernels of their own."""
TRANSFERS = ("read", "write", "fill")
"""Names of what a device's recorder notes that are no kernels."""


@dataclass(frozen=True, eq=False)
class Task:
    """A frame to be rendered. number, name: as `paths.Frame`; camera: in the size of the picture; after: the camera
    that motion goes to, of the same size, where motion is asked for; path: of the file; before: see `render_job.stamp`.
    """

    number: int
    name: str
    camera: Camera
    path: Path
    after: Camera | None = None
    before: tuple[int, ...] | None = None


@dataclass(frozen=True)
class RenderOptions:
    """What every frame of a job has in common. channels: of `layers.LAYERS`; attributes: of the file's header."""

    channels: tuple[str, ...] = ("rgb",)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    encoding: Encoding = field(default_factory=Encoding)
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)


@dataclass(frozen=True)
class Shaded:
    """A frame before it is encoded. seconds: that it took; kernel_ms, transfer_ms: the device's, None if not asked
    for."""

    layers: Layers
    seconds: float
    kernel_ms: float | None = None
    transfer_ms: float | None = None


Shader = Callable[[Task], Shaded]


def renderer_channels(channels: tuple[str, ...]) -> tuple[str, ...]:
    """What `Renderer.render_channels` calls those of them that it makes only when asked."""
    return tuple(own for name, own in _FIELDS.items() if name in channels)


def beside_colour(channels: tuple[str, ...]) -> bool:
    """Whether any of them takes more than `Renderer.render`."""
    return not set(channels) <= {"rgb", "alpha"}


def shade(renderer: Any, gaussians: Gaussians, task: Task, options: RenderOptions) -> Layers:
    """The layers of a frame by name, (H, W) or (H, W, channels), as `layers.write_layers` takes them.

    renderer: a `Renderer`. They need not be contiguous: what puts them in order is left to who encodes them, which is
    another thread. Motion is turned over here: docs/channels.md has y down, and in files v is up.
    """
    camera, wanted = task.camera, options.channels
    if not beside_colour(wanted):
        result = renderer.render(gaussians, camera, options.background, contiguous=False)
        made: Layers = {"rgb": result.image, "alpha": result.alpha}
    else:
        result, found = renderer.render_channels(
            gaussians,
            camera,
            renderer_channels(wanted),
            after=task.after,
            background=options.background,
            contiguous=False,
        )
        made = {"rgb": result.image, "alpha": result.alpha}
        made.update({name: getattr(found, own) for name, own in _PLANES.items()})
        made.update({name: found.fields[own] for name, own in _FIELDS.items() if name in wanted})
        if "motion" in wanted:
            made["motion"] = made["motion"] * np.array([1, -1], np.float32)
    return {name: made[name] for name in wanted}


def header(task: Task, options: RenderOptions) -> Header:
    """Frame, model and version; the matrices of a perspective camera."""
    matrices = camera_matrices(task.camera) if task.camera.projection == "perspective" else {}
    return Header({**options.attributes, "clsplat:frame": task.number}, matrices)


def open_shader(
    gaussians: Gaussians,
    options: RenderOptions,
    rasterizer: RasterizerConfig,
    *,
    device: str | None = None,
    memory_limit: int | None = None,
    profile: bool = False,
) -> Shader:
    """A function that renders frames of the model on the device that `device` names. Raises DeviceError.

    profile: note what the device is busy with.
    """
    import time

    from clsplat.device.context import open_device
    from clsplat.rendering import Renderer
    from clsplat.selftest_result import CHANNELS, FORWARD, RAYS
    from clsplat.trust import require

    opened: Any = _profiled(device, memory_limit) if profile else open_device(device, memory_limit)
    require(opened, (*FORWARD, *(CHANNELS if beside_colour(options.channels) else ())))
    renderer = Renderer(opened, config=rasterizer)
    tested: list[tuple[str, ...]] = []

    def shader(task: Task) -> Shaded:
        if task.camera.projection not in _FLAT and RAYS not in tested:
            require(opened, RAYS)
            tested.append(RAYS)
        start = time.monotonic()
        if not profile:
            return Shaded(shade(renderer, gaussians, task, options), time.monotonic() - start)
        with opened.recorder.recording(opened, wait=False) as stages:
            layers = shade(renderer, gaussians, task, options)
            seconds = time.monotonic() - start
        times = [(name, taken) for record in stages.values() for name, taken in record.kernels.items()]
        kernels = sum(taken for name, taken in times if name not in TRANSFERS)
        return Shaded(layers, seconds, kernels, sum(taken for _, taken in times) - kernels)

    return shader


def _profiled(device: str | None, memory_limit: int | None) -> Any:
    from clsplat.device.context import Device, select

    opened = Device(select(device), profile=True)
    opened.memory.limit = memory_limit
    return opened

# SPDX-License-Identifier: Apache-2.0
"""Settings that a job takes from a USD stage, unless a flag of `clsplat render` overrides them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil

from clsplat.camera import Camera
from clsplat.config.pictures import FramingConfig, PictureConfig, SamplingConfig
from clsplat.errors import InputError
from clsplat.sequence.task import Task
from clsplat.shots import Shot
from clsplat.shots.readers.usd_settings import FULL_DATA_WINDOW, window_named

_STAGE_FLOAT32_TOLERANCE = 1e-6
"""Tolerance for equal fractions of a frame: a stage stores them in float32."""
_PIXEL_CENTRE_TOLERANCE_PX = 1e-3
"""Tolerance in pixels for an edge on a pixel's centre: the float32 precision in a picture 16384 pixels wide."""


def with_stage(
    pictures: PictureConfig, source: object, shot: Shot, tasks: Sequence[Task]
) -> tuple[PictureConfig, tuple[str, ...]]:
    """Settings with the stage's data window and the first frame's shutter and lens; and the names of stage settings
    that are not applied.

    Raises InputError for a data window without a pixel.
    """
    unapplied = (*_lens_unapplied(pictures.sampling, tasks), *_shape_unsaid(tasks[0]))
    if (
        pictures.framing.region == ""
        and pictures.framing.overscan == "0"
        and shot.window not in (None, FULL_DATA_WINDOW)
    ):
        assert shot.window is not None
        framing = _framing(pictures.framing, source, shot.window, tasks[0].camera)
        if framing is None:
            unapplied += window_named(shot.window)
        else:
            pictures = replace(pictures, framing=framing)
    return replace(pictures, sampling=tasks[0].sampling or pictures.sampling), unapplied


def _shape_unsaid(task: Task) -> tuple[str, ...]:
    """A note on the stage's pixel aspect ratio, if the file format cannot store it and so shows square pixels."""
    shape, kind = task.camera.fy / task.camera.fx, task.path.suffix.lower()
    if task.optics is None or kind == ".exr" or abs(shape - 1) < _STAGE_FLOAT32_TOLERANCE:
        return ()
    return (f"pixelAspectRatio ({shape:g}) in {kind} files, which show square pixels",)


def _framing(
    framing: FramingConfig, source: object, window: tuple[float, float, float, float], camera: Camera
) -> FramingConfig | None:
    """The framing that renders a data window, as a region or an overscan of the camera's frame.

    A pixel is rendered if the window covers its centre. The result is None if the window extends beyond the frame on
    one side but is not an overscan.
    """
    left, bottom, right, top = window
    width, height = camera.width, camera.height
    if min(left, bottom, 1 - right, 1 - top) >= -_STAGE_FLOAT32_TOLERANCE:
        edges = (left * width, (1 - top) * height, right * width, (1 - bottom) * height)
        x, y, end_x, end_y = (max(ceil(edge - 0.5 - _PIXEL_CENTRE_TOLERANCE_PX), 0) for edge in edges)
        if x >= end_x or y >= end_y:
            raise InputError(
                f"{source}: {window_named(window)[0]} holds no pixel of {width}x{height}, expected one; or give "
                "--region"
            )
        return replace(framing, region=f"{x},{y},{end_x - x},{end_y - y}")
    shares = (-left, -bottom, right - 1, top - 1)
    if max(shares) - min(shares) < _STAGE_FLOAT32_TOLERANCE and max(shares) <= 1:
        return replace(framing, overscan=f"{100 * shares[0]:.5g}%")
    return None


def _lens_unapplied(flags: SamplingConfig, tasks: Sequence[Task]) -> tuple[str, ...]:
    """A note on the stage's lens, if no flag overrides it and no picture shows its blur.

    This happens if the lens has no focus distance, or the camera is orthographic.
    """
    if flags.aperture is not None or flags.f_stop is not None:
        return ()
    for task in tasks:
        if task.optics and task.optics.f_stop and not (task.sampling and task.sampling.has_lens):
            return tuple(replace(task.optics, shutter=(0.0, 0.0)).named())
    return ()

# SPDX-License-Identifier: Apache-2.0
"""A stage's part of a job's pictures, where no flag of `clsplat render` goes before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from typing import Any

from clsplat.errors import InputError
from clsplat.sequence.task import RenderOptions, Task
from clsplat.shots import Shot
from clsplat.shots.usd_settings import WHOLE, window_named

_SAME = 1e-6
"""Shares of a frame that are one: a stage has them in float32."""
_ON_CENTRE = 1e-3
"""Pixels: an edge so near a pixel's centre lies on it, as float32 is not better in a picture 16384 wide."""


def with_stage(
    options: RenderOptions, source: object, shot: Shot, tasks: Sequence[Task]
) -> tuple[RenderOptions, tuple[str, ...]]:
    """The options with the stage's data window and the first frame's shutter and lens; and what of the stage they do
    not apply. Raises InputError for a data window without a pixel."""
    pictures, unapplied = options.pictures, (*_lens_unapplied(options, tasks), *_shape_unsaid(tasks[0]))
    if pictures.framing.region == "" and pictures.framing.overscan == "0" and shot.window not in (None, WHOLE):
        assert shot.window is not None
        changes = _framing(source, shot.window, tasks[0].camera.width, tasks[0].camera.height)
        unapplied += window_named(shot.window) if changes is None else ()
        pictures = replace(pictures, framing=replace(pictures.framing, **(changes or {})))
    return replace(options, pictures=replace(pictures, sampling=tasks[0].sampling or pictures.sampling)), unapplied


def _shape_unsaid(task: Task) -> tuple[str, ...]:
    """The shape of a stage's pixels where the file cannot say it, and is shown with square ones."""
    shape, kind = task.camera.fy / task.camera.fx, task.path.suffix.lower()
    if task.optics is None or kind == ".exr" or abs(shape - 1) < _SAME:
        return ()
    return (f"pixelAspectRatio ({shape:g}) in {kind} files, which show square pixels",)


def _framing(
    source: object, window: tuple[float, float, float, float], width: int, height: int
) -> dict[str, Any] | None:
    """A data window as a region of the frame, or as overscan: those of its pixels whose centres are in it. None where
    it reaches beyond the frame and is no overscan."""
    left, bottom, right, top = window
    if min(left, bottom, 1 - right, 1 - top) >= -_SAME:
        edges = (left * width, (1 - top) * height, right * width, (1 - bottom) * height)
        x, y, end_x, end_y = (max(ceil(edge - 0.5 - _ON_CENTRE), 0) for edge in edges)
        if x >= end_x or y >= end_y:
            raise InputError(
                f"{source}: {window_named(window)[0]} holds no pixel of {width}x{height}, expected one; or give "
                "--region"
            )
        return {"region": f"{x},{y},{end_x - x},{end_y - y}"}
    shares = (-left, -bottom, right - 1, top - 1)
    if max(shares) - min(shares) < _SAME and max(shares) <= 1:
        return {"overscan": f"{100 * shares[0]:.5g}%"}
    return None


def _lens_unapplied(options: RenderOptions, tasks: Sequence[Task]) -> tuple[str, ...]:
    """The stage's lens where no flag goes before it and no picture shows it: without a depth in focus, or of an
    orthographic camera."""
    flags = options.pictures.sampling
    if flags.aperture is not None or flags.f_stop is not None:
        return ()
    for task in tasks:
        if task.optics and task.optics.f_stop and not (task.sampling and task.sampling.has_lens):
            return tuple(replace(task.optics, shutter=(0.0, 0.0)).named())
    return ()

# SPDX-License-Identifier: Apache-2.0
"""The tasks of a job: a shot's frames, where they go."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from clsplat.camera import Camera
from clsplat.config.pictures import SamplingConfig
from clsplat.errors import InputError
from clsplat.images import channels as layers
from clsplat.sequence.task import Task
from clsplat.shots import Shot
from clsplat.shots.frame_numbers import output_paths
from clsplat.shots.motion import camera_after, stretches


def make_tasks(
    chosen: Shot,
    whole: Shot,
    pattern: str,
    resize: Callable[[Camera], Camera],
    channels: Sequence[str],
    sampling: SamplingConfig | None = None,
) -> list[Task]:
    """The frames of `chosen`, which are of the shot `whole`. Raises InputError for files that would be one, unless it
    is a video, and for cameras that these channels, or the lens, are not defined for."""
    sampling = sampling or SamplingConfig()
    motion, moves = "motion" in channels, sampling.moves
    chosen.check(channels)
    if motion:
        whole.check(channels)
    at = {frame.number: index for index, frame in enumerate(whole.frames)}
    if Path(pattern).suffix.lower() == layers.VIDEO:
        paths = [Path(pattern)] * len(chosen.frames)
    else:
        paths = output_paths(pattern, [(frame.number, frame.name) for frame in chosen.frames])
    stretch = stretches(whole, resize, *sampling.shutter, motion=motion) if moves else lambda number: None
    tasks = []
    for frame, path in zip(chosen.frames, paths, strict=True):
        camera = resize(frame.camera)
        if sampling.has_lens and camera.projection != "perspective":
            raise InputError(f"depth of field: frame {frame.number} is {camera.projection}, expected perspective")
        after = None
        if motion:
            after = resize(camera_after(whole, at[frame.number])).resized(camera.width, camera.height)
        tasks.append(Task(frame.number, frame.name, camera, path, after, stretch(frame.number)))
    return tasks

# SPDX-License-Identifier: Apache-2.0
"""The hold-outs of a job's frames: a file for each, named as the pictures are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from clsplat.camera import Camera
from clsplat.config.holdout import HoldoutConfig
from clsplat.errors import warn
from clsplat.frame.holdout import Cut
from clsplat.images.holdouts import check_holdout, read_holdout
from clsplat.sequence.task import RenderOptions, Task, picture_camera
from clsplat.shots.frame_numbers import check_pattern, path_of
from clsplat.shots.stereo import for_eye


def held_out(tasks: Sequence[Task], pattern: str, config: HoldoutConfig) -> list[Task]:
    """The tasks with their hold-outs, of which one without a field for the number is every frame's, and one without a
    field for the eye both eyes'. Raises InputError for a file that is missing, or none as its header says."""
    check_pattern(for_eye(pattern, tasks[0].eye))

    def held(task: Task) -> Task:
        path = path_of(for_eye(pattern, task.eye), task.number, task.name).absolute()
        check_holdout(path, (task.camera.width, task.camera.height), config.channel)
        return replace(task, holdout=path, right=task.right and held(task.right))

    return [held(task) for task in tasks]


def cut_of(task: Task, options: RenderOptions) -> Cut | None:
    """The surfaces of a frame's hold-out, None where it has none. Warns of those that end at the frame's edge in a
    picture that goes on. Raises InputError."""
    if task.holdout is None or options.holdout is None:
        return None
    camera = picture_camera(task, options)
    cut = Cut(read_holdout(task.holdout, (task.camera.width, task.camera.height), options.holdout.channel))
    if _reaches_out(camera) and cut.goes_on:
        warn(f"{task.holdout}: ends with the frame, and nothing is held out in the overscan; render the CG with it too")
    return cut


def _reaches_out(camera: Camera) -> bool:
    """True if the picture has pixels beyond its frame."""
    window = camera.window
    if window is None:
        return False
    return (
        min(window.x, window.y) < 0
        or window.x + camera.width > window.width
        or window.y + camera.height > window.height
    )

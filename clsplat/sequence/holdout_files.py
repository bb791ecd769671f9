# SPDX-License-Identifier: Apache-2.0
"""Holdouts of a job's frames: one file for each, named by a pattern as the pictures are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from clsplat.camera import Camera
from clsplat.config.holdout import HoldoutConfig
from clsplat.errors import examples, warn
from clsplat.frame.holdout import Cut
from clsplat.frame.lens import INTERPOLATION_MARGIN_PX
from clsplat.frame.window import crop
from clsplat.images.holdouts import check_holdout, read_holdout
from clsplat.sequence.task import RenderOptions, Task, straight_camera, warp_of
from clsplat.shots.frame_numbers import check_pattern, path_of
from clsplat.shots.stereo import for_eye


def held_out(tasks: Sequence[Task], pattern: str, config: HoldoutConfig) -> list[Task]:
    """The tasks with their holdouts.

    A pattern without a field for the number names one file for all frames, and without a field for the eye one file for
    both eyes. Warns about depths in half floats. Raises InputError for a missing file or one that is no holdout.
    """
    check_pattern(for_eye(pattern, tasks[0].eye))
    coarse: dict[Path, bool] = {}

    def held(task: Task) -> Task:
        path = path_of(for_eye(pattern, task.eye), task.number, task.name).absolute()
        if check_holdout(path, (task.camera.width, task.camera.height), config.channel):
            coarse[path] = True
        return replace(task, holdout=path, right=task.right and held(task.right))

    made = [held(task) for task in tasks]
    if coarse:
        warn(
            f"{examples(coarse)}: has depths of half floats, with errors of up to 1/2000, so that Gaussians near a "
            "surface may fall on its wrong side; write the depths as floats"
        )
    return made


def cut_of(task: Task, options: RenderOptions) -> Cut | None:
    """The surfaces of a frame's holdout, None if it has none. Raises InputError.

    Warns about surfaces that end at the frame's edge if the picture extends beyond it.
    """
    if task.holdout is None or options.holdout is None:
        return None
    how, pictures, size = options.holdout, options.pictures, (task.camera.width, task.camera.height)
    holdout = read_holdout(task.holdout, size, how.channel, inverse=how.depths == "inverse")
    if how.depths == "ray":
        height, width = holdout.surfaces.counts.shape
        cosines = crop(task.camera, holdout.x, holdout.y, width, height).cosines()
        holdout = replace(holdout, surfaces=holdout.surfaces if cosines is None else holdout.surfaces.scaled(cosines))
    cut, bent = Cut(holdout), warp_of(task, pictures) is not None
    if _reaches_out(straight_camera(task, pictures), INTERPOLATION_MARGIN_PX + 1 if bent else 0) and cut.goes_on:
        where = "where the warped picture extends beyond it" if bent else "in the overscan"
        warn(f"{task.holdout}: ends with the frame, and nothing is held out {where}; render the CG with overscan")
    return cut


def _reaches_out(camera: Camera, margin: int) -> bool:
    """True if the picture has pixels more than `margin` pixels outside its frame."""
    window = camera.window
    if window is None:
        return False
    ends = (window.x + camera.width - window.width, window.y + camera.height - window.height)
    return max(-window.x, -window.y, *ends) > margin

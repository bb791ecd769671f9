# SPDX-License-Identifier: Apache-2.0
"""Tasks of stereo pairs: one frame per eye, in two files or as two views of one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from clsplat.camera import Camera
from clsplat.config.pictures import SamplingConfig
from clsplat.errors import InputError
from clsplat.images.frame_files import VIDEO_SUFFIXES
from clsplat.sequence.task import Task, make_tasks
from clsplat.shots import Shot
from clsplat.shots.stereo import EYE_FIELD_PATTERN, for_eye


def make_views(
    shots: Mapping[str, Shot],
    frames: str | None,
    pattern: str,
    resize: Callable[[Camera], Camera],
    channels: Sequence[str],
    sampling: SamplingConfig | None = None,
) -> tuple[list[Task], Shot]:
    """Tasks from `task.make_tasks` for each eye, and the chosen frames of the first shot.

    shots: shots by eye; a shot without a pair is under "".
    The two eyes' frames alternate. If the pattern has no field for the eye, they become views of one file. Raises
    InputError in the cases of `make_tasks` and `Shot.only`.
    """
    chosen = {eye: shot if frames is None else shot.only(frames) for eye, shot in shots.items()}
    first = next(iter(chosen.values()))
    if not any(shots) and EYE_FIELD_PATTERN.search(pattern.replace("%v", "")):
        raise InputError(f"{pattern}: has an eye's name in it, expected --stereo DISTANCE with it")
    if len(shots) == 2 and Path(pattern).suffix.lower() in VIDEO_SUFFIXES:
        raise InputError(f"{pattern}: a video holds one eye, expected --eye left or right with it")
    one_file = len(shots) == 2 and not EYE_FIELD_PATTERN.search(pattern)
    if one_file and Path(pattern).suffix.lower() != ".exr":
        raise InputError(
            f"{pattern}: has no {{eye}} in it, expected one to tell left from right, the name of an .exr, which holds "
            "both, or --eye left or right"
        )
    made = [
        [
            replace(task, eye=eye)
            for task in make_tasks(some, shots[eye], for_eye(pattern, eye), resize, channels, sampling)
        ]
        for eye, some in chosen.items()
    ]
    pairs = list(zip(*made, strict=True))
    if one_file:
        return [replace(left, right=right) for left, right in pairs], first
    return [task for pair in pairs for task in pair], first

# SPDX-License-Identifier: Apache-2.0
"""Render tasks of a shot: one for each frame and eye, with cameras, shutter, lens, holdout and file name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from clsplat.camera import Camera
from clsplat.config.pictures import VIDEO_SUFFIXES, HoldoutConfig, SamplingConfig
from clsplat.errors import InputError, examples, warn
from clsplat.images.holdouts import check_holdout
from clsplat.sequence.task import Task
from clsplat.shots import Shot
from clsplat.shots import motion as moving
from clsplat.shots.frame_numbers import check_pattern, output_paths, path_of
from clsplat.shots.optics import Optics
from clsplat.shots.stereo import EYE_FIELD_PATTERN, for_eye


def make_views(
    shots: Mapping[str, Shot],
    frames: str | None,
    pattern: str,
    resize: Callable[[Camera], Camera],
    channels: Sequence[str],
    sampling: SamplingConfig | None = None,
) -> tuple[list[Task], Shot]:
    """Make the tasks of both eyes, or of one camera. Returns the tasks, and the chosen frames of the first shot.

    shots: shots by eye, "left" and "right"; without stereo a single shot with the key "".
    frames: numbers of the frames to render, as in --frames; None for all.
    pattern: pattern of the file names.
    resize: function that returns a camera at the size to render.
    channels: names of the channels to render.
    sampling: shutter and lens that the flags set; None for the defaults.
    The tasks of the two eyes alternate. If the pattern has no field for the eye, both eyes are views in one file.
    Raises InputError like `make_tasks` and `Shot.only`.
    """
    chosen = {eye: shot if frames is None else shot.only(frames) for eye, shot in shots.items()}
    first = next(iter(chosen.values()))
    if not any(shots) and EYE_FIELD_PATTERN.search(pattern.replace("%v", "")):
        raise InputError(f"{pattern}: has a field for the eye, expected --stereo DISTANCE with it")
    if len(shots) == 2 and Path(pattern).suffix.lower() in VIDEO_SUFFIXES:
        raise InputError(f"{pattern}: a video holds one eye, expected --eye left or right with it")
    one_file = len(shots) == 2 and not EYE_FIELD_PATTERN.search(pattern)
    if one_file and Path(pattern).suffix.lower() != ".exr":
        raise InputError(
            f"{pattern}: has no {{eye}} in it; expected a name with {{eye}}, the name of an .exr file, which holds "
            "both eyes, or --eye left or right"
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


def make_tasks(
    chosen: Shot,
    whole: Shot,
    pattern: str,
    resize: Callable[[Camera], Camera],
    channels: Sequence[str],
    sampling: SamplingConfig | None = None,
) -> list[Task]:
    """Make the tasks for the frames of `chosen`, which are some or all frames of the shot `whole`.

    pattern, resize, channels, sampling: as for `make_views`.
    Raises InputError if two frames share a file that is not a video, or if a camera does not support the channels or
    depth of field.
    """
    sampling = sampling or SamplingConfig()
    motion, backward = "motion" in channels, "backward" in channels
    whole.check(channels)
    indices = {frame.number: index for index, frame in enumerate(whole.frames)}
    if Path(pattern).suffix.lower() in VIDEO_SUFFIXES:
        paths = [Path(pattern)] * len(chosen.frames)
    else:
        paths = output_paths(pattern, [(frame.number, frame.name) for frame in chosen.frames])
    stretch: Callable[[int], Shot | None] = lambda number: None  # noqa: E731
    if sampling.shutter != (0.0, 0.0) and whole.moment is None:
        stretch = moving.stretches(whole, resize, *sampling.shutter, motion=motion, backward=backward)
    numbers = [frame.number for frame in whole.frames]
    ends = (numbers[0], numbers[-1]) if len(numbers) > 1 else None
    tasks = []
    for frame, path in zip(chosen.frames, paths, strict=True):
        camera = resize(frame.camera)
        own = settled(sampling, frame.optics, camera)
        own.check()
        if own.has_lens and not camera.is_pinhole:
            raise InputError(f"depth of field: frame {frame.number} is {camera.projection}, expected perspective")
        looked_at = moving.moments(whole, resize, frame.number, own) or stretch(frame.number)
        beside = moving.targets(whole, resize, indices[frame.number], own.middle, motion=motion, backward=backward)
        after, earlier = (other and other.resized(camera.width, camera.height) for other in beside)
        looks = (after, earlier, looked_at, None, None if frame.optics is None else own, frame.optics)
        tasks.append(Task(frame.number, frame.name, camera, path, *looks, lens=frame.lens, ends=ends))
    return tasks


def settled(flags: SamplingConfig, optics: Optics | None, camera: Camera) -> SamplingConfig:
    """Return the shutter and lens of a frame: the flags' settings, or the USD stage's settings where no flag is given.

    The f-stop is converted to an aperture radius by the stage's focal length and unit, unless a flag gives the sensor
    width or the metres per unit.

    optics: shutter and lens in the USD stage; None without a stage.
    """
    if optics is None:
        return flags
    settings = flags
    if flags.shutter_angle is None and flags.shutter_open is None and any(optics.shutter):
        opens, closes = optics.shutter
        settings = replace(settings, shutter_open=opens, shutter_close=closes)
    focus = flags.focus if flags.focus is not None else optics.focus or None
    asked = flags.aperture is not None or flags.f_stop is not None
    f_stop = flags.f_stop if asked else optics.f_stop
    applies = camera.is_pinhole and (asked or focus is not None)
    if f_stop and applies:
        if flags.sensor_width is None and flags.metres is None:
            settings = replace(settings, aperture=optics.radius(f_stop), f_stop=None)
        else:
            metres = flags.metres or optics.metres
            sensor = optics.focal_length * camera.width / camera.fx * 1000 * metres
            sensor_width = flags.sensor_width or sensor
            settings = replace(settings, f_stop=f_stop, sensor_width=sensor_width, metres=metres)
    return replace(settings, focus=focus) if asked or (f_stop and applies) else settings


def held_out(tasks: Sequence[Task], pattern: str, config: HoldoutConfig) -> list[Task]:
    """Return the tasks with the paths of their holdout files.

    pattern: pattern of --holdout. Without a field for the number, all frames use one file; without a field for the eye,
        both eyes.
    Warns of depths in half floats. Raises InputError for a missing file, and for a file that is not a holdout.
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
            f"{examples(coarse)}: depths are half floats, with errors of up to 1/2000, so that Gaussians near a "
            "surface may be on the wrong side of it; write depths as 32-bit floats"
        )
    return made

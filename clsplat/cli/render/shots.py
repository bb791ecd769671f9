# SPDX-License-Identifier: Apache-2.0
"""Cameras of `clsplat render`: the shot that its flags ask for, or with --stereo a shot for each eye, and the settings
taken from a USD stage."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from clsplat.camera import Camera
from clsplat.cli.render.flags import RenderVerb
from clsplat.config.orientation import AS_IN_FILES
from clsplat.config.pictures import FramingConfig, PictureConfig, SamplingConfig
from clsplat.config.stereo import EYES, StereoConfig
from clsplat.errors import InputError
from clsplat.models.formats.usd import USD_SUFFIXES
from clsplat.runs.run import run_of
from clsplat.runs.scene_record import own_cameras
from clsplat.sequence.job_models import JobModels
from clsplat.sequence.task import Task
from clsplat.shots import Shot, check_around, choose_shot, shot_around
from clsplat.shots.readers.usd_settings import FULL_DATA_WINDOW, window_named
from clsplat.shots.stereo import pair_of_stage, shot_of

STEREO_ROLE_ATTRIBUTE = "stereoRole"
"""Attribute that marks the left and the right camera of a stage, for `--stereo stage`."""
_STAGE_FLOAT32_TOLERANCE = 1e-6
"""Tolerance for equal fractions of a frame and equal aspect ratios, which a stage stores in float32."""
_PIXEL_CENTRE_TOLERANCE_PX = 1e-3
"""Distance in pixels within which a data window's edge counts as on a pixel's centre: the precision of float32 in a
picture 16384 pixels wide."""


def shots_asked(flags: RenderVerb, models: Callable[[], JobModels]) -> dict[str, Shot]:
    """Return shots with all frames: one for each eye, keyed by "left" and "right"; without stereo one, keyed by "".

    models: function that loads the models. It is called for a path around the models, and for a single still camera,
      which shows every frame of a changing model.
    Raises InputError.
    """
    shots = _cameras_asked(flags, models)
    if all(len(shot.frames) == 1 for shot in shots.values()):
        shots = {eye: shot.standing(models().frames) for eye, shot in shots.items()}
    return shots


def _cameras_asked(flags: RenderVerb, models: Callable[[], JobModels]) -> dict[str, Shot]:
    """Return shots like `shots_asked`, from --cameras or --path. A still camera becomes a shot of a single frame."""
    pairs, size = flags.pairs, (flags.width, flags.height)
    paths = _stage_cameras(pairs, flags.cameras, flags.usd_camera) if pairs.of_stage else {}
    run = None if flags.transform else run_of(flags.model)
    if flags.cameras is None:
        if flags.usd_camera is not None:
            raise InputError(f"--usd-camera {flags.usd_camera}: expected the USD stage in --cameras with it")
        own = own_cameras(run)
        check_around(flags.path, among_own=bool(own) and flags.up is None)  # report errors before models are loaded
        frame = None if run is None else run.frame
        level = frame is not None and frame.upright
        shots = [
            shot_around(models().at(1), flags.path, count=flags.count, size=size, up=flags.up, own=own, level=level)
        ]
    elif flags.up is not None:
        raise InputError(f"--up {flags.up}: is for paths around the model, expected no --cameras with it")
    else:
        read = partial(
            choose_shot,
            flags.cameras,
            path=flags.path,
            count=flags.count,
            size=size,
            lenses=flags.lenses or "undistort",
            applied=[STEREO_ROLE_ATTRIBUTE] if paths else [],
            distort=flags.warp.distort,
            frame=AS_IN_FILES if run is None else run.frame_for(flags.cameras),
        )
        shots = [read(usd_camera=prim) for prim in paths.values() or [flags.usd_camera]]
    return _of_eyes(pairs, shots, paths)


def _stage_cameras(stereo: StereoConfig, cameras: Path | None, usd_camera: str | None) -> dict[str, str]:
    """Find the path of each eye's camera in the USD stage, for --stereo stage. Raises InputError.

    cameras, usd_camera: values of --cameras and --usd-camera; None for flags that are not given.
    """
    if cameras is None or cameras.suffix.lower() not in USD_SUFFIXES:
        raise InputError(f"--stereo stage: expected a USD stage in --cameras, not {cameras or 'none'}")
    pair = dict(zip(EYES, pair_of_stage(cameras, usd_camera), strict=True))
    return {eye: pair[eye] for eye in stereo.eyes}


def _of_eyes(stereo: StereoConfig, shots: list[Shot], paths: dict[str, str]) -> dict[str, Shot]:
    """Return a shot for each eye, keyed by "left" and "right"; without stereo a single shot, keyed by "".

    shots: the shot of the cameras; with --stereo stage, the two shots of the eyes' cameras.
    paths: path of each eye's camera in the stage.
    Raises InputError.
    """
    if not stereo.eyes:
        return {"": shots[0]}
    if stereo.of_stage:
        numbers = {tuple(frame.number for frame in shot.frames) for shot in shots}
        if len(numbers) > 1:
            raise InputError(f"--stereo stage: {' and '.join(paths.values())} have different frames, expected the same")
        return dict(zip(paths, shots, strict=True))
    convergence = math.inf if stereo.convergence is None else stereo.convergence
    return {eye: shot_of(shots[0], eye, stereo.distance, convergence) for eye in stereo.eyes}


def with_stage(
    pictures: PictureConfig, source: object, shot: Shot, tasks: Sequence[Task]
) -> tuple[PictureConfig, tuple[str, ...]]:
    """Return picture settings with a USD stage's data window, shutter and lens.

    The second result lists the names of the stage's settings that were not applied.

    source: the stage's file, for messages.
    shot: the shot read from the stage, with its data window.
    tasks: the frames of the shot. The first gives the shutter and the lens.
    Raises InputError for a data window without a pixel.
    """
    unapplied = (*_lens_unapplied(pictures.sampling, tasks), *_pixel_aspect_unapplied(tasks[0]))
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


def _pixel_aspect_unapplied(task: Task) -> tuple[str, ...]:
    """Return a note on the stage's pixel aspect ratio if this is not 1 and the picture's format cannot store it."""
    shape, kind = task.camera.fy / task.camera.fx, task.path.suffix.lower()
    if task.optics is None or kind == ".exr" or abs(shape - 1) < _STAGE_FLOAT32_TOLERANCE:
        return ()
    return (f"pixelAspectRatio ({shape:g}), because {kind} files cannot store it and viewers show square pixels",)


def _framing(
    framing: FramingConfig, source: object, window: tuple[float, float, float, float], camera: Camera
) -> FramingConfig | None:
    """Return the framing that renders a data window, as a region or an overscan of the camera's frame.

    source: the stage's file, for messages.
    window: left, bottom, right and top as fractions of the frame. A pixel is rendered if the window covers its centre.
    The result is None if the window extends beyond the frame, but not equally on all sides as an overscan does.
    """
    left, bottom, right, top = window
    width, height = camera.width, camera.height
    if min(left, bottom, 1 - right, 1 - top) >= -_STAGE_FLOAT32_TOLERANCE:
        edges = (left * width, (1 - top) * height, right * width, (1 - bottom) * height)
        x, y, end_x, end_y = (max(math.ceil(edge - 0.5 - _PIXEL_CENTRE_TOLERANCE_PX), 0) for edge in edges)
        if x >= end_x or y >= end_y:
            raise InputError(
                f"{source}: {window_named(window)[0]} contains no pixel centre of the {width}x{height} frame, expected "
                "at least one; give --region to render another part"
            )
        return replace(framing, region=f"{x},{y},{end_x - x},{end_y - y}")
    shares = (-left, -bottom, right - 1, top - 1)
    if max(shares) - min(shares) < _STAGE_FLOAT32_TOLERANCE and max(shares) <= 1:
        return replace(framing, overscan=f"{100 * shares[0]:.5g}%")
    return None


def _lens_unapplied(flags: SamplingConfig, tasks: Sequence[Task]) -> tuple[str, ...]:
    """Return a note on the stage's lens if no flag replaces this lens and the pictures lack its depth of field.

    The pictures lack depth of field if the stage gives no focus distance, or if the camera is orthographic.
    """
    if flags.aperture is not None or flags.f_stop is not None:
        return ()
    for task in tasks:
        if task.optics and task.optics.f_stop and not (task.sampling and task.sampling.has_lens):
            return tuple(replace(task.optics, shutter=(0.0, 0.0)).named())
    return ()

# SPDX-License-Identifier: Apache-2.0
"""Shots for the flags of `clsplat render`: a single shot, or with --stereo one for each eye."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

from clsplat.cli.render.flags import RenderVerb
from clsplat.config.stereo import EYES, StereoConfig
from clsplat.errors import InputError
from clsplat.models.formats.usd import USD_SUFFIXES
from clsplat.runs.run import run_of
from clsplat.runs.scene_record import own_cameras
from clsplat.sequence.job_models import JobModels
from clsplat.shots import Shot, check_around, choose_shot, shot_around
from clsplat.shots.stereo import pair_of_stage, shot_of

STEREO_ROLE_ATTRIBUTE = "stereoRole"
"""Attribute of a stereo pair's cameras, which --stereo stage applies."""


def shots_asked(flags: RenderVerb, models: Callable[[], JobModels]) -> dict[str, Shot]:
    """Shots by eye, with all frames, before --frames selects some. Without stereo there is one shot, under "".

    models: function that loads the models. Paths around the models need them, and a single still camera, which shows
      every frame of a changing model.
    Raises InputError.
    """
    shots = _cameras_asked(flags, models)
    if all(len(shot.frames) == 1 for shot in shots.values()):
        shots = {eye: shot.standing(models().frames) for eye, shot in shots.items()}
    return shots


def _cameras_asked(flags: RenderVerb, models: Callable[[], JobModels]) -> dict[str, Shot]:
    """Shots of the cameras or the path, by eye."""
    pairs, size = flags.pairs, (flags.width, flags.height)
    paths = _stage_cameras(pairs, flags.cameras, flags.usd_camera) if pairs.of_stage else {}
    if flags.cameras is None:
        if flags.usd_camera is not None:
            raise InputError(f"--usd-camera {flags.usd_camera}: expected the USD stage in --cameras with it")
        own = own_cameras(None if flags.transform else run_of(flags.model))
        check_around(flags.path, among_own=bool(own) and flags.up is None)  # before the models are loaded
        shots = [shot_around(models().at(1), flags.path, count=flags.count, size=size, up=flags.up, own=own)]
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
        )
        shots = [read(usd_camera=prim) for prim in paths.values() or [flags.usd_camera]]
    return _of_eyes(pairs, shots, paths)


def _stage_cameras(stereo: StereoConfig, cameras: Path | None, usd_camera: str | None) -> dict[str, str]:
    """Path of each eye's camera in the USD stage, for --stereo stage. Raises InputError."""
    if cameras is None or cameras.suffix.lower() not in USD_SUFFIXES:
        raise InputError(f"--stereo stage: expected a USD stage in --cameras, not {cameras}")
    pair = dict(zip(EYES, pair_of_stage(cameras, usd_camera), strict=True))
    return {eye: pair[eye] for eye in stereo.eyes}


def _of_eyes(stereo: StereoConfig, shots: list[Shot], paths: dict[str, str]) -> dict[str, Shot]:
    """Shot of each eye. Without stereo there is one shot, under "".

    shots: the cameras' shot, or that of each eye's camera in the stage.
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

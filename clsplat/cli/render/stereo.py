# SPDX-License-Identifier: Apache-2.0
"""Shots for the flags of `clsplat render`: a single shot, or with --stereo one for each eye."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from clsplat.camera import Camera
from clsplat.config.stereo import EYES, StereoConfig
from clsplat.config.training import Lenses
from clsplat.errors import InputError
from clsplat.models.formats.usd import USD_SUFFIXES
from clsplat.sequence.job_models import JobModels
from clsplat.shots import Shot, choose_shot, shot_around
from clsplat.shots.stereo import pair_of_stage, shot_of

STEREO_ROLE_ATTRIBUTE = "stereoRole"
"""Attribute of a stereo pair's cameras, which --stereo stage applies."""


@dataclass(frozen=True)
class Asked:
    """Flags that choose the shot. Fields not listed here are as in `RenderVerb`.

    model: function that loads the models, for paths around them.
    own: cameras of a run's photographs, for paths among them.
    """

    cameras: Path | None
    path: str | None
    count: int | None
    size: tuple[int | None, int | None]
    usd_camera: str | None
    lenses: Lenses
    distort: bool
    up: str | None
    model: Callable[[], JobModels]
    own: Sequence[Camera] = ()


def shots_asked(asked: Asked, pairs: StereoConfig) -> tuple[dict[str, Shot], JobModels | None]:
    """Shots by eye, with all frames, before --frames selects some. Without stereo there is one shot, under "".

    Also returns the models if the shots depend on them. This is so for paths around the models, and for a single still
    camera, which then shows every frame of a changing model. Raises InputError.
    """
    shots, cast = _cameras_asked(asked, pairs)
    if all(len(shot.frames) == 1 for shot in shots.values()):
        cast = asked.model() if cast is None else cast
        shots = {eye: shot.standing(cast.frames) for eye, shot in shots.items()}
    return shots, cast


def _cameras_asked(asked: Asked, pairs: StereoConfig) -> tuple[dict[str, Shot], JobModels | None]:
    """Shots of the cameras or the path, by eye, and the models if the path is around them."""
    paths = stage_cameras(pairs, asked.cameras, asked.usd_camera) if pairs.of_stage else {}
    if asked.cameras is not None:
        if asked.up is not None:
            raise InputError(f"--up {asked.up}: is for paths around the model, expected no --cameras with it")
        read = partial(
            choose_shot,
            asked.cameras,
            path=asked.path,
            count=asked.count,
            size=asked.size,
            lenses=asked.lenses,
            applied=[STEREO_ROLE_ATTRIBUTE] if paths else [],
            distort=asked.distort,
        )
        whole = read(usd_camera=next(iter(paths.values()), asked.usd_camera))
        return shots_of(pairs, whole, lambda path: read(usd_camera=path), paths), None
    if asked.usd_camera is not None:
        raise InputError(f"--usd-camera {asked.usd_camera}: expected the USD stage in --cameras with it")
    cast = asked.model()
    whole = shot_around(cast.at(1), asked.path, count=asked.count, size=asked.size, up=asked.up, own=asked.own)
    return shots_of(pairs, whole, lambda _: whole, {}), cast


def stage_cameras(stereo: StereoConfig, cameras: Path | None, usd_camera: str | None) -> dict[str, str]:
    """Path of each eye's camera in the USD stage, for --stereo stage. Raises InputError."""
    if cameras is None or cameras.suffix.lower() not in USD_SUFFIXES:
        raise InputError(f"--stereo stage: expected a USD stage in --cameras, not {cameras}")
    pair = dict(zip(EYES, pair_of_stage(cameras, usd_camera), strict=True))
    return {eye: pair[eye] for eye in stereo.eyes}


def shots_of(stereo: StereoConfig, whole: Shot, read: Callable[[str], Shot], paths: dict[str, str]) -> dict[str, Shot]:
    """Shot of each eye. Without stereo there is one shot, under "".

    whole: shot of the cameras themselves, or of the stage camera of the first eye.
    read: function that reads the shot of another camera of the stage, by its path.
    paths: path of each eye's camera in the stage.
    Raises InputError.
    """
    if not stereo.eyes:
        return {"": whole}
    if stereo.of_stage:
        shots = [whole, *(read(path) for path in list(paths.values())[1:])]
        numbers = {tuple(frame.number for frame in shot.frames) for shot in shots}
        if len(numbers) > 1:
            raise InputError(f"--stereo stage: {' and '.join(paths.values())} have different frames, expected the same")
        return dict(zip(paths, shots, strict=True))
    convergence = math.inf if stereo.convergence is None else stereo.convergence
    return {eye: shot_of(whole, eye, stereo.distance, convergence) for eye in stereo.eyes}

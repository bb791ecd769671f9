# SPDX-License-Identifier: Apache-2.0
"""The shots that `clsplat render` asks for, with --stereo one for each eye."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from clsplat.camera import Camera
from clsplat.config.stereo import EYES, StereoConfig
from clsplat.config.training import Lenses
from clsplat.errors import InputError
from clsplat.sequence.cast import Cast
from clsplat.shots import Shot, choose_shot, shot_around
from clsplat.shots.read import USD
from clsplat.shots.stereo import pair_of_stage, shot_of

ROLE = "stereoRole"
"""Attribute of the cameras of a pair, which --stereo stage applies."""


@dataclass(frozen=True)
class Asked:
    """The shot that the flags ask for. model: reads the models, for paths around them; own: the cameras of a run's
    photographs, for paths among them; the rest is as of `Render`."""

    cameras: Path | None
    path: str | None
    count: int | None
    size: tuple[int | None, int | None]
    usd_camera: str | None
    lenses: Lenses
    distort: bool
    up: str | None
    model: Callable[[], Cast]
    own: Sequence[Camera] = ()


def shots_asked(asked: Asked, pairs: StereoConfig) -> tuple[dict[str, Shot], Cast | None]:
    """All frames that there are, whatever --frames says, for each eye of a pair, else under ""; and the models where
    they follow from these. Raises InputError."""
    size: dict[str, Any] = {"count": asked.count, "size": asked.size}
    paths = stage_cameras(pairs, asked.cameras, asked.usd_camera) if pairs.of_stage else {}
    if asked.cameras is not None:
        if asked.up is not None:
            raise InputError(f"--up {asked.up}: is of paths around the model, expected no --cameras with it")
        of_cameras: dict[str, Any] = {"lenses": asked.lenses, "applied": [ROLE] if paths else []}
        of_cameras["distort"] = asked.distort
        read = partial(choose_shot, asked.cameras, path=asked.path, **size, **of_cameras)
        whole = read(usd_camera=next(iter(paths.values()), asked.usd_camera))
        return shots_of(pairs, whole, lambda path: read(usd_camera=path), paths), None
    if asked.usd_camera is not None:
        raise InputError(f"--usd-camera {asked.usd_camera}: expected the USD stage in --cameras with it")
    cast = asked.model()
    whole = shot_around(cast.at(1), asked.path, up=asked.up, own=asked.own, **size)
    return shots_of(pairs, whole, lambda _: whole, {}), cast


def stage_cameras(stereo: StereoConfig, cameras: Path | None, usd_camera: str | None) -> dict[str, str]:
    """By eye the camera's path in the USD stage, for --stereo stage. Raises InputError."""
    if cameras is None or cameras.suffix.lower() not in USD:
        raise InputError(f"--stereo stage: expected a USD stage in --cameras, not {cameras}")
    pair = dict(zip(EYES, pair_of_stage(cameras, usd_camera), strict=True))
    return {eye: pair[eye] for eye in stereo.eyes}


def shots_of(stereo: StereoConfig, whole: Shot, read: Callable[[str], Shot], paths: dict[str, str]) -> dict[str, Shot]:
    """By eye the shot; under "" where there are no pairs. whole: of the cameras as they are, or of the first eye of a
    stage; read: the shot of another camera of the stage; paths: of these. Raises InputError."""
    if not stereo.eyes:
        return {"": whole}
    if stereo.of_stage:
        shots = [whole, *(read(path) for path in list(paths.values())[1:])]
        numbers = {tuple(frame.number for frame in shot.frames) for shot in shots}
        if len(numbers) > 1:
            raise InputError(f"--stereo stage: {' and '.join(paths.values())} have other frames, expected the same")
        return dict(zip(paths, shots, strict=True))
    convergence = math.inf if stereo.convergence is None else stereo.convergence
    return {eye: shot_of(whole, eye, stereo.distance, convergence) for eye in stereo.eyes}

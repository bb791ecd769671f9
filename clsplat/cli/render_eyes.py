# SPDX-License-Identifier: Apache-2.0
"""The shots that `clsplat render --stereo` asks for, one for each eye."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from clsplat.config.stereo import EYES, StereoConfig
from clsplat.errors import InputError
from clsplat.shots import Shot
from clsplat.shots.read import USD
from clsplat.shots.stereo import pair_of_stage, shot_of

ROLE = "stereoRole"
"""Attribute of the cameras of a pair, which --stereo stage applies."""


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

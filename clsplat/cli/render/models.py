# SPDX-License-Identifier: Apache-2.0
"""Models of `clsplat render`, from MODEL and --transform."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from clsplat.config.channels import CRYPTOMATTE_CHANNELS
from clsplat.errors import InputError
from clsplat.sequence.job_models import JobModels, load_cast
from clsplat.sequence.numbered import is_sequence
from clsplat.shots.shot_file import is_layout, parse_transform


def read_cast(model: Path, transform: str | None, appearance: str | None) -> JobModels:
    """Load the models and place them. Raises InputError."""
    if appearance is not None and is_layout(model):
        raise InputError(f"--appearance {appearance}: is for one run's model, but {model} is a shot of several")
    if appearance is not None and is_sequence(model):
        raise InputError(f"--appearance {appearance}: is for one run's model, but {model} has a file for each frame")
    track = None if transform is None else parse_transform(transform)
    return load_cast(model, track)


def check_mattes(channels: Collection[str], ids_from: str | None, compression: str) -> None:
    """Raise InputError for mattes without their inputs, or in a file whose compression would change them."""
    if ("semantic" in channels) != (ids_from is not None):
        given = f"--ids-from {ids_from}" if ids_from is not None else "--channels semantic"
        raise InputError(f"{given}: expected --channels semantic and --ids-from together")
    if (mattes := [name for name in channels if name in CRYPTOMATTE_CHANNELS]) and compression in (
        "pxr24",
        "dwaa",
        "dwab",
    ):
        raise InputError(f"--compression {compression}: changes the ids of --channels {mattes[0]}, expected zip or piz")

# SPDX-License-Identifier: Apache-2.0
"""The models of `clsplat render`, as MODEL and --transform say."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from clsplat.config.channels import MATTES
from clsplat.errors import InputError
from clsplat.sequence.cast import Cast, load_cast
from clsplat.sequence.numbered import is_sequence
from clsplat.shots.layout import is_layout, parse_transform


def read_cast(model: Path, transform: str | None, appearance: str | None) -> Cast:
    """The models, placed where they are. Raises InputError."""
    if appearance is not None and is_layout(model):
        raise InputError(f"--appearance {appearance}: is of one run's model, {model} is a shot of several")
    if appearance is not None and is_sequence(model):
        raise InputError(f"--appearance {appearance}: is of one run's model, {model} is a file a frame")
    track = None if transform is None else parse_transform(transform)
    return load_cast(model, track)


def check_mattes(channels: Collection[str], ids_from: str | None, compression: str) -> None:
    """Raise InputError for mattes that lack what they need, or that a file would change."""
    if ("semantic" in channels) != (ids_from is not None):
        given = f"--ids-from {ids_from}" if ids_from is not None else "--channels semantic"
        raise InputError(f"{given}: expected --channels semantic and --ids-from together")
    if (mattes := [name for name in channels if name in MATTES]) and compression in ("pxr24", "dwaa", "dwab"):
        raise InputError(f"--compression {compression}: changes the ids of --channels {mattes[0]}, expected zip or piz")

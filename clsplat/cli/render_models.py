# SPDX-License-Identifier: Apache-2.0
"""The models of `clsplat render`, as MODEL and --transform say."""

from __future__ import annotations

from pathlib import Path

from clsplat.errors import InputError
from clsplat.sequence.cast import Cast, load_cast
from clsplat.shots.layout import is_layout, parse_transform


def read_cast(model: Path, transform: str | None, appearance: str | None) -> Cast:
    """The models, placed where they are. Raises InputError."""
    if appearance is not None and is_layout(model):
        raise InputError(f"--appearance {appearance}: is of one run's model, {model} is a shot of several")
    track = None if transform is None else parse_transform(transform)
    return load_cast(model, track)

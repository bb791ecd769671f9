# SPDX-License-Identifier: Apache-2.0
"""Input of a capture: a folder of photographs, or videos, whose frames become photographs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from clsplat.errors import InputError


def check_sources(sources: Sequence[Path], output: Path) -> None:
    """Check the input of a capture before anything is written.

    Raises InputError for input that is missing, for an unsupported combination, and for an output inside the input,
    whose pictures would count as photographs.
    """
    if not sources:
        raise InputError("INPUT is missing, expected a folder of photographs, or videos")
    for path in sources:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder, expected a video or a folder of photographs")
        if not path.is_dir():
            raise InputError(f"{path}: is a file, expected a folder of photographs")
        if output.resolve().is_relative_to(path.resolve()):
            raise InputError(
                f"{output}: is inside the input {path}, where its pictures would count as photographs; choose another "
                "output folder"
            )
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file, expected a folder for the results, or a new name")
    if len(sources) > 1:
        raise InputError(f"{sources[1]}: is a second input, expected one folder of photographs")

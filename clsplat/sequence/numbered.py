# SPDX-License-Identifier: Apache-2.0
"""Models with one file per frame, such as `capture.####.ply`."""

from __future__ import annotations

import hashlib
from pathlib import Path

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.models.formats import colour_space, load
from clsplat.models.series import ModelSeries
from clsplat.runs.run import model_file
from clsplat.shots.frame_numbers import has_number, numbered_files, path_of


def is_sequence(path: Path) -> bool:
    """True if a path has a field for the frame's number, such as ####, and there is no file with just this name."""
    return has_number(str(path)) and not path.exists()


def open_sequence(pattern: Path) -> tuple[ModelSeries, dict[int, Path]]:
    """Open a model with one file per frame. Returns the model, and its files by frame number.

    Only the first file is read. Raises InputError if no file matches the pattern.
    """
    found = {number: model_file(path).absolute() for number, path in numbered_files(str(pattern)).items()}
    if not found:
        first = path_of(str(pattern), 1, "")
        raise InputError(f"{pattern}: no file matches, expected one file per frame, such as {first}")
    files, space = list(found.values()), colour_space(next(iter(found.values())))

    def read(index: int) -> Gaussians:
        own = colour_space(files[index])
        if own != space:
            raise InputError(f"{files[index]}: has the colour space {own}, expected {space} like {files[0]}")
        return load(files[index], check_encoding=index == 0)  # warnings about the first file suffice

    return ModelSeries([float(number) for number in found], read, str(pattern)), found


def digest_of_name(pattern: Path) -> str:
    """Return the SHA-256 of the pattern's text. The content of a frame's files goes into `task.settings_digest`."""
    return hashlib.sha256(str(pattern).encode()).hexdigest()

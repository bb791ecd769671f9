# SPDX-License-Identifier: Apache-2.0
"""A model of a file a frame, such as `capture.####.ply`."""

from __future__ import annotations

import hashlib
from pathlib import Path

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.models.formats import colour_space, load
from clsplat.models.series import Series
from clsplat.runs.run import model_file
from clsplat.shots.frame_numbers import has_number, numbered_files, path_of


def is_sequence(path: Path) -> bool:
    """True for a name with a field for the frame's number in it, which no file has as it is."""
    return has_number(str(path)) and not path.exists()


def open_sequence(pattern: Path) -> tuple[Series, dict[int, Path]]:
    """The model, and its files by frames; the first is read. Raises InputError for none."""
    found = {number: model_file(path).absolute() for number, path in numbered_files(str(pattern)).items()}
    if not found:
        first = path_of(str(pattern), 1, "")
        raise InputError(f"{pattern}: no file has such a name, expected one a frame, such as {first}")
    files, space = list(found.values()), colour_space(next(iter(found.values())))

    def read(index: int) -> Gaussians:
        own = colour_space(files[index])
        if own != space:
            raise InputError(f"{files[index]}: is of the colour space {own}, expected {space} as {files[0]} is")
        return load(files[index], doubts=index == 0)  # what is odd of one is odd of all

    return Series([float(number) for number in found], read, str(pattern)), found


def digest_of_name(pattern: Path) -> str:
    """SHA-256 of the name: what the files hold is told frame by frame (`task.settings_digest`)."""
    return hashlib.sha256(str(pattern).encode()).hexdigest()

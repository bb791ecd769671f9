# SPDX-License-Identifier: Apache-2.0
"""Values in survey files: names of photographs, numbers in texts, and positions of cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clsplat.arrays import Float64
from clsplat.errors import InputError
from clsplat.scenes.dataset import MAX_COORDINATE, PosedImage
from clsplat.scenes.readers.colmap import name_inside


def inner_name(where: str, name: str) -> str:
    """Return a listed name as a path inside the photographs' folder: without a drive, a root or "..".

    where: beginning of the error message.
    Raises InputError if nothing legible is left.
    """
    if (inner := name_inside(name)) is None:
        raise InputError(f"{where}: has the name {name[:80]!r}, expected a photograph's file name; export it again")
    return inner


def numbers_in(text: str, count: int) -> Float64 | None:
    """Return the numbers (count,) in a text, between blanks; None for any other text, and beyond MAX_COORDINATE."""
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        return None
    return values if values.shape == (count,) and (np.abs(values) < MAX_COORDINATE).all() else None


def centres_of(images: Sequence[PosedImage]) -> Float64:
    """Return the positions (N, 3) of the cameras of images."""
    return np.stack([-image.rotation.T @ image.translation for image in images])

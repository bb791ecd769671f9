# SPDX-License-Identifier: Apache-2.0
"""Values of a camera's entry in a file, and the checks that the readers of such files share."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from clsplat.arrays import Float64, numbers
from clsplat.camera import Projection, focal_length
from clsplat.errors import InputError
from clsplat.scenes.lens import MAX_SIZE
from clsplat.scenes.transforms import Keys
from clsplat.shots.shot import MOST_FRAMES


class Entry(Keys):
    """Values of one camera, or of the file where the camera does not have them. Every method raises InputError, with
    the file and the entry."""

    def side(self, key: str) -> int:
        """Width or height in pixels."""
        side = self.number(key)
        if side is None or not 1 <= side <= MAX_SIZE or side != round(side):
            raise self.wrong(key, f"a whole number of pixels from 1 to {MAX_SIZE}")
        return round(side)

    def vector(self, key: str, size: int) -> Float64:
        """Finite numbers (size,)."""
        vector = numbers(self.get(key))
        if vector.shape != (size,) or not np.isfinite(vector).all():
            raise self.wrong(key, f"a list of {size} numbers")
        return vector

    def focal(self, key: str, size: int, projection: Projection = "perspective") -> float:
        """The focal length in pixels of an angle of view in degrees across `size` pixels."""
        try:
            return focal_length(math.radians(self.require(key)), size, projection)
        except ValueError as error:
            raise InputError(f"{self.where}: '{key}': {error}") from None


def objects(document: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """The list of objects under a key, empty where that is none."""
    given = document.get(key)
    return given if isinstance(given, list) and all(isinstance(entry, dict) for entry in given) else []


def whole_frames(where: str, what: str, begin: float, end: float) -> list[int]:
    """The whole numbers from `begin` to `end`. Raises InputError for none of them, and for too many."""
    if not (math.isfinite(end - begin) and end - begin < MOST_FRAMES):
        raise InputError(f"{where}: has the {what}s {begin:g} to {end:g}, expected at most {MOST_FRAMES:,}")
    frames = list(range(math.ceil(begin), math.floor(end) + 1))
    if not frames:
        raise InputError(f"{where}: has no whole {what} from {begin:g} to {end:g}, expected at least one")
    return frames

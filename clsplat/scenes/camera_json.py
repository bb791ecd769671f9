# SPDX-License-Identifier: Apache-2.0
"""Reading of values from camera files in JSON, with errors that name the file and the key."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float64, numbers
from clsplat.camera import Camera, Projection, focal_length
from clsplat.errors import InputError
from clsplat.scenes.dataset import MAX_COORDINATE, MAX_IMAGE_SIDE_PX

EXPORT_AGAIN_ADVICE = "export the data set again or add the value"


class Keys:
    """Values of one frame or camera in a JSON file. A value that the frame lacks is taken from the file's top level.

    where: the file, and the frame or camera in it, with which every error message begins.
    Each method raises InputError for an invalid value.
    """

    def __init__(self, path: Path, part: str | None, frame: dict[str, Any], document: dict[str, Any]) -> None:
        self.path, self.frame, self.document = path, frame, document
        self.where = str(path) if part is None else f"{path}: {part}"

    def get(self, key: str) -> Any:
        value = self.frame.get(key)
        return self.document.get(key) if value is None else value

    def text(self, key: str) -> str:
        value = self.get(key)
        if not isinstance(value, str) or not value.strip():
            trouble = f"has no '{key}'" if value is None else f"'{key}' is {short(value)}, expected text"
            raise InputError(f"{self.where}: {trouble}; {EXPORT_AGAIN_ADVICE}")
        return value

    def number(self, key: str) -> float | None:
        value = self.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_COORDINATE:
            raise self.wrong(key, "a number")
        return float(value)

    def require(self, key: str, default: float | None = None) -> float:
        """Return the number under `key`, else `default`.

        Raises InputError for an invalid value, and if there is neither a value nor a default."""
        value = self.number(key)
        if (value := default if value is None else value) is None:
            raise self.wrong(key, "a number")
        return value

    def side(self, key: str) -> int:
        """Return the value under `key`, a width or height in pixels."""
        side = self.number(key)
        if side is None or not 1 <= side <= MAX_IMAGE_SIDE_PX or side != round(side):
            raise self.wrong(key, f"a whole number of pixels from 1 to {MAX_IMAGE_SIDE_PX}")
        return round(side)

    def vector(self, key: str, size: int) -> Float64:
        """Return the value under `key`, a list of `size` finite numbers."""
        vector = numbers(self.get(key))
        if vector.shape != (size,) or not np.isfinite(vector).all():
            raise self.wrong(key, f"a list of {size} numbers")
        return vector

    def focal(self, key: str, size: int, projection: Projection = Camera.projection) -> float:
        """Return the focal length in pixels with which `size` pixels show the angle of view under `key`, in degrees.

        projection: the camera's projection, which relates the focal length to the angle of view.
        """
        try:
            return focal_length(math.radians(self.require(key)), size, projection)
        except ValueError as error:
            raise InputError(f"{self.where}: '{key}': {error}") from None

    def wrong(self, key: str, expected: str) -> InputError:
        """Return the error for a missing or invalid value. expected: valid values in words, such as "a number"."""
        value = self.get(key)
        shown = f"{value:g}" if isinstance(value, float) else short(value)
        problem = f"has no '{key}'" if value is None else f"'{key}' is {shown}"
        return InputError(f"{self.where}: {problem}, expected {expected}")


def short(value: object) -> str:
    """Return a value as text, shortened for an error message."""
    try:
        return repr(value)[:60]
    except ValueError:  # Python refuses to print an integer of thousands of digits
        return "a number of thousands of digits"


def objects(document: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """Return the list of JSON objects under a key; empty if the document has no such list."""
    given = document.get(key)
    return given if isinstance(given, list) and all(isinstance(entry, dict) for entry in given) else []

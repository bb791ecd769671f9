# SPDX-License-Identifier: Apache-2.0
"""Values of JSON files of cameras, by key, with errors that name file and key."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float64, numbers
from clsplat.camera import Projection, focal_length
from clsplat.errors import InputError
from clsplat.files import parse_json, read_document
from clsplat.scenes.data_set import MAX_NUMBER, MAX_SIZE

EXPORT_AGAIN = "export the data set anew or add it"


class Keys:
    """Values of one frame or camera, or of the file where that does not have them; `where` begins every error. Every
    method raises InputError for a value that cannot be."""

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
            raise InputError(f"{self.where}: {trouble}; {EXPORT_AGAIN}")
        return value

    def number(self, key: str) -> float | None:
        value = self.get(key)
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < MAX_NUMBER:
            raise self.wrong(key, "a number")
        return float(value)

    def require(self, key: str, default: float | None = None) -> float:
        """The number of `key`, else the default; InputError for what `number` refuses, and where there is neither."""
        value = self.number(key)
        if (value := default if value is None else value) is None:
            raise self.wrong(key, "a number")
        return value

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

    def wrong(self, key: str, expected: str) -> InputError:
        """The error for a value that is missing or cannot be."""
        value = self.get(key)
        shown = f"{value:g}" if isinstance(value, float) else short(value)
        problem = f"has no '{key}'" if value is None else f"'{key}' is {shown}"
        return InputError(f"{self.where}: {problem}, expected {expected}")


def short(value: object) -> str:
    """A value for an error's line."""
    try:
        return repr(value)[:60]
    except ValueError:  # an integer of thousands of digits
        return "an endless number"


def load_document(path: Path, expected: str = "a transforms.json", key: str = "'frames'") -> dict[str, Any]:
    """The JSON object in a file. Raises InputError, which says that `expected`, an object with `key`, was."""
    try:
        document = parse_json(read_document(path, expected), once=True)
    except ValueError as error:
        raise InputError(f"{path}: is not JSON: {error}; expected {expected}") from None
    if not isinstance(document, dict):
        raise InputError(f"{path}: holds no JSON object, expected one with {key}")
    return document


def objects(document: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """The list of objects under a key, empty where that is none."""
    given = document.get(key)
    return given if isinstance(given, list) and all(isinstance(entry, dict) for entry in given) else []

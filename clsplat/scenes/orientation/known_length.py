# SPDX-License-Identifier: Apache-2.0
"""Scale of a scene from a known length: between the cameras of two photographs, or between two points."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import PurePosixPath

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.config.orientation import ScaleRule
from clsplat.errors import InputError, examples

MIN_LENGTH_SHARE = 1e-12
"""Smallest distance that counts as a length, relative to the largest coordinate of its ends. A smaller distance may
be a rounding error of float64 coordinates."""


def metres_per_unit(rule: ScaleRule, cameras: Mapping[str, Camera]) -> float:
    """Return the length of a world unit in metres.

    rule: a known length, between points or photographs. cameras: by the names of their photographs.
    Raises InputError for unknown names, and for two ends in the same place. Callers put "--scale VALUE: " before the
    message.
    """
    if rule.kind == "points":
        ends = np.reshape(rule.ends, (2, 3))
        return rule.metres / _distance(ends, "the two points")
    first, second = _two_names(rule.names, list(cameras))
    ends = np.stack([cameras[first].position, cameras[second].position])
    return rule.metres / _distance(ends, f"the cameras of {first} and {second}")


def _distance(ends: Float64, what: str) -> float:
    distance = float(np.linalg.norm(ends[1] - ends[0]))
    if not distance > MIN_LENGTH_SHARE * float(np.abs(ends).max()):
        raise InputError(f"{what} are in the same place, expected two places with a known distance")
    return distance


def _two_names(text: str, names: list[str]) -> tuple[str, str]:
    """Return the two photographs that a text names, with a comma between them. Names may contain commas themselves.

    A name without its folder or its extension is enough if it is unique. IMG.heic stands for its copy IMG.heic.jpg.
    Raises InputError for any other text.
    """
    at = [index for index, character in enumerate(text) if character == ","]
    found = [(_matching(text[:comma], names), _matching(text[comma + 1 :], names)) for comma in at]
    for first, second in found:
        if first and second:
            if first == second:
                raise InputError(f"{first} is named twice, expected two different photographs")
            return first, second
    comma = at[len(at) // 2]
    unknown = [half.strip() for half in (text[:comma], text[comma + 1 :]) if not _matching(half, names)]
    near = [near for half in unknown for near in get_close_matches(half, names, 1)]
    hint = f"did you mean {' or '.join(near)}" if near else f"its photographs have names such as {examples(names)}"
    raise InputError(f"the scene has no photograph {' and no '.join(unknown)}; {hint}")


def _matching(text: str, names: list[str]) -> str | None:
    """Return the name of the photograph that a text stands for; None if no photograph fits, or several do."""
    text = text.strip()
    if text in names:
        return text
    paths = {name: PurePosixPath(name) for name in names}
    for readings in (
        {name: str(path.with_suffix("")) for name, path in paths.items()},
        {name: path.name for name, path in paths.items()},
        {name: path.stem for name, path in paths.items()},
        {name: PurePosixPath(path.stem).stem for name, path in paths.items()},
    ):
        if same := [name for name, reading in readings.items() if reading == text]:
            return same[0] if len(same) == 1 else None
    return None

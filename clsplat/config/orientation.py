# SPDX-License-Identifier: Apache-2.0
"""Settings of a scene's coordinate frame: its orientation (`--orient`), and the source of its scale (`--scale`)."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal

from clsplat.errors import InputError

Orient = Literal["up", "none"]
EXPECTED_SCALE = "NAME,NAME=METRES with the names of two photographs, X,Y,Z,X,Y,Z=METRES with two points, or gps"
"""Values of --scale, as text for messages."""


@dataclass(frozen=True)
class ScaleRule:
    """Source of the length of a world unit.

    kind: "gps" for the positions in the photographs' EXIF, "points" or "photographs" for a known length.
    metres: the known length; 0 with "gps".
    ends: with "points", the coordinates of two points in world units; otherwise ().
    names: with "photographs", the text before the last "=": two names with a comma between them.
    """

    kind: Literal["gps", "points", "photographs"]
    metres: float = 0.0
    ends: tuple[float, ...] = ()
    names: str = ""


def parse_scale(text: str) -> ScaleRule | None:
    """Parse the value of --scale; None if it is empty. Raises InputError."""
    if not text:
        return None
    if text == "gps":
        return ScaleRule("gps")
    wrong = InputError(f"--scale {text[:200]}: expected {EXPECTED_SCALE}")
    names, equals, length = text.rpartition("=")
    if not equals or "," not in names:
        raise wrong
    try:
        metres = float(length)
    except ValueError:
        raise wrong from None
    if not 0 < metres < inf:
        raise InputError(f"--scale {text[:200]}: the length is {length.strip()[:40]}, expected metres, a number over 0")
    try:
        ends = tuple(float(word) for word in names.split(","))
    except ValueError:
        return ScaleRule("photographs", metres, names=names)
    if len(ends) != 6 or not all(abs(value) < inf for value in ends):
        raise wrong
    return ScaleRule("points", metres, ends)


@dataclass(frozen=True)
class FrameUse:
    """How the coordinate frame of a scene is changed.

    orient: "up" turns the scene upright, with the ground at zero. "none" restores the axes that its cameras had first.
        None keeps the present axes.
    scale: value of --scale; "" keeps the present scale.
    """

    orient: Orient | None = None
    scale: str = ""

    def __bool__(self) -> bool:
        """True if the frame is changed."""
        return self.orient is not None or bool(self.scale)

    def check(self) -> None:
        """Raise InputError for an unknown value."""
        if self.orient not in ("up", "none", None):
            raise InputError(f"orient {self.orient!r}: expected 'up' or 'none'")
        parse_scale(self.scale)


AS_IN_FILES = FrameUse()
"""No change: the scene keeps the frame of its files."""

# SPDX-License-Identifier: Apache-2.0
"""The points that training starts from, where they are not the scene's alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

PointsUse = Literal["replace", "join"]
POINTS_OF_FILE = 200_000
"""Points that are kept of a file where no limit is given: scanners write tens of millions."""
SKY_RADIUS = 10.0
"""Radius of the sky's sphere, in distances of what is farthest of the scene. Density control prunes by sizes that many
times as large where there is a sky."""


@dataclass(frozen=True)
class StartPoints:
    """Points beside or in place of the scene's own. file: a cloud, empty for none; use: its relation to the scene's
    points; limit: the most points that are kept, of the file or without one of the scene's, 0 for all; sky: points of a
    sphere around the scene, 0 for none."""

    file: str = ""
    use: PointsUse = "replace"
    limit: int = 0
    sky: int = 0

    def __bool__(self) -> bool:
        return bool(self.file or self.sky or self.limit)


OWN_POINTS = StartPoints()
"""The scene's points as they are."""

# SPDX-License-Identifier: Apache-2.0
"""Settings of the points that training starts from: a point cloud's file, a limit of their number, and sky points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

PointsUse = Literal["replace", "join"]
DEFAULT_MAX_FILE_POINTS = 200_000
"""Default maximum number of points from a file, because scanners write tens of millions."""
SKY_RADIUS_RATIO = 10.0
"""Radius of the sphere of sky points, divided by the distance of the scene's farthest points from its middle.

With sky points, density control multiplies its limit of a Gaussian's size by this too.
"""


@dataclass(frozen=True)
class StartPoints:
    """Points that training starts from, in addition to or instead of the scene's own.

    file: path of a point cloud; empty for none.
    use: "replace": the file's points replace the scene's. "join": they are added.
    limit: maximum number of points to keep, of the file or else of the scene; 0 for all.
    sky: maximum number of points on a sphere around the scene; 0 for none.
    """

    file: str = ""
    use: PointsUse = "replace"
    limit: int = 0
    sky: int = 0

    def __bool__(self) -> bool:
        return bool(self.file or self.sky or self.limit)


SCENE_POINTS_ONLY = StartPoints()
"""The scene's points unchanged."""

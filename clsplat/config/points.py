# SPDX-License-Identifier: Apache-2.0
"""Points that training starts from, in addition to or instead of the scene's own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

PointsUse = Literal["replace", "join"]
DEFAULT_MAX_FILE_POINTS = 200_000
"""Default maximum number of points from a file: scanners write tens of millions."""
SKY_RADIUS_RATIO = 10.0
"""Radius of the sky's sphere, relative to the distance of the scene's farthest points from its middle.

With a sky, density control's size limit for pruning is this many times as large.
"""


@dataclass(frozen=True)
class StartPoints:
    """Points in addition to or instead of the scene's own.

    file: a point cloud, empty for none.
    use: "replace" or "join" the scene's points.
    limit: maximum number of points to keep, of the file or else of the scene; 0 for all.
    sky: number of points on a sphere around the scene, 0 for none.
    """

    file: str = ""
    use: PointsUse = "replace"
    limit: int = 0
    sky: int = 0

    def __bool__(self) -> bool:
        return bool(self.file or self.sky or self.limit)


SCENE_POINTS_ONLY = StartPoints()
"""The scene's points unchanged."""

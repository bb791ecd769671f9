# SPDX-License-Identifier: Apache-2.0
"""The known depths that training compares the render's with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

DepthSource = Literal["none", "points", "maps"]
MapKind = Literal["metric", "relative"]
DECAY = 0.01
"""Part of the depth loss's weight that is left at the last step; until then it falls by the same factor every step."""


@dataclass(frozen=True)
class DepthUse:
    """Where depths are known from. source: the scene's points, or maps beside the photographs; maps: what these hold;
    unit: world units of one step of a map of whole numbers."""

    source: DepthSource = "none"
    maps: MapKind = "metric"
    unit: float = 1e-3

    def __bool__(self) -> bool:
        return self.source != "none"


NO_DEPTH = DepthUse()
"""The use where none is asked for."""

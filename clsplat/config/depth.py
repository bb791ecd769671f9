# SPDX-License-Identifier: Apache-2.0
"""Settings of depth supervision: known depths that training compares with the render.

Depth channels of frames, expected, median or first: `config/channels.py`, `kernels/channels.cl`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

DepthSource = Literal["none", "points", "maps"]
MapKind = Literal["metric", "relative"]
DEPTH_WEIGHT_END_FRACTION = 0.01
"""Fraction of the depth loss's weight that is left at the last step. The weight falls exponentially."""


@dataclass(frozen=True)
class DepthUse:
    """Source of the known depths, and the units of depth maps.

    source: the scene's points, depth maps next to the photographs, or none.
    maps: meaning of the values in depth maps.
    unit: world units per step of an integer depth map.
    """

    source: DepthSource = "none"
    maps: MapKind = "metric"
    unit: float = 1e-3

    def __bool__(self) -> bool:
        return self.source != "none"


NO_DEPTH = DepthUse()
"""The default: no depths."""

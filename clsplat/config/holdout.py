# SPDX-License-Identifier: Apache-2.0
"""Settings of holdouts (docs/pictures.md), and the layout of their surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Depths = Literal["z", "inverse", "ray"]

HOLDOUT_SURFACE_FIELDS = ("Z", "BACK", "KEEP", "RATE")
"""Values of a surface, in order.

The depths of its front and back, the fraction of light that it transmits, and the binary logarithm of this fraction per
unit of depth. The last value is 0 for a surface without thickness.
"""


@dataclass(frozen=True)
class HoldoutConfig:
    """Settings for reading the files of --holdout."""

    channel: str = ""
    """Depth channel in --holdout's files, such as depth.Z; Z if not given. Alpha is the channel A of the same layer."""
    depths: Depths = "z"
    """Kind of the depths. z: along the camera's axis. inverse: 1 / z, as Nuke writes it. ray: distances from the
    camera."""

# SPDX-License-Identifier: Apache-2.0
"""Settings of --holdout (docs/pictures.md), and the fields of a holdout surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Depths = Literal["z", "inverse", "ray"]

HOLDOUT_SURFACE_FIELDS = ("Z", "BACK", "KEEP", "RATE")
"""Fields of a holdout surface. Z and BACK: depths of its front and back. KEEP: its transmittance. RATE: log2 of the
transmittance per unit of depth; 0 for a surface without thickness."""


@dataclass(frozen=True)
class HoldoutConfig:
    """Settings for reading the files of --holdout."""

    channel: str = ""
    """Depth channel in --holdout's files, such as depth.Z; Z if not given. Alpha is the channel A of the same layer."""
    depths: Depths = "z"
    """Kind of the depths. z: along the camera's axis. inverse: 1 / z, as Nuke writes it. ray: distances from the
    camera."""

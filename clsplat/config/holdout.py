# SPDX-License-Identifier: Apache-2.0
"""Settings of hold-outs (docs/pictures.md), and the layout of their surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Depths = Literal["z", "inverse", "ray"]

HELD = ("Z", "BACK", "KEEP", "RATE")
"""A surface: depths at which it begins and ends, the share of the light that it lets through, and the binary logarithm
of that over its length, 0 for one without length."""


@dataclass(frozen=True)
class HoldoutConfig:
    """Reading of hold-outs."""

    channel: str = ""
    """Channel of --holdout's files that has the depths, such as depth.Z; Z if not given. Their alpha is A of the same
    layer."""
    depths: Depths = "z"
    """Kind of the depths: z, along the camera's axis; inverse, 1 / z, which Nuke writes; ray, distances from the
    camera."""

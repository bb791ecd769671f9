# SPDX-License-Identifier: Apache-2.0
"""The meanings of masks and of alpha channels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

MaskMeaning = Literal["none", "ignore", "transparent"]
AlphaMeaning = Literal["blend", "ignore", "transparent"]


@dataclass(frozen=True)
class MaskUse:
    """The use of a scene's masks: their meaning, that of alpha channels, and whether masks are inverted."""

    masks: MaskMeaning = "none"
    alpha: AlphaMeaning = "blend"
    invert: bool = False


NO_MASKS = MaskUse()
"""The use where none is asked for."""

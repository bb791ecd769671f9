# SPDX-License-Identifier: Apache-2.0
"""Settings for the meaning of photographs' masks and alpha channels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

MaskMeaning = Literal["none", "ignore", "transparent"]
AlphaMeaning = Literal["blend", "ignore", "transparent"]


@dataclass(frozen=True)
class MaskUse:
    """The meanings of a scene's masks and of its alpha channels, and whether masks are inverted."""

    masks: MaskMeaning = "none"
    alpha: AlphaMeaning = "blend"
    invert: bool = False


NO_MASKS = MaskUse()
"""The default: no masks, alpha blended over the background."""

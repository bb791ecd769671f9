# SPDX-License-Identifier: Apache-2.0
"""Overlay of masks on photographs: pictures in which the masked parts are tinted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from clsplat.arrays import Float32
from clsplat.scenes.scene import View

IGNORED_OVERLAY_RGB, TRANSPARENT_OVERLAY_RGB = (0.85, 0.1, 0.1), (0.1, 0.35, 1.0)
"""Overlay colours of pixels that masks ignore (red), and of pixels that masks make transparent (blue)."""
MASK_OVERLAY_OPACITY = 0.6
"""Opacity of the overlay colour on a pixel that is fully masked."""


@dataclass(frozen=True, eq=False)
class Masked:
    """A photograph and the parts that its masks leave out.

    photograph: (H, W, 3), before masks are applied.
    ignored, clear: (H, W, 1), the fractions of each pixel that are ignored and transparent, 0 to 1.
    """

    photograph: Float32
    ignored: Float32
    clear: Float32

    @property
    def left_out(self) -> float:
        """Fraction of the photograph's pixels that masks leave out."""
        return float(np.maximum(self.ignored, self.clear).mean())

    def drawn(self) -> Float32:
        """Return the photograph (H, W, 3) with the left-out parts tinted."""
        picture = self.photograph
        for part, colour in ((self.clear, TRANSPARENT_OVERLAY_RGB), (self.ignored, IGNORED_OVERLAY_RGB)):
            picture = picture + MASK_OVERLAY_OPACITY * part * (np.array(colour, np.float32) - np.clip(picture, 0, 1))
        return np.asarray(picture, np.float32)


def masked(view: View, width: int, height: int) -> Masked:
    """Load a view's photograph at this size, and the parts of it that masks leave out.

    Raises InputError if a file does not decode.
    """
    photograph = replace(view, mask=None).load(width, height)[:, :, :3]
    none = np.zeros((height, width, 1), np.float32)
    if view.mask is None:
        return Masked(photograph, none, none)
    seen = view.load_masked(width, height)
    ignored = 1 - seen[:, :, 4:] if seen.shape[2] == 5 else none
    clear = (1 - ignored) * (1 - seen[:, :, 3:4]) if seen.shape[2] >= 4 else none
    return Masked(photograph, ignored, clear)

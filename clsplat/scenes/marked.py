# SPDX-License-Identifier: Apache-2.0
"""Photographs with what their masks leave out drawn over them, to be looked at."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from clsplat.arrays import Float32
from clsplat.scenes.scene import View

IGNORED, CLEAR = (0.85, 0.1, 0.1), (0.1, 0.35, 1.0)
"""Colours of what is ignored, and of what is transparent."""
STRENGTH = 0.6
"""Part of a left-out pixel that is of these colours; the rest is the photograph's."""


@dataclass(frozen=True, eq=False)
class Masked:
    """A photograph (H, W, 3) without its masks; ignored, clear: the parts (H, W, 1) that they leave out of it, 0 to 1,
    by what they mean."""

    photograph: Float32
    ignored: Float32
    clear: Float32

    @property
    def left_out(self) -> float:
        """Share of the pixels."""
        return float(np.maximum(self.ignored, self.clear).mean())

    def drawn(self) -> Float32:
        """The photograph (H, W, 3), coloured where something is left out."""
        picture = self.photograph
        for part, colour in ((self.clear, CLEAR), (self.ignored, IGNORED)):
            picture = picture + STRENGTH * part * (np.array(colour, np.float32) - np.clip(picture, 0, 1))
        return np.asarray(picture, np.float32)


def masked(view: View, width: int, height: int) -> Masked:
    """A view at this size. Reads its files. Raises InputError as `View.load`."""
    photograph = replace(view, mask=None).load(width, height)[:, :, :3]
    none = np.zeros((height, width, 1), np.float32)
    if view.mask is None:
        return Masked(photograph, none, none)
    seen = view.load_masked(width, height)
    ignored = 1 - seen[:, :, 4:] if seen.shape[2] == 5 else none
    clear = (1 - ignored) * (1 - seen[:, :, 3:4]) if seen.shape[2] >= 4 else none
    return Masked(photograph, ignored, clear)

# SPDX-License-Identifier: Apache-2.0
"""The contents of a data set's files, whatever its layout: images with their lenses and poses, and points."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from clsplat.arrays import Float32, Float64
from clsplat.scenes.lens import Lens

MAX_NUMBER = 1e30
"""Coordinates beyond it are damage; their squares are still finite."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image of a data set: its name, its lens at the listed size, and `cam_from_world`.

    rotation (3, 3), translation (3,), float64; path: the file, where the data set says which; split: "train", "test",
    or None where the data set has no split of its own.
    """

    name: str
    lens: Lens
    rotation: Float64
    translation: Float64
    path: Path = Path()
    split: str | None = None


@dataclass(eq=False)
class DataSet:
    """points (N, 3) float64 in the world; colors (N, 3) float32 in [0, 1]; box: instant-ngp's volume, the corners
    (low, high), world units, or None."""

    images: list[PosedImage]
    points: Float64 = field(default_factory=lambda: np.empty((0, 3)))
    colors: Float32 = field(default_factory=lambda: np.empty((0, 3), np.float32))
    box: tuple[Float64, Float64] | None = None

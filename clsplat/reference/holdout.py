# SPDX-License-Identifier: Apache-2.0
"""Holdouts: a frame without the parts of the model behind given surfaces. Float64 twin of kernels/holdout.cl.

Equation numbers refer to docs/pictures.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clsplat.arrays import Float64
from clsplat.reference.blend import layers
from clsplat.reference.project import ProjectedTwin

Surface = tuple[Float64, Float64, Float64]
"""Depths (H, W) at which a surface begins and ends, and its alpha (H, W). Depths are infinite in pixels without it."""


def let_through(surfaces: Sequence[Surface], depth: float) -> Float64:
    """Return the fraction (H, W) of light from `depth` that passes all surfaces in front of it: eq. (75)."""
    left = np.ones(surfaces[0][0].shape)
    for begin, end, alpha in surfaces:
        with np.errstate(invalid="ignore", divide="ignore"):
            part = np.where(end > begin, np.clip((depth - begin) / (end - begin), 0, 1), 1.0)
        part = np.where((alpha == 1) & (depth >= begin), 1.0, part)
        left *= np.where((depth >= begin) & (begin < np.inf), (1 - alpha) ** part, 1.0)
    return left


def held_out(
    projected: ProjectedTwin,
    width: int,
    height: int,
    surfaces: Sequence[Surface],
    background: Sequence[float] | Float64 = (0.0, 0.0, 0.0),
) -> tuple[Float64, Float64]:
    """Return colour (H, W, 3) and alpha (H, W) of a frame without the parts behind the surfaces: eqs. (76), (77)."""
    image, seen, left = np.zeros((height, width, 3)), np.zeros((height, width)), np.ones((height, width))
    for layer in layers(projected, width, height):
        through = let_through(surfaces, float(np.float32(projected.depths[layer.gaussian])))[layer.box]
        weight = np.where(layer.added, layer.before * layer.alpha, 0.0) * through
        image[layer.box] += weight[:, :, None] * projected.colors[layer.gaussian]
        seen[layer.box] += weight
        left[layer.box] = layer.after
    behind = left * let_through(surfaces, np.inf)
    return image + behind[:, :, None] * np.asarray(background, np.float64), seen

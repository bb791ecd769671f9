# SPDX-License-Identifier: Apache-2.0
"""A frame without the parts behind surfaces: float64 twin of kernels/holdout.cl. Equations are in docs/pictures.md."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clsplat.arrays import Float64
from clsplat.reference.blend import layers
from clsplat.reference.project import ProjectedTwin

Surface = tuple[Float64, Float64, Float64]
"""Depths (H, W) where a surface begins and ends, infinite in pixels that it does not cover; and its alpha (H, W)."""


def let_through(surfaces: Sequence[Surface], depth: float) -> Float64:
    """Eq. (75): the fraction of the light (H, W) that passes the surfaces up to a depth."""
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
    """Eqs. (76), (77): colour (H, W, 3) and alpha (H, W) of the frame without the parts behind the surfaces."""
    image, seen, left = np.zeros((height, width, 3)), np.zeros((height, width)), np.ones((height, width))
    for layer in layers(projected, width, height):
        through = let_through(surfaces, float(np.float32(projected.depths[layer.gaussian])))[layer.box]
        weight = np.where(layer.added, layer.before * layer.alpha, 0.0) * through
        image[layer.box] += weight[:, :, None] * projected.colors[layer.gaussian]
        seen[layer.box] += weight
        left[layer.box] = layer.after
    behind = left * let_through(surfaces, np.inf)
    return image + behind[:, :, None] * np.asarray(background, np.float64), seen

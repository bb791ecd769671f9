# SPDX-License-Identifier: Apache-2.0
"""A frame in slices by depth in float64: twin of kernels/deep.cl. Equation numbers are those of docs/pictures.md."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.reference.blend import layers
from clsplat.reference.project import Projected


def deep(projected: Projected, width: int, height: int, bounds: NDArray[np.float32]) -> Float64:
    """(bins, H, W, 6) by (70) to (73): red, green, blue, alpha, least and largest depth; bounds (bins - 1,): the depths
    at which the next bin begins, float32 as the kernel compares them."""
    slices = np.zeros((len(bounds) + 1, height, width, 6))
    left = np.ones((len(bounds) + 1, height, width))
    for layer in layers(projected, width, height):
        box, alpha, added, depth = layer.box, layer.alpha, layer.added, projected.depths[layer.gaussian]
        index = int(np.searchsorted(bounds, np.float32(depth), side="right"))
        here, u = slices[index][box], left[index][box]
        here[:, :, :3] += np.where(added, u * alpha, 0.0)[:, :, None] * projected.colors[layer.gaussian]
        here[:, :, 4] = np.where(added & (u == 1), depth, here[:, :, 4])
        here[:, :, 5] = np.where(added, depth, here[:, :, 5])
        left[index][box] = np.where(added, u * (1 - alpha), u)
    slices[:, :, :, 3] = 1 - left
    return slices

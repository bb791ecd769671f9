# SPDX-License-Identifier: Apache-2.0
"""A frame in slices by depth in float64: twin of kernels/deep.cl. Equation numbers are those of docs/pictures.md."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float64
from clsplat.reference.blend import ALPHA_MAX, TRANSMITTANCE_MIN, footprint
from clsplat.reference.project import ALPHA_MIN, Projected


def deep(
    projected: Projected, order: NDArray[np.int64], width: int, height: int, bounds: NDArray[np.float32]
) -> Float64:
    """(bins, H, W, 6) by (70) to (73): red, green, blue, alpha, least and largest depth; bounds (bins - 1,): the depths
    at which the next bin begins, float32 as the kernel compares them."""
    slices = np.zeros((len(bounds) + 1, height, width, 6))
    left = np.ones((len(bounds) + 1, height, width))
    transmittance, alive = np.ones((height, width)), np.ones((height, width), np.bool_)
    for gaussian in order:
        splat = footprint(projected, int(gaussian), width, height)
        if splat is None:
            continue
        box = (splat.rows, splat.columns)
        alpha = np.minimum(ALPHA_MAX, splat.raw)
        seen = alive[box] & (alpha >= ALPHA_MIN)
        after = transmittance[box] * (1 - alpha)
        added = seen & (after > TRANSMITTANCE_MIN)
        depth = projected.depths[gaussian]
        index = int(np.searchsorted(bounds, np.float32(depth), side="right"))
        here, u = slices[index][box], left[index][box]
        here[:, :, :3] += np.where(added, u * alpha, 0.0)[:, :, None] * projected.colors[gaussian]
        here[:, :, 4] = np.where(added & (u == 1), depth, here[:, :, 4])
        here[:, :, 5] = np.where(added, depth, here[:, :, 5])
        left[index][box] = np.where(added, u * (1 - alpha), u)
        transmittance[box] = np.where(added, after, transmittance[box])
        alive[box] &= added | ~seen
    slices[:, :, :, 3] = 1 - left
    return slices

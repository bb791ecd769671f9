# SPDX-License-Identifier: Apache-2.0
"""Tiles that a Gaussian reaches, found by evaluating every pixel: float64 twin of the tile test in kernels/."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Int64
from clsplat.reference.blend import BLEND_ALPHA_MAX
from clsplat.reference.project import ALPHA_MIN, ProjectedTwin


def touched_tiles(
    projected: ProjectedTwin, width: int, height: int, tile: int = 16, threshold: float = ALPHA_MIN
) -> list[Int64]:
    """Return, for each Gaussian, the ascending indices of tiles with a pixel centre where alpha >= threshold.

    Tiles are numbered row by row. The kernels must find all tiles of the result: a missing tile is a hole in the image,
    an additional tile only costs time. They find additional tiles, because they test whether the ellipse crosses the
    rectangle around a tile's pixel centres, which it may do between two centres. Their float32 test may err within 1e-5
    of the threshold, so compare with threshold = ALPHA_MIN * (1 + 1e-5).
    """
    tiles_x = -(-width // tile)
    result = []
    for gaussian, visible in enumerate(projected.visible):
        splat = projected.footprint(gaussian, width, height) if visible else None
        if splat is None:
            result.append(np.zeros(0, np.int64))
            continue
        rows, columns = np.nonzero(np.minimum(BLEND_ALPHA_MAX, splat.raw) >= threshold)
        above, left = (side.start for side in splat.box)
        tiles = (rows + above) // tile * tiles_x + (columns + left) // tile
        result.append(np.unique(tiles).astype(np.int64))
    return result

# SPDX-License-Identifier: Apache-2.0
"""Tiles that a Gaussian reaches, by looking at every pixel: float64 twin of the tile test in kernels/."""

from __future__ import annotations

import numpy as np

from clsplat.arrays import Int64
from clsplat.reference.blend import ALPHA_MAX, footprint
from clsplat.reference.project import ALPHA_MIN, Projected


def touched_tiles(
    projected: Projected, width: int, height: int, tile: int = 16, threshold: float = ALPHA_MIN
) -> list[Int64]:
    """Per Gaussian the tiles, ascending and row-major, that hold a pixel centre with alpha >= threshold.

    The kernels' tile set must be a superset of this: a missing tile is a hole in the image, a spare one costs only
    time. They test the ellipse against the tile's rectangle of pixel centres, which it may cut between two centres.
    A float32 test can also round the other way within about 1e-5 of the threshold: compare at
    threshold = ALPHA_MIN * (1 + 1e-5).
    """
    tiles_x = -(-width // tile)
    result = []
    for gaussian, visible in enumerate(projected.visible):
        splat = footprint(projected, gaussian, width, height) if visible else None
        if splat is None:
            result.append(np.zeros(0, np.int64))
            continue
        rows, columns = np.nonzero(np.minimum(ALPHA_MAX, splat.raw) >= threshold)
        tiles = (rows + splat.rows.start) // tile * tiles_x + (columns + splat.columns.start) // tile
        result.append(np.unique(tiles).astype(np.int64))
    return result


def tile_counts(projected: Projected, width: int, height: int, tile: int = 16) -> Int64:
    """Number of tiles that each Gaussian reaches, (N,); a lower bound for the kernels' counts."""
    return np.array([len(tiles) for tiles in touched_tiles(projected, width, height, tile)], np.int64)


def square_tiles(
    projected: Projected, width: int, height: int, tile: int = 16, slack: float = 0.0, threshold: float = ALPHA_MIN
) -> list[Int64]:
    """Tiles that have a pixel centre in a square around each Gaussian, like `touched_tiles`.

    The square is that of the longest half axis of the ellipse where alpha is `threshold`, made wider by `slack` pixels:
    what Kerbl et al.'s code lists, but for its extent of 3 sigma. The kernels' set with tile_test "square" lies between
    those of slack 0 and of a little more.
    """
    tiles_x, tiles_y = -(-width // tile), -(-height // tile)
    result = []
    for gaussian, visible in enumerate(projected.visible):
        if not visible:
            result.append(np.zeros(0, np.int64))
            continue
        sxx, sxy, syy = projected.covariances[gaussian]
        larger = 0.5 * (sxx + syy) + np.hypot(0.5 * (sxx - syy), sxy)
        budget = max(2 * np.log(projected.opacities[gaussian] / threshold), 0.0)
        reach = np.sqrt(budget * larger) + slack
        low, high = projected.means2d[gaussian] - reach, projected.means2d[gaussian] + reach
        first = np.clip(np.ceil((low - (tile - 0.5)) / tile), 0, (tiles_x, tiles_y)).astype(np.int64)
        end = np.clip(np.floor((high - 0.5) / tile) + 1, 0, (tiles_x, tiles_y)).astype(np.int64)
        columns, rows = np.arange(first[0], max(end[0], first[0])), np.arange(first[1], max(end[1], first[1]))
        result.append((rows[:, None] * tiles_x + columns).ravel())
    return result

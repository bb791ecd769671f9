# SPDX-License-Identifier: Apache-2.0
"""Order of a model's rows along a Z-order (Morton) curve, so that the Gaussians of a chunk are neighbours in space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32

ORDERED_ROWS = 65_536
"""Models with more rows than this are sorted along the curve. Smaller models keep their order."""
MORTON_BITS_PER_AXIS = 21
"""Number of bits of a cell's coordinate along each axis. Three coordinates fit into 64 bits."""
OUTLIER_SHARE = 1000
"""The box that is divided into cells leaves out outliers: along each axis, the lowest and the highest 1/1000 of the
means' coordinates."""
_BLOCK_ROWS = 1 << 15
"""Number of rows whose Morton codes are computed at a time, so that they stay in the processor's cache."""
_NOWHERE = np.uint64(2**64 - 1)
"""Code of means that are not finite. It is larger than all Morton codes, so that they come last."""
_SPREAD_STEPS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def space_order(means: Float32) -> NDArray[np.uint32]:
    """Return row numbers (n,) in the order of the rows' means (n, 3) along a Z-order curve (Morton 1966).

    The curve goes through cubic cells, 2^21 along the longest side of a box around the means without outliers
    (OUTLIER_SHARE). A mean outside the box belongs to the nearest cell. Rows of one cell keep their order. Rows whose
    means are not finite are last.

    The order is the same on every machine, because cells are computed by single operations in float64.
    """
    rows = len(means)
    finite = np.isfinite(means).all(axis=1)
    inside = means if finite.all() else means[finite]
    if len(inside) == 0:
        return np.arange(rows, dtype=np.uint32)
    low, high = _middle_box(inside)
    side = float((high - low).max())
    scale = 2.0**MORTON_BITS_PER_AXIS / side if side > 0 else 0.0
    codes = np.empty(rows, np.uint64)
    for begin in range(0, rows, _BLOCK_ROWS):
        block = slice(begin, begin + _BLOCK_ROWS)
        with np.errstate(invalid="ignore"):
            cells = (means[block].T.astype(np.float64) - low[:, None]) * scale
        cells = np.clip(np.nan_to_num(cells), 0.0, 2.0**MORTON_BITS_PER_AXIS - 1)
        x, y, z = every_third_bit(cells.astype(np.uint64))
        codes[block] = x | y << np.uint64(1) | z << np.uint64(2)
    codes[~finite] = _NOWHERE
    return np.argsort(codes, kind="stable").astype(np.uint32)


def beside_parents(sources: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return the indices (m,) that sort new rows by source, stably, so that copies stand directly behind their source.

    Takes linear time if the sources are a few ascending runs, as density control makes them.

    sources: (m,), the old row that each new row was copied from.
    """
    return np.argsort(sources, kind="stable").astype(np.uint32)


def every_third_bit(numbers: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Insert two zero bits between neighbouring bits of numbers (n,) below 2^21.

    The results for x, y and z, shifted by 0, 1 and 2 bits, together are the Morton code of a cell (x, y, z).
    """
    for shift, mask in _SPREAD_STEPS:
        numbers = (numbers | numbers << np.uint64(shift)) & np.uint64(mask)
    return numbers


def _middle_box(means: Float32) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and the highest coordinates (3,) of means (n, 3), without outliers (OUTLIER_SHARE)."""
    left_out = len(means) // OUTLIER_SHARE
    ends = [left_out, len(means) - 1 - left_out]
    sides = [np.partition(means[:, axis], ends)[ends] for axis in range(3)]
    low, high = np.array(sides, np.float64).T
    return low, high

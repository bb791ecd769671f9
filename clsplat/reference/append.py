# SPDX-License-Identifier: Apache-2.0
"""Lists of the Gaussians in each tile, by a sort of all pairs: twin of kernels/append.cl, duplicate.cl, ranges.cl."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Int64


@dataclass(frozen=True, eq=False)
class ListsTwin:
    """The Gaussian lists of all tiles, concatenated, and the first slot of each Gaussian.

    first_slots: (N,), each Gaussian's first slot: the number of pairs of all Gaussians with lower indices.
    ranges: (tiles, 2), begin and end of each tile's list; 0 and 0 for an empty list.
    gaussian_from_sorted, slot_from_sorted: (pairs,), Gaussian and slot of each entry of the lists.
    """

    first_slots: Int64
    ranges: Int64
    gaussian_from_sorted: Int64
    slot_from_sorted: Int64


def lists_of(tiles_of: Sequence[Int64], depths: NDArray[np.float32], tiles: int) -> ListsTwin:
    """Return the Gaussian lists of all tiles, each sorted by depth, with Gaussians of equal depth sorted by index.

    tiles_of: for each Gaussian, the ascending indices of the tiles that it reaches.
    depths: (N,), depths of the Gaussians.
    tiles: number of tiles.
    """
    counts = np.array([len(own) for own in tiles_of], np.int64)
    gaussian_from_slot = np.repeat(np.arange(len(counts)), counts)
    tile_from_slot = np.concatenate([np.zeros(0, np.int64), *tiles_of])
    order = np.lexsort((gaussian_from_slot, depths[gaussian_from_slot], tile_from_slot))
    lengths = np.bincount(tile_from_slot, minlength=tiles)
    ends = np.cumsum(lengths)
    ranges = np.where((lengths > 0)[:, None], np.stack([ends - lengths, ends], axis=1), 0)
    return ListsTwin(np.cumsum(counts) - counts, ranges, gaussian_from_slot[order], order)

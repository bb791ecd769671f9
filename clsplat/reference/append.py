# SPDX-License-Identifier: Apache-2.0
"""The lists of tiles, made by one sort of all pairs: the twin of kernels/append.cl, and of duplicate.cl with
ranges.cl."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Int64


@dataclass(frozen=True, eq=False)
class ListsTwin:
    """The lists of all tiles, one after the other, and the first slot of each Gaussian.

    first_slots: (N,), the number of pairs of earlier Gaussians.
    ranges: (tiles, 2), begin and end of each tile's list; 0 and 0 if it is empty.
    gaussian_from_sorted, slot_from_sorted: (pairs), Gaussian and slot of each entry of the lists.
    """

    first_slots: Int64
    ranges: Int64
    gaussian_from_sorted: Int64
    slot_from_sorted: Int64


def lists_of(tiles_of: Sequence[Int64], depths: NDArray[np.float32], tiles: int) -> ListsTwin:
    """The lists of `tiles` tiles, each in order of depth, ties by index.

    tiles_of: each Gaussian's tiles, ascending.
    depths: (N,).
    """
    counts = np.array([len(own) for own in tiles_of], np.int64)
    gaussian_from_slot = np.repeat(np.arange(len(counts)), counts)
    tile_from_slot = np.concatenate([np.zeros(0, np.int64), *tiles_of])
    order = np.lexsort((gaussian_from_slot, depths[gaussian_from_slot], tile_from_slot))
    lengths = np.bincount(tile_from_slot, minlength=tiles)
    ends = np.cumsum(lengths)
    ranges = np.where((lengths > 0)[:, None], np.stack([ends - lengths, ends], axis=1), 0)
    return ListsTwin(np.cumsum(counts) - counts, ranges, gaussian_from_slot[order], order)

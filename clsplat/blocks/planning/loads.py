# SPDX-License-Identifier: Apache-2.0
"""Loads of cells, measured with the coarse model: how much of each photograph a cell fills, and its Gaussians."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Bool, Float32, Float64, Int64
from clsplat.blocks.plan import Pair, Rectangle


def places_seen(coordinates: Float64, contributions: Iterable[Float32], otherwise: Float64) -> Float64:
    """Return the place (P, 2) that each photograph shows: the median of its pixels' coordinates on the ground.

    coordinates: (N, 2), coordinates on the ground of the coarse model's means.
    contributions: (N,) for each photograph, from `contributions_by_camera`.
    otherwise: (P, 2), places of photographs that show no Gaussian.
    The median ignores the sky and other distant parts unless they fill half of the picture.
    """
    places = otherwise.copy()
    for photograph, weights in enumerate(contributions):
        (seen,) = np.nonzero(weights)
        if not len(seen):
            continue
        for axis in (0, 1):
            along = coordinates[seen, axis]
            order = np.argsort(along, kind="stable")
            sums = np.cumsum(weights[seen][order], dtype=np.float64)
            places[photograph, axis] = along[order][np.searchsorted(sums, 0.5 * sums[-1])]
    return places


@dataclass(frozen=True, eq=False)
class CellBins:
    """Bins between all edges of some rectangles, by which sums over each rectangle are exact and cheap.

    edges: the rectangles' coordinates along both axes, sorted, each once.
    bins: (N,), the bin of each point. There are (len(edges[0]) + 1) * (len(edges[1]) + 1) bins.
    """

    rectangles: Sequence[Rectangle]
    edges: tuple[Float64, Float64]
    bins: Int64

    @classmethod
    def of(cls, coordinates: Float64, rectangles: Sequence[Rectangle]) -> CellBins:
        """Put points with coordinates (N, 2) into the bins of rectangles."""
        corners = np.array([[each.low, each.high] for each in rectangles])
        first, second = (np.unique(corners[:, :, axis]) for axis in (0, 1))
        column = np.searchsorted(first, coordinates[:, 0], "right")
        row = np.searchsorted(second, coordinates[:, 1], "right")
        return cls(rectangles, (first, second), np.asarray(column * (len(second) + 1) + row, np.int64))

    def sums(self, weights: Float32 | None = None) -> Float64:
        """Return the sum of the weights of the points in each rectangle; without weights, the number of points."""
        across, down = (len(edges) + 1 for edges in self.edges)
        if weights is None:
            weights = np.ones(len(self.bins), np.float32)
        (there,) = np.nonzero(weights)
        in_bins = np.bincount(self.bins[there], weights[there].astype(np.float64), across * down)
        table = np.zeros((across + 1, down + 1))
        table[1:, 1:] = in_bins.reshape(across, down).cumsum(axis=0).cumsum(axis=1)
        (left, right), (bottom, top) = (
            [np.searchsorted(edges, [corner[axis] for corner in corners]) + 1 for corners in self._corners]
            for axis, edges in enumerate(self.edges)
        )
        return np.maximum(table[right, top] - table[left, top] - table[right, bottom] + table[left, bottom], 0.0)

    @property
    def _corners(self) -> tuple[list[Pair], list[Pair]]:
        return [each.low for each in self.rectangles], [each.high for each in self.rectangles]


def belonging(filled: Float64, share: float) -> Bool:
    """Return which photographs belong to which cells (P, B).

    filled: (P, B), pixels of each photograph that each cell's Gaussians fill.
    share: a photograph belongs to a cell that fills at least this fraction of the pixels that its fullest cell fills.
    So each photograph belongs to at least one cell, however many cells it shows. A photograph that shows no Gaussian
    belongs to none.
    """
    return np.asarray((filled >= share * filled.max(axis=1, keepdims=True)) & (filled > 0))

# SPDX-License-Identifier: Apache-2.0
"""Few values that stand for many: codebooks of numbers and palettes of vectors. Deterministic."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from clsplat.arrays import Float32

SAMPLES = 1 << 16
LLOYD_STEPS = 20
TILE = 64
"""Vectors, and centres, of products that are made at once."""
SPREAD_ROWS, POWER_STEPS = 128, 30
"""Vectors that the direction of most variance is taken from, and steps towards it."""


def codebook(values: NDArray[np.float32], size: int = 256) -> Float32:
    """(size,), ascending, with little squared error when each value counts as the nearest.

    Where there are more values than entries: first as many entries along the sorted values as the cube root of their
    density asks for, which is the best for many entries (Panter and Dite 1951), then Lloyd's steps.
    """
    ordered = np.sort(values.ravel())
    distinct = np.unique(ordered) if len(ordered) <= SAMPLES else _thinned(ordered)
    if len(distinct) <= size:
        return np.pad(distinct, (0, size - len(distinct)), mode="edge").astype(np.float32)
    samples = _thinned(ordered).astype(np.float64)
    wanted = np.cumsum(np.concatenate([[0.0], np.diff(samples) ** (2 / 3)]))
    entries = np.interp((np.arange(size) + 0.5) / size * wanted[-1], wanted, samples)
    for _ in range(LLOYD_STEPS):
        index = nearest(entries, samples)
        count = np.bincount(index, minlength=size)
        total = np.bincount(index, samples, minlength=size)
        entries = np.where(count > 0, total / np.maximum(count, 1), entries)
    return np.asarray(entries.astype(np.float32))


def _thinned(ordered: Float32) -> Float32:
    """Evenly many of sorted values, with both ends."""
    if len(ordered) <= SAMPLES:
        return ordered
    return ordered[np.linspace(0, len(ordered) - 1, SAMPLES).round().astype(np.int64)]


def nearest(entries: NDArray[np.floating], values: NDArray[np.floating]) -> NDArray[np.intp]:
    """The index of the nearest of ascending entries, in the shape of values."""
    return np.searchsorted((entries[1:] + entries[:-1]) / 2, values)


def palette(
    vectors: Float32, size: int, iterations: int = 10, progress: Callable[[float], None] = lambda part: None
) -> tuple[Float32, NDArray[np.int64]]:
    """Up to `size` vectors, and which of them stands for each: (n, d) -> (size, d), (n,). progress: called with the
    part of them that has been found.

    k-means in two levels: clusters, and in each of them a share of the palette by its squared error, so that the work
    is n d sqrt(size) and not n d size.
    """
    count, width = vectors.shape
    size = min(size, count)
    coarse = 1 << ((size.bit_length() - 1) // 2)
    _, cluster = _k_means(vectors, coarse, iterations)
    order = np.argsort(cluster, kind="stable")
    bounds = np.searchsorted(cluster[order], np.arange(coarse + 1))
    members = [order[start:stop] for start, stop in pairwise(bounds)]
    errors = np.array(
        [vectors[rows].var(axis=0, dtype=np.float64).sum() * len(rows) if len(rows) else 0 for rows in members]
    )
    # vectors of more dimensions than clusters have structure: between a share by count and one by error
    weights = np.sqrt(errors * [len(rows) for rows in members])
    shares = np.floor(weights / max(weights.sum(), 1e-30) * (size - coarse)).astype(np.int64) + 1
    centres, labels = [], np.empty(count, np.int64)
    used = 0
    for index, (rows, share) in enumerate(zip(members, shares, strict=True)):
        progress(index / len(members))
        if not len(rows):
            continue
        clusters, label = _k_means(vectors[rows], min(int(share), len(rows)), iterations)
        centres.append(clusters)
        labels[rows] = used + label
        used += len(clusters)
    result = np.zeros((size, width), np.float32)
    result[:used] = np.concatenate(centres)
    return result, labels


def _k_means(vectors: Float32, size: int, iterations: int) -> tuple[Float32, NDArray[np.int64]]:
    """Lloyd's steps on a sample where there are many, from a beginning spread along the direction of most variance. A
    centre that no vector is left for stays where it is."""
    if size <= 1 or not np.ptp(vectors, axis=0).any():
        return vectors.mean(axis=0, keepdims=True, dtype=np.float64).astype(np.float32), np.zeros(
            len(vectors), np.int64
        )
    middle = vectors.mean(axis=0, dtype=np.float64).astype(np.float32)  # far from 0 float32 would have no digits left
    centred = vectors - middle
    sample = centred[:: max(1, len(vectors) // max(SAMPLES, 8 * size))]
    order = np.argsort(np.einsum("ij,j->i", sample, _direction(sample)), kind="stable")
    centres = sample[order[((np.arange(size) + 0.5) / size * len(order)).astype(np.int64)]]
    before: NDArray[np.int64] | None = None
    for _ in range(iterations):
        labels = _nearest_centres(sample, centres)
        if before is not None and np.array_equal(labels, before):
            break
        before = labels
        rows = np.arange(len(labels) + 1)
        members = sparse.csr_matrix((np.ones(len(labels), np.float32), labels, rows), shape=(len(labels), size))
        count = np.bincount(labels, minlength=size).astype(np.float32)[:, None]
        centres = np.where(count > 0, (members.T @ sample) / np.maximum(count, 1), centres)
    return centres + middle, _nearest_centres(centred, centres)


def _direction(vectors: Float32) -> Float32:
    """(d,) of most variance of vectors around 0, by power iteration: near is enough."""
    rows = vectors[:: max(1, len(vectors) // SPREAD_ROWS)][:SPREAD_ROWS]
    spread = (rows.T @ rows).astype(np.float64)
    axis = spread[np.diagonal(spread).argmax()]
    for _ in range(POWER_STEPS):
        axis = spread @ (axis / max(np.linalg.norm(axis), 1e-300))
    return np.asarray(axis / max(np.linalg.norm(axis), 1e-300), np.float32)


def _nearest_centres(vectors: Float32, centres: Float32) -> NDArray[np.int64]:
    """Index of the nearest centre of each vector, by |c|^2 / 2 - v c: half of the squared distance, less a number of
    v's alone. The tiles are too small for a library's threads: these wait for each other longer than they work, several
    times so on a busy machine."""
    halves = np.float32(0.5) * np.einsum("ij,ij->i", centres, centres)
    columns = [(slice(start, start + TILE), centres[start : start + TILE].T) for start in range(0, len(centres), TILE)]
    labels = np.empty(len(vectors), np.int64)
    scores = np.empty((TILE, len(centres)), np.float32)
    for start in range(0, len(vectors), TILE):
        rows = vectors[start : start + TILE]
        products = scores[: len(rows)]
        for at, part in columns:
            np.matmul(rows, part, out=products[:, at])
        labels[start : start + TILE] = np.subtract(halves, products, out=products).argmin(axis=1)
    return labels

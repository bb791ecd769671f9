# SPDX-License-Identifier: Apache-2.0
"""Deterministic vector quantisation: codebooks of numbers and palettes of vectors.

`models/formats/sog.py` sets the numbers of their entries.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from clsplat.arrays import Float32

CODEBOOK_SAMPLES = 1 << 16
LLOYD_ITERATIONS = 20
DISTANCE_TILE_ROWS = 64
"""Number of vectors, and of centres, in one block of the distance computation."""
PRINCIPAL_AXIS_SAMPLES, POWER_ITERATIONS = 128, 30
"""Number of sampled vectors, and of power iterations, for the direction of largest variance."""


def codebook(values: NDArray[np.float32], size: int = 256) -> Float32:
    """Return `size` ascending numbers, chosen so that replacing each value by the nearest makes a small squared error.

    If there are more distinct values than entries, the density of the initial entries is proportional to the cube root
    of the density of the values. This is optimal for many entries (Panter and Dite 1951). Lloyd iterations then improve
    the entries.
    """
    ordered = np.sort(values.ravel())
    distinct = np.unique(ordered) if len(ordered) <= CODEBOOK_SAMPLES else _thinned(ordered)
    if len(distinct) <= size:
        return np.pad(distinct, (0, size - len(distinct)), mode="edge").astype(np.float32)
    samples = _thinned(ordered).astype(np.float64)
    wanted = np.cumsum(np.concatenate([[0.0], np.diff(samples) ** (2 / 3)]))
    entries = np.interp((np.arange(size) + 0.5) / size * wanted[-1], wanted, samples)
    for _ in range(LLOYD_ITERATIONS):
        index = nearest(entries, samples)
        count = np.bincount(index, minlength=size)
        total = np.bincount(index, samples, minlength=size)
        entries = np.where(count > 0, total / np.maximum(count, 1), entries)
    return np.asarray(entries.astype(np.float32))


def _thinned(ordered: Float32) -> Float32:
    """At most CODEBOOK_SAMPLES evenly spaced samples of sorted values, with the first and the last value."""
    if len(ordered) <= CODEBOOK_SAMPLES:
        return ordered
    return ordered[np.linspace(0, len(ordered) - 1, CODEBOOK_SAMPLES).round().astype(np.int64)]


def nearest(entries: NDArray[np.floating], values: NDArray[np.floating]) -> NDArray[np.intp]:
    """Index of the entry nearest to each value, in the shape of `values`. The entries must be in ascending order."""
    return np.searchsorted((entries[1:] + entries[:-1]) / 2, values)


def palette(
    vectors: Float32, size: int, iterations: int = 10, progress: Callable[[float], None] = lambda part: None
) -> tuple[Float32, NDArray[np.int64]]:
    """Return a palette that approximates `vectors` (n, d), and for each vector the index (n,) of its palette entry.

    The palette has shape (size, d), or (n, d) if there are fewer vectors than `size`.
    Rows that no vector refers to may be 0.

    The method is k-means on two levels. The first level divides the vectors into clusters. The second divides each
    cluster further, and each part gives an entry of the palette. The larger a cluster and its squared error, the more
    entries it gets. The cost is n d sqrt(size) instead of n d size.

    iterations: largest number of Lloyd iterations of each k-means.
    progress: function that is called with the finished fraction.
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
    # a cluster's share of the palette is the geometric mean of its shares of the vectors and of the squared error
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
    """Divide `vectors` (n, d) into clusters. Returns the centres, and the index (n,) of each vector's nearest centre.

    The method is Lloyd's, with at most `iterations` iterations. The centres have shape (size, d), or (1, d) if all
    vectors are equal.

    If there are many vectors, the iterations use a sample of them. The initial centres lie along the direction of
    largest variance. A centre without vectors stays unchanged.
    """
    from scipy import sparse  # imported here, as the import takes 0.1 s and few commands need it

    if size <= 1 or not np.ptp(vectors, axis=0).any():
        return vectors.mean(axis=0, keepdims=True, dtype=np.float64).astype(np.float32), np.zeros(
            len(vectors), np.int64
        )
    middle = vectors.mean(axis=0, dtype=np.float64).astype(np.float32)
    centred = vectors - middle  # float32 is more precise near 0
    sample = centred[:: max(1, len(vectors) // max(CODEBOOK_SAMPLES, 8 * size))]
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
    """Approximate direction (d,) in which vectors vary most around 0, by power iteration."""
    rows = vectors[:: max(1, len(vectors) // PRINCIPAL_AXIS_SAMPLES)][:PRINCIPAL_AXIS_SAMPLES]
    spread = (rows.T @ rows).astype(np.float64)
    axis = spread[np.diagonal(spread).argmax()]
    for _ in range(POWER_ITERATIONS):
        axis = spread @ (axis / max(np.linalg.norm(axis), 1e-300))
    return np.asarray(axis / max(np.linalg.norm(axis), 1e-300), np.float32)


def _nearest_centres(vectors: Float32, centres: Float32) -> NDArray[np.int64]:
    """Index of each vector's nearest centre, which has the smallest |c|^2 / 2 - v c = (|v - c|^2 - |v|^2) / 2.

    The products v c are computed in blocks so small that the BLAS library does not split them among threads. Threads
    would make the search several times slower on a busy machine.
    """
    halves = np.float32(0.5) * np.einsum("ij,ij->i", centres, centres)
    columns = [
        (slice(start, start + DISTANCE_TILE_ROWS), centres[start : start + DISTANCE_TILE_ROWS].T)
        for start in range(0, len(centres), DISTANCE_TILE_ROWS)
    ]
    labels = np.empty(len(vectors), np.int64)
    scores = np.empty((DISTANCE_TILE_ROWS, len(centres)), np.float32)
    for start in range(0, len(vectors), DISTANCE_TILE_ROWS):
        rows = vectors[start : start + DISTANCE_TILE_ROWS]
        products = scores[: len(rows)]
        for at, part in columns:
            np.matmul(rows, part, out=products[:, at])
        labels[start : start + DISTANCE_TILE_ROWS] = np.subtract(halves, products, out=products).argmin(axis=1)
    return labels

# SPDX-License-Identifier: Apache-2.0
"""Few values that stand for many: codebooks of numbers and palettes of vectors. Deterministic."""

from __future__ import annotations

import warnings
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

SAMPLES = 1 << 16
LLOYD_STEPS = 20


def codebook(values: NDArray[np.float32], size: int = 256) -> Float32:
    """(size,), ascending, with little squared error when each value counts as the nearest.

    Where there are more values than entries: first as many entries along the sorted values as the cube root of their
    density asks for, which is the best for many entries (Panter and Dite 1951), then Lloyd's steps.
    """
    ordered = np.sort(values.ravel())
    distinct = np.unique(ordered) if len(ordered) <= SAMPLES else _thinned(ordered)
    if len(distinct) <= size:
        padded: Float32 = np.pad(distinct, (0, size - len(distinct)), mode="edge").astype(np.float32)
        return padded
    samples = _thinned(ordered).astype(np.float64)
    wanted = np.cumsum(np.concatenate([[0.0], np.diff(samples) ** (2 / 3)]))
    entries = np.interp((np.arange(size) + 0.5) / size * wanted[-1], wanted, samples)
    for _ in range(LLOYD_STEPS):
        index = nearest(entries, samples)
        count = np.bincount(index, minlength=size)
        total = np.bincount(index, samples, minlength=size)
        entries = np.where(count > 0, total / np.maximum(count, 1), entries)
    result: Float32 = entries.astype(np.float32)
    return result


def _thinned(ordered: Float32) -> Float32:
    """Evenly many of sorted values, with both ends."""
    if len(ordered) <= SAMPLES:
        return ordered
    return ordered[np.linspace(0, len(ordered) - 1, SAMPLES).round().astype(np.int64)]


def nearest(entries: NDArray[np.floating], values: NDArray[np.floating]) -> NDArray[np.intp]:
    """The index of the nearest of ascending entries, in the shape of values."""
    return np.searchsorted((entries[1:] + entries[:-1]) / 2, values)


def palette(vectors: Float32, size: int, iterations: int = 10) -> tuple[Float32, NDArray[np.int64]]:
    """Up to `size` vectors, and which of them stands for each: (n, d) -> (size, d), (n,).

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
    for rows, share in zip(members, shares, strict=True):
        if not len(rows):
            continue
        found, label = _k_means(vectors[rows], min(int(share), len(rows)), iterations)
        centres.append(found)
        labels[rows] = used + label
        used += len(found)
    result = np.zeros((size, width), np.float32)
    result[:used] = np.concatenate(centres)
    return result, labels


def _k_means(vectors: Float32, size: int, iterations: int) -> tuple[Float32, NDArray[np.int64]]:
    """SciPy's, on a sample where there are many, from a beginning spread along the direction of most variance."""
    from scipy.cluster.vq import kmeans2, vq

    if size <= 1 or not np.ptp(vectors, axis=0).any():
        return vectors.mean(axis=0, keepdims=True, dtype=np.float64).astype(np.float32), np.zeros(
            len(vectors), np.int64
        )
    sample = vectors[:: max(1, len(vectors) // max(SAMPLES, 8 * size))]
    centred = sample - sample.mean(axis=0)
    _, axes = np.linalg.eigh((centred.T @ centred).astype(np.float64))
    order = np.argsort(centred @ axes[:, -1].astype(np.float32), kind="stable")
    start = sample[order[((np.arange(size) + 0.5) / size * len(order)).astype(np.int64)]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of clusters that no vector is left in: they stay where they are
        centres, _ = kmeans2(sample, start, iter=iterations, minit="matrix", missing="warn")
    labels, _ = vq(vectors, centres, check_finite=False)
    return centres.astype(np.float32), labels.astype(np.int64)

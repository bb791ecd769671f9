# SPDX-License-Identifier: Apache-2.0
"""Choice of the pairs of photographs to match: all, neighbours in a sequence, near positions, or similar pictures.

A pair has two indices of photographs, the smaller first. Lists of pairs are sorted and name each pair once.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Pair = tuple[int, int]

SFM_MATCHINGS = ("auto", "exhaustive", "sequential", "spatial", "retrieval")
"""Choices of `SfmSettings.matching`."""
MAX_EXHAUSTIVE_PHOTOS = 40
"""Number of photographs up to which "auto" matches every pair. Retrieval would leave out few of these pairs."""
SEQUENTIAL_OVERLAP = 12
"""Number of photographs before and after a photograph that sequential matching pairs with it. Sequential matching also
pairs photographs that are 2^n apart."""
LOOP_NEIGHBOURS = 10
"""Number of the most similar photographs that are matched with each photograph, besides other pairs.

They close the loops of a video's camera path, and join photographs without a GPS position to the others.
"""
ALIKE_NEIGHBOURS = 6
"""Number of the most similar photographs that retrieval matches with each photograph in the first round."""
NEAR_NEIGHBOURS = 6
"""Number of the nearest photographs that spatial matching pairs with each photograph in the first round."""
TRACK_NEIGHBOURS = 6
"""Number of photographs with the most shared tracks that a second round of matching pairs with each photograph."""
MIN_SHARED_TRACKS = 15
"""Minimum number of tracks that two photographs share after the first round, to be matched in the second."""
MIN_LOCATED_FRACTION = 0.9
"""Fraction of the photographs that must have a GPS position before "auto" chooses spatial matching."""
MIN_GPS_EXTENT_M = 25.0
"""Median distance in metres of the GPS positions from their median, from which "auto" trusts them.

A phone's position is wrong by 5 to 10 m, so positions around one object hardly tell which photographs are near.
"""
VISUAL_WORDS = 64
"""Number of cluster centres of the descriptors, the visual words of `image_similarity`."""
RETRIEVAL_FEATURES = 1000
"""Number of features in a photograph, the largest first, that `image_similarity` uses."""
CLUSTERED_EVERY, CLUSTERING_ROUNDS = 5, 10
"""`image_similarity` clusters every fifth of these features, in ten rounds of k-means."""


def chosen_matching(matching: str, count: int, sequences: Sequence[Sequence[int]], positions: NDArray[Any]) -> str:
    """Return the matching that "auto" stands for: "exhaustive", "video", "spatial" or "retrieval".

    Any other `matching` is returned as it is.

    count: number of photographs.
    sequences: indices of the frames of each video, in their order.
    positions: positions of the photographs (count, 2), metres to the east and north, NaN where unknown.
    """
    if matching != "auto":
        return matching
    if count <= MAX_EXHAUSTIVE_PHOTOS:
        return "exhaustive"
    if any(sequences):
        return "video"
    located = positions[np.isfinite(positions).all(axis=1)]
    if len(located) >= MIN_LOCATED_FRACTION * count:
        distances = np.linalg.norm(located - np.median(located, axis=0), axis=1)
        if np.median(distances) >= MIN_GPS_EXTENT_M:
            return "spatial"
    return "retrieval"


def all_pairs(count: int) -> list[Pair]:
    """Return every pair of `count` photographs."""
    return list(combinations(range(count), 2))


def sequential_pairs(order: Sequence[int]) -> list[Pair]:
    """Return the pairs of photographs that are at most SEQUENTIAL_OVERLAP or 2^n apart in a sequence."""
    last = len(order) - 1
    steps = {*range(1, min(SEQUENTIAL_OVERLAP, last) + 1), *(1 << power for power in range(last.bit_length()))}
    return _sorted((order[at], order[at + step]) for step in steps for at in range(len(order) - step))


def nearest_pairs(distances: NDArray[Any], neighbours: int) -> list[Pair]:
    """Return the pairs of each photograph with its nearest others, at most `neighbours` of them.

    distances: distance of every two photographs (N, N); infinite for pairs that are never matched. Among equal
        distances the photograph with the lower index is nearer.
    """
    apart = np.array(distances, np.float64)
    np.fill_diagonal(apart, np.inf)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, :neighbours]
    return _sorted((one, int(two)) for one, row in enumerate(nearest) for two in row if np.isfinite(apart[one, two]))


def near_pairs(positions: NDArray[Any], neighbours: int) -> list[Pair]:
    """Return the pairs of each photograph with its nearest others, at most `neighbours` of them, by their positions.

    positions: (N, 2), NaN where unknown. Among equal distances the photograph with the lower index is nearer, unless
        more than 2 `neighbours` photographs are as near.
    """
    from scipy.spatial import cKDTree  # here, as the import takes 0.1 s and training does without

    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    places = positions[known]
    most = min(2 * neighbours + 1, len(known))
    distances, found = cKDTree(places).query(places, k=range(1, most + 1)) if most else (np.zeros((0, 0)),) * 2
    order = np.lexsort((found, distances), axis=1)
    nearest = np.take_along_axis(found, order, axis=1)
    others = ([at for at in row if at != one][:neighbours] for one, row in enumerate(nearest.tolist()))
    return _sorted((int(known[one]), int(known[two])) for one, row in enumerate(others) for two in row)


def shared_tracks(counts: Sequence[int], matches: Mapping[Pair, NDArray[Any]]) -> csr_array:
    """Return the number of tracks that every two photographs share: a sparse matrix (N, N), 0 on the diagonal.

    A track is a set of features that matches connect, directly or by way of other photographs.

    counts: number of features of each photograph.
    matches: for pairs of photographs, the matching features (M, 2), by their indices in each photograph.
    """
    from scipy.sparse import coo_array, csr_array  # here, as the import takes 0.2 s and training does without
    from scipy.sparse.csgraph import connected_components

    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    ends = [first[list(pair)] + rows.astype(np.int64) for pair, rows in matches.items()]
    features, places = np.unique(np.concatenate([np.zeros((0, 2), np.int64), *ends]), return_inverse=True)
    one, two = places.reshape(-1, 2).T
    joins = coo_array((np.ones(len(one), np.bool_), (one, two)), shape=(len(features), len(features)))
    tracks, track = connected_components(joins, directed=False)
    photo = np.searchsorted(first, features, side="right") - 1
    shown = np.unique(photo * tracks + track)  # a photograph may show a track twice
    entries = (np.ones(len(shown), np.int64), (shown // max(tracks, 1), shown % max(tracks, 1)))
    seen = csr_array(entries, shape=(len(counts), tracks))
    shared = csr_array(seen @ seen.T)
    shared.setdiag(0)
    shared.eliminate_zeros()
    return shared


def track_pairs(shared: csr_array, matched: Iterable[Pair]) -> list[Pair]:
    """Return the pairs of each photograph with those that share the most tracks, at most TRACK_NEIGHBOURS of them.

    shared: from `shared_tracks`. matched: pairs that are left out, as they are matched already.
    """
    known = {(min(pair), max(pair)) for pair in matched}
    pairs = set[Pair]()
    for one in range(shared.shape[0]):
        row = slice(shared.indptr[one], shared.indptr[one + 1])
        counts = zip(shared.indices[row].tolist(), shared.data[row].tolist(), strict=True)
        new = [(-count, two) for two, count in counts if count >= MIN_SHARED_TRACKS]
        new = [(count, two) for count, two in new if (min(one, two), max(one, two)) not in known]
        pairs.update((one, two) for _, two in sorted(new)[:TRACK_NEIGHBOURS])
    return _sorted(pairs)


def unconnected(count: int, verified: Iterable[Pair]) -> list[int]:
    """Return the photographs that verified matches do not connect to the largest group of photographs.

    count: number of photographs. verified: pairs with verified matches.
    """
    from scipy.sparse import coo_array  # as above
    from scipy.sparse.csgraph import connected_components

    pairs = np.array(sorted(verified), np.int64).reshape(-1, 2)
    joins = coo_array((np.ones(len(pairs), np.bool_), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    _, group = connected_components(joins, directed=False)
    return [int(photo) for photo in np.flatnonzero(group != np.argmax(np.bincount(group)))]


def joined(*lists: Iterable[Pair]) -> list[Pair]:
    """Return the pairs of several lists, sorted, each once."""
    return _sorted(pair for pairs in lists for pair in pairs)


def image_similarity(descriptors: Sequence[NDArray[Any]], seed: int) -> NDArray[np.float64]:
    """Return the similarity of every two photographs (N, N), from -1 to 1, by their features.

    Each photograph is described by a VLAD vector (Jegou, Douze, Schmid, Perez, 2010). It has the sums of the
    differences between descriptors and their nearest visual word, normalised by word and as a whole. The visual words
    are the centres of a k-means clustering of the photographs' own descriptors, so that no vocabulary file is needed.

    descriptors: for each photograph the descriptors (features, dimensions) of its largest features.
    seed: seed of the clustering. The same descriptors and seed give the same similarities.
    """
    columns = max((rows.shape[1] for rows in descriptors if len(rows)), default=0)
    units = [_unit(np.asarray(rows, np.float32)) if len(rows) else np.zeros((0, columns)) for rows in descriptors]
    words = _visual_words(np.concatenate([rows[::CLUSTERED_EVERY] for rows in units]), seed)
    if not len(words):
        return np.zeros((len(units), len(units)))
    vectors = np.zeros((len(units), *words.shape))
    for vector, rows in zip(vectors, units, strict=True):
        nearest = _nearest_words(rows, words)
        np.add.at(vector, nearest, rows - words[nearest])
    flat = _unit(_unit(vectors).reshape(len(units), -1))
    return np.asarray(flat @ flat.T)


def _visual_words(sample: NDArray[np.float32], seed: int) -> NDArray[np.float32]:
    """Return the centres of a k-means clustering (VISUAL_WORDS or fewer, dimensions) of a sample of descriptors."""
    random = np.random.default_rng(seed)
    words = sample[np.sort(random.choice(len(sample), min(VISUAL_WORDS, len(sample)), replace=False))]
    for _ in range(CLUSTERING_ROUNDS):
        nearest = _nearest_words(sample, words) if len(words) else np.zeros(0, np.int64)
        for word in np.unique(nearest):
            words[word] = sample[nearest == word].mean(axis=0)
    return words


def _nearest_words(rows: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the index of the nearest visual word of each descriptor."""
    return np.asarray(np.argmax(rows @ words.T - 0.5 * (words**2).sum(axis=1), axis=1), np.int64)


def _unit(rows: NDArray[Any]) -> NDArray[Any]:
    """Return the vectors along the last axis, scaled to length 1. Zero vectors stay zero."""
    return np.asarray(rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-12))


def _sorted(pairs: Iterable[Pair]) -> list[Pair]:
    return sorted({(min(pair), max(pair)) for pair in pairs if pair[0] != pair[1]})

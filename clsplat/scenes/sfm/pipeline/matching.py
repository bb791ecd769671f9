# SPDX-License-Identifier: Apache-2.0
"""Matching of features with pycolmap: the pairs of a reconstruction, and their verification by epipolar geometry."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap

from clsplat.scenes.sfm.pipeline import database as sfm_database
from clsplat.scenes.sfm.pipeline import photo_pairs as sfm_pairs
from clsplat.scenes.sfm.pipeline.pair_focal import focal_from_pairs
from clsplat.scenes.sfm.pipeline.photo_pairs import Pair

PAIRS_FILE = "pairs.txt"
"""File in the worker's folder that lists the pairs for pycolmap, two numbers of photographs on each line."""


class NoPositionsError(Exception):
    """Error about spatial matching of photographs without GPS positions. Its text is the message."""


def matched_pairs(
    database: Path, matching: str, sequences: Sequence[Sequence[str]], seed: int
) -> tuple[str, list[Pair]]:
    """Return the matching that is used, as from `photo_pairs.chosen_matching`, and the pairs to match.

    The pairs have the photographs' numbers in the database.

    matching: one of SFM_MATCHINGS.
    sequences: names of the frames of each video, in their order.
    seed: seed of the clustering in `photo_pairs.image_similarity`.

    Raises NoPositionsError for "spatial" if no photograph has a GPS position.
    """
    names = sfm_database.image_names(database)
    ids, place = list(names), {name: at for at, name in enumerate(names.values())}
    orders = [[place[name] for name in sequence if name in place] for sequence in sequences]
    positions = sfm_database.gps_positions(database, ids)
    chosen = sfm_pairs.chosen_matching(matching, len(ids), orders, positions)
    alike = partial(_similar_pairs, database, ids, seed)
    if chosen == "exhaustive":
        pairs = sfm_pairs.all_pairs(len(ids))
    elif chosen == "sequential":
        of_videos = {at for order in orders for at in order}
        others = [at for at in range(len(ids)) if at not in of_videos]
        pairs = sfm_pairs.joined(*map(sfm_pairs.sequential_pairs, [*orders, others]))
    elif chosen == "video":
        pairs = sfm_pairs.joined(*map(sfm_pairs.sequential_pairs, orders), alike(sfm_pairs.LOOP_NEIGHBOURS))
    elif chosen == "spatial":
        if not np.isfinite(positions).all(axis=1).any():
            raise NoPositionsError(
                f"--matching spatial: none of the {len(ids):,} photos has a GPS position in its EXIF; expected "
                "positions, or another choice such as --matching retrieval"
            )
        pairs = sfm_pairs.near_pairs(positions, sfm_pairs.NEAR_NEIGHBOURS)
        if not np.isfinite(positions).all():  # photographs without a position
            pairs = sfm_pairs.joined(pairs, alike(sfm_pairs.LOOP_NEIGHBOURS))
    else:
        pairs = alike(sfm_pairs.ALIKE_NEIGHBOURS)
    return chosen, [(ids[one], ids[two]) for one, two in pairs]


def _similar_pairs(database: Path, ids: Sequence[int], seed: int, neighbours: int) -> list[Pair]:
    """Return the pairs of each photograph with the most similar others, by places in `ids`, the photographs' numbers.

    seed: seed of the clustering. neighbours: number of others that a photograph is paired with.
    """
    rows = sfm_database.largest_descriptors(database, ids, sfm_pairs.RETRIEVAL_FEATURES)
    return sfm_pairs.nearest_pairs(1 - sfm_pairs.image_similarity(rows, seed), neighbours)


def overlapping_pairs(database: Path, pairs: Sequence[Pair]) -> list[Pair]:
    """Return more pairs of photographs, which show the same by the matches of the pairs that are matched already.

    pairs: numbers of the photographs that are matched already. The result has such numbers too.
    """
    counts = sfm_database.feature_counts(database)
    ids, place = list(counts), {image: at for at, image in enumerate(counts)}
    matches = {(place[one], place[two]): rows for (one, two), rows in sfm_database.verified_matches(database).items()}
    shared = sfm_pairs.shared_tracks(list(counts.values()), matches)
    more = sfm_pairs.track_pairs(shared, [(place[one], place[two]) for one, two in pairs])
    return [(ids[one], ids[two]) for one, two in more]


def pairs_of_unconnected(database: Path, pairs: Sequence[Pair], seed: int) -> list[Pair]:
    """Return pairs by similarity for the photographs that no matches connect to most others, as with a wrong position.

    pairs: numbers of the photographs that are matched already. The result has such numbers too.
    seed: seed of the clustering in `photo_pairs.image_similarity`.
    """
    ids = list(sfm_database.image_names(database))
    place = {image: at for at, image in enumerate(ids)}
    verified = sfm_database.verified_matches(database)
    lone = {ids[at] for at in sfm_pairs.unconnected(len(ids), [(place[one], place[two]) for one, two in verified])}
    if not lone:
        return []
    found = _similar_pairs(database, ids, seed, sfm_pairs.LOOP_NEIGHBOURS)
    alike = {(ids[one], ids[two]) for one, two in found}
    return sorted(pair for pair in alike.difference(pairs) if not lone.isdisjoint(pair))


def verification_options(seed: int) -> pycolmap.TwoViewGeometryOptions:
    """Return options with which verifying a pair's matches takes half as long as with pycolmap's defaults.

    For 400 pairs of rgbd_7scenes these options take 2.7 s, the defaults 6.3 s. They find 344 pairs of 347, and 99.8 %
    of the inliers.
    """
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    options.ransac.confidence = 0.99
    options.ransac.min_num_trials = 30
    options.ransac.dyn_num_trials_multiplier = 1.0
    options.use_sampson_refinement = False
    return options


def verification_cameras(database: Path, *, with_focal: bool) -> contextlib.AbstractContextManager[None]:
    """Return a context in which photographs of one camera without EXIF are verified by a fundamental matrix.

    with_focal: True keeps pycolmap's choice, a relative pose and a focal length of each such pair. This takes six times
        as long and has fewer inliers. But with fundamental matrices, the global mapper places less than 30 % of
        statue_web, where photographs of many lenses count as one camera's.
    """
    return contextlib.nullcontext() if with_focal else sfm_database.separate_cameras(database)


def match_features(database: Path, pairs: Sequence[Pair], *, threads: int, seed: int, with_focal: bool) -> None:
    """Match the SIFT features of pairs of photographs, and verify the matches.

    pycolmap reads the pairs from a file that separates two names by a space. As names may have spaces too, photographs
    have their numbers as names in the meantime.

    pairs: numbers of photographs.
    with_focal: as in `verification_cameras`.
    """
    listed = database.with_name(PAIRS_FILE)
    listed.write_text("".join(f"{one} {two}\n" for one, two in pairs), "utf-8")
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = threads
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listed
    names = sfm_database.image_names(database)
    sfm_database.rename_images(database, {image: str(image) for image in names})
    with verification_cameras(database, with_focal=with_focal):
        pycolmap.match_image_pairs(
            database_path=database,
            matching_options=options,
            pairing_options=pairing,
            verification_options=verification_options(seed),
            device=pycolmap.Device.cpu,
        )
    sfm_database.rename_images(database, names)


def find_focal_lengths(database: Path) -> list[pycolmap.Camera]:
    """Write the focal lengths of cameras without EXIF to the database, where the matched pairs tell them. Returns these
    cameras as they were, for the global mapper, which finds focal lengths by itself and keeps known ones.

    The incremental mapper tries many pairs to begin with, which takes longer without a focal length. In bonsai_photos
    it began with a pair whose lens it found so wrongly that no third photograph followed, and searched again.
    """
    before, found = [], []
    for camera in sfm_database.cameras_without_focal_length(database):
        matrices = sfm_database.fundamental_matrices(database, camera.camera_id)
        focal = focal_from_pairs(matrices, camera.width, camera.height)
        if focal is not None:
            before.append(camera)
            found.append(sfm_database.with_focal_length(camera, focal))
    sfm_database.write_cameras(database, found)
    return before

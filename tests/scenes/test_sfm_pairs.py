# SPDX-License-Identifier: Apache-2.0
"""Which pairs of photographs are matched."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from scipy.sparse import csr_array

from clsplat.scenes.sfm.pipeline import database as sfm_database
from clsplat.scenes.sfm.pipeline import matching
from clsplat.scenes.sfm.pipeline import photo_pairs as pairs

NOWHERE = np.full((200, 2), np.nan)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 40])
def test_every_pair_once(count):
    found = pairs.all_pairs(count)
    assert len(set(found)) == len(found) == count * (count - 1) // 2
    assert all(one < two for one, two in found)


@pytest.mark.parametrize("count", [0, 1, 2, pairs.SEQUENTIAL_OVERLAP, pairs.SEQUENTIAL_OVERLAP + 1, 64, 65])
def test_neighbours_and_powers_of_two(count):
    apart = {*range(1, pairs.SEQUENTIAL_OVERLAP + 1), *(1 << power for power in range(10))}
    wanted = [(one, two) for one in range(count) for two in range(one + 1, count) if two - one in apart]
    assert pairs.sequential_pairs(range(count)) == wanted


def test_the_order_of_a_video_counts():
    assert pairs.sequential_pairs([5, 2, 9]) == [(2, 5), (2, 9), (5, 9)]


def test_nearest_on_a_line():
    positions = np.stack([np.arange(5.0) ** 2, np.zeros(5)], axis=1)  # at 0, 1, 4, 9, 16: each nearer to the one before
    assert pairs.near_pairs(positions, 1) == [(0, 1), (1, 2), (2, 3), (3, 4)]


def test_unknown_positions_are_paired_with_none():
    positions = np.array([[0.0, 0], [1, 0], [np.nan, np.nan], [2, 0]])
    assert pairs.near_pairs(positions, 3) == [(0, 1), (0, 3), (1, 3)]


def test_of_equal_distances_the_first_is_nearest():
    assert pairs.nearest_pairs(np.zeros((4, 4)), 1) == [(0, 1), (0, 2), (0, 3)]
    assert pairs.near_pairs(np.zeros((3, 2)), 1) == [(0, 1), (0, 2)]
    square = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]])
    assert pairs.near_pairs(square, 1) == [(0, 1), (0, 2), (1, 3)]


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_positions(count):
    assert pairs.near_pairs(np.arange(2.0 * count).reshape(count, 2), 6) == pairs.all_pairs(count)


def test_near_pairs_of_a_survey_are_those_of_all_distances():
    positions = np.random.default_rng(0).normal(size=(300, 2))
    positions[::7] = np.nan
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    assert pairs.near_pairs(positions, 6) == pairs.nearest_pairs(np.where(np.isfinite(apart), apart, np.inf), 6)


def test_more_neighbours_than_photographs():
    assert pairs.nearest_pairs(np.ones((3, 3)), 20) == pairs.all_pairs(3)


def descriptors_of(kinds, noise=0.05):
    """Photographs of a few kinds: each shows 300 features near the same 30 directions in 16 dimensions."""
    random = np.random.default_rng(0)
    words = {kind: random.normal(size=(30, 16)) for kind in sorted(set(kinds))}
    return [words[kind][random.integers(0, 30, 300)] + noise * random.normal(size=(300, 16)) for kind in kinds]


def test_photographs_of_one_thing_are_alike():
    kinds = [0, 1, 2, 0, 1, 2, 0, 1, 2]
    similarity = pairs.image_similarity(descriptors_of(kinds), seed=0)
    assert np.allclose(np.diag(similarity), 1)
    assert pairs.nearest_pairs(1 - similarity, 2) == [
        (one, two) for one, two in pairs.all_pairs(len(kinds)) if kinds[one] == kinds[two]
    ]
    again = pairs.image_similarity(descriptors_of(kinds), seed=0)
    assert similarity.tobytes() == again.tobytes()


@pytest.mark.parametrize("features", [0, 1, 2])
def test_photographs_with_few_features(features):
    similarity = pairs.image_similarity([np.ones((features, 4), np.uint8)] * 3, seed=0)
    assert similarity.shape == (3, 3)
    assert np.isfinite(similarity).all()


def test_a_photograph_without_features_beside_others():
    similarity = pairs.image_similarity([*descriptors_of([0, 0]), np.zeros((0, 2), np.uint8)], seed=0)
    assert not similarity[2].any()
    assert similarity[0, 1] > 0.2  # vectors of 1,024 random numbers are within 0.1 of 0


def located(count, metres, unknown=0):
    positions = np.stack([np.linspace(-2 * metres, 2 * metres, count), np.zeros(count)], axis=1)  # median: metres
    positions[:unknown] = np.nan
    return positions


@pytest.mark.parametrize(
    ("count", "sequences", "positions", "chosen"),
    [
        (pairs.MAX_EXHAUSTIVE_PHOTOS, [], NOWHERE, "exhaustive"),
        (pairs.MAX_EXHAUSTIVE_PHOTOS, [range(40)], located(40, 100), "exhaustive"),
        (pairs.MAX_EXHAUSTIVE_PHOTOS + 1, [], NOWHERE, "retrieval"),
        (100, [[]], NOWHERE, "retrieval"),
        (100, [range(60)], located(100, 100), "video"),
        (100, [], located(100, 30), "spatial"),
        (100, [], located(100, 10), "retrieval"),
        (100, [], located(100, 30, unknown=10), "spatial"),
        (100, [], located(100, 30, unknown=11), "retrieval"),
    ],
)
def test_what_auto_chooses(count, sequences, positions, chosen):
    assert pairs.chosen_matching("auto", count, sequences, positions) == chosen


@pytest.mark.parametrize("given", [choice for choice in pairs.SFM_MATCHINGS if choice != "auto"])
def test_what_is_asked_for_is_done(given):
    assert pairs.chosen_matching(given, 100, [range(60)], located(100, 100)) == given


@pytest.fixture
def database(tmp_path, monkeypatch):
    """Sixty photographs, of which those that are 20 apart show the same. Returns their GPS positions."""
    positions = np.full((60, 2), np.nan)
    monkeypatch.setattr(matching.sfm_database, "image_names", lambda _: {at + 1: f"{at:02}.jpg" for at in range(60)})
    monkeypatch.setattr(matching.sfm_database, "gps_positions", lambda *_: positions)
    monkeypatch.setattr(
        matching.sfm_database, "largest_descriptors", lambda *_: descriptors_of([at % 20 for at in range(60)])
    )
    return positions


def test_pairs_of_a_video_are_neighbours_and_loops(database, tmp_path):
    frames = [f"{at:02}.jpg" for at in range(30)]
    chosen, found = matching.matched_pairs(tmp_path, "auto", [frames, ["gone.jpg"]], 0)
    assert chosen == "video"
    sequential = {(one + 1, two + 1) for one, two in pairs.sequential_pairs(range(30))}
    assert sequential <= set(found)
    assert len(set(found) - sequential) <= 60 * pairs.LOOP_NEIGHBOURS
    assert {(1, 21), (1, 41), (21, 41), (35, 55)} <= set(found)  # they show the same


def test_sequential_pairs_stay_in_their_video(database, tmp_path):
    videos = [[f"{at:02}.jpg" for at in range(start, start + 20)] for start in (0, 20)]
    _, found = matching.matched_pairs(tmp_path, "sequential", videos, 0)
    # the last 20 are photographs beside the videos, in the order of their names
    wanted = [(one + start, two + start) for start in (1, 21, 41) for one, two in pairs.sequential_pairs(range(20))]
    assert found == sorted(wanted)
    assert matching.matched_pairs(tmp_path, "sequential", [], 0)[1] == [
        (one + 1, two + 1) for one, two in pairs.sequential_pairs(range(60))
    ]


def test_photographs_without_gps_are_paired_by_similarity(database, tmp_path):
    database[:57] = np.stack([np.arange(57) * 10.0, np.zeros(57)], axis=1)
    chosen, found = matching.matched_pairs(tmp_path, "auto", [], 0)
    assert chosen == "spatial"
    assert {(1, 2), (1, pairs.NEAR_NEIGHBOURS + 1), (20, 60), (40, 60)} <= set(found)


def test_spatial_matching_without_gps_is_refused(database, tmp_path):
    with pytest.raises(matching.NoPositionsError, match="--matching spatial: none of the 60 photos has a GPS position"):
        matching.matched_pairs(tmp_path, "spatial", [], 0)


def test_similar_photographs_are_paired(database, tmp_path):
    chosen, found = matching.matched_pairs(tmp_path, "auto", [], 0)
    assert chosen == "retrieval"
    assert {(at + 1, at + 21) for at in range(40)} <= set(found)


def rows_of(*matches):
    return np.array(matches, np.uint32).reshape(-1, 2)


def test_tracks_reach_photographs_by_way_of_others():
    matches = {(0, 1): rows_of((0, 1), (1, 2), (2, 0)), (1, 2): rows_of((1, 3), (0, 1)), (2, 3): rows_of()}
    shared = pairs.shared_tracks([3, 3, 4, 5], matches)
    assert shared.todense().tolist() == [[0, 3, 2, 0], [3, 0, 2, 0], [2, 2, 0, 0], [0, 0, 0, 0]]


def test_a_track_that_a_photograph_shows_twice_counts_once():
    matches = {(0, 1): rows_of((0, 0)), (1, 2): rows_of((0, 0)), (0, 2): rows_of((1, 0))}
    assert pairs.shared_tracks([2, 1, 1], matches).todense().tolist() == [[0, 1, 1], [1, 0, 1], [1, 1, 0]]


@pytest.mark.parametrize("counts", [[], [0], [0, 3]])
def test_no_matches_are_no_tracks(counts):
    shared = pairs.shared_tracks(counts, {})
    assert shared.shape == (len(counts), len(counts))
    assert shared.nnz == 0


def test_pairs_of_the_second_round_share_enough_tracks():
    least = pairs.MIN_SHARED_TRACKS
    shared = csr_array([[0, 99, least, least - 1], [99, 0, 0, 0], [least, 0, 0, 0], [least - 1, 0, 0, 0]])
    assert pairs.track_pairs(shared, [(0, 1)]) == [(0, 2)]
    assert pairs.track_pairs(shared, []) == [(0, 1), (0, 2)]
    assert pairs.track_pairs(shared, [(0, 1), (0, 2)]) == []


def test_the_second_round_takes_the_photographs_that_share_most():
    count = pairs.TRACK_NEIGHBOURS + 2
    apart = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    found = pairs.track_pairs(csr_array(np.where(apart > 0, 1000 - apart, 0)), [])
    assert (0, count - 1) not in found
    assert set(pairs.all_pairs(count)) - set(found) == {(0, count - 1)}


def test_pairs_of_the_second_round_are_read_from_the_database(tmp_path):
    """Three photographs in a row, of which the first and the last share tracks by way of the one between."""
    path, count = tmp_path / "database.db", pairs.MIN_SHARED_TRACKS
    rows = np.repeat(np.arange(count, dtype=np.uint32)[:, None], 2, axis=1)
    with pycolmap.Database.open(path) as opened:
        camera = opened.write_camera(pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 640, 480))
        one, two, three, four = (
            opened.write_image(pycolmap.Image(name=f"{name}.jpg", camera_id=camera)) for name in "abcd"
        )
        for image in (one, two, three):  # the last photograph has no features
            opened.write_keypoints(image, np.zeros((count, 2), np.float32))
        for pair in ((one, two), (two, three)):
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = rows
            opened.write_two_view_geometry(*pair, geometry)
        opened.write_two_view_geometry(three, four, pycolmap.TwoViewGeometry())
    assert sfm_database.feature_counts(path) == {one: count, two: count, three: count, four: 0}
    assert sfm_database.verified_matches(path).keys() == {(one, two), (two, three)}
    assert matching.overlapping_pairs(path, [(one, two), (two, three), (three, four)]) == [(one, three)]


def test_photographs_outside_the_largest_group():
    assert pairs.unconnected(6, [(0, 1), (1, 2), (4, 5)]) == [3, 4, 5]
    assert pairs.unconnected(3, [(0, 1), (1, 2)]) == []
    assert pairs.unconnected(1, []) == []


def test_wrong_positions_are_mended_by_similarity(database, tmp_path, monkeypatch):
    """Three neighbours whose GPS is 1 km off match each other alone; they are paired with what looks like them."""
    positions = np.stack([np.arange(60) * 10.0, np.zeros(60)], axis=1)
    positions[30:33] += 1000
    database[:] = positions
    chosen, found = matching.matched_pairs(tmp_path, "auto", [], 0)
    assert chosen == "spatial"
    wrong = {31, 32, 33}
    verified = {pair: rows_of((0, 0)) for pair in found if len(wrong.intersection(pair)) != 1}
    monkeypatch.setattr(matching.sfm_database, "verified_matches", lambda _: verified)
    more = matching.pairs_of_unconnected(tmp_path, found, 0)
    assert {(11, 31), (31, 51), (12, 32), (13, 33)} <= set(more)  # those 20 apart show the same
    assert all(wrong.intersection(pair) for pair in more)
    assert not set(more).intersection(found)
    monkeypatch.setattr(matching.sfm_database, "verified_matches", lambda _: dict.fromkeys(found, rows_of((0, 0))))
    assert matching.pairs_of_unconnected(tmp_path, found, 0) == []

# SPDX-License-Identifier: Apache-2.0
"""What matching changes in COLMAP's database and takes back, and the focal lengths that it finds."""

from __future__ import annotations

import contextlib
import io
import sqlite3

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from clsplat.scenes.sfm import worker
from clsplat.scenes.sfm.photos import Photo
from clsplat.scenes.sfm.pipeline import database as sfm_database
from clsplat.scenes.sfm.pipeline import matching
from clsplat.scenes.sfm.pipeline.pair_focal import MIN_FOCAL_PAIRS, focal_from_pairs
from clsplat.scenes.sfm.reconstruct import SfmSettings, sfm_task

WIDTH, HEIGHT, FOCAL = 800, 533, 700.0


def test_names_with_spaces_and_of_numbers_keep_their_features(tmp_path):
    with sqlite3.connect(tmp_path / "a.db") as connection:
        connection.execute("CREATE TABLE images (image_id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE)")
        connection.executemany("INSERT INTO images VALUES (?, ?)", [(1, "a b.jpg"), (2, "1"), (3, "3")])
    names = sfm_database.image_names(tmp_path / "a.db")
    sfm_database.rename_images(tmp_path / "a.db", {image: str(image) for image in names})
    assert sfm_database.image_names(tmp_path / "a.db") == {1: "1", 2: "2", 3: "3"}
    sfm_database.rename_images(tmp_path / "a.db", names)
    assert sfm_database.image_names(tmp_path / "a.db") == names


def fundamentals(count, *, noise=0.0, seed=0):
    """Fundamental matrices of random pairs of one pinhole camera, with relative errors of their entries."""
    random = np.random.default_rng(seed)
    inverse = np.linalg.inv([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    found = []
    for _ in range(count):
        x, y, z = random.normal(size=3)
        essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ Rotation.random(random_state=random).as_matrix()
        found.append(inverse.T @ essential @ inverse * (1 + noise * random.normal(size=(3, 3))))
    return np.array(found).reshape(-1, 3, 3)


@pytest.mark.parametrize("count", [MIN_FOCAL_PAIRS, 21, 499, 500, 501])
def test_the_focal_length_of_random_pairs(count):
    found = focal_from_pairs(fundamentals(count), WIDTH, HEIGHT)
    assert found == pytest.approx(FOCAL, rel=0.017)  # half the step of the candidates, 3.3 %


def test_a_third_of_wrong_pairs_does_not_change_the_focal_length():
    wrong = np.random.default_rng(1).normal(size=(50, 3, 3))
    found = focal_from_pairs(np.concatenate([fundamentals(100), wrong]), WIDTH, HEIGHT)
    assert found == pytest.approx(FOCAL, rel=0.04)


def test_pairs_that_tell_no_focal_length():
    assert focal_from_pairs(fundamentals(0), WIDTH, HEIGHT) is None
    assert focal_from_pairs(fundamentals(MIN_FOCAL_PAIRS - 1), WIDTH, HEIGHT) is None
    assert focal_from_pairs(fundamentals(100, noise=1.0), WIDTH, HEIGHT) is None
    assert focal_from_pairs(fundamentals(100), 80, 53) is None  # 700 px is 8.75 times the longer side


@pytest.fixture
def database(tmp_path):
    """Photographs 1 to 3 of a camera without EXIF, and 4 and 5 of a camera with it."""
    path = tmp_path / "a.db"
    with pycolmap.Database.open(path) as opened:
        for known in (False, True):
            camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", 960.0, WIDTH, HEIGHT)
            camera.has_prior_focal_length = known
            number = opened.write_camera(camera)
            for name in "de" if known else "abc":
                opened.write_image(pycolmap.Image(name=name, camera_id=number))
    return path


def test_cameras_are_separate_while_pairs_are_verified_and_as_before_afterwards(database):
    with contextlib.closing(sqlite3.connect(database)) as connection:
        before = list(connection.iterdump())
    with sfm_database.separate_cameras(database), pycolmap.Database.open(database) as opened:
        images = {image.image_id: image.camera_id for image in opened.read_all_images()}
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        assert len(set(images.values())) == 4
        assert images[4] == images[5] == 2
        assert [cameras[images[image]].has_prior_focal_length for image in range(1, 6)] == [False] * 3 + [True] * 2
        assert all(camera.params.tolist() == cameras[1].params.tolist() for camera in cameras.values())
    with contextlib.closing(sqlite3.connect(database)) as connection:
        after = list(connection.iterdump())
    assert [line for line in after if "sqlite_sequence" not in line] == [
        line for line in before if "sqlite_sequence" not in line
    ]


@pytest.mark.parametrize("planar", [False, True])
def test_the_focal_length_of_the_camera_without_exif_is_written(database, planar, monkeypatch):
    monkeypatch.setattr("clsplat.scenes.sfm.pipeline.pair_focal.MIN_FOCAL_PAIRS", 3)
    kind = pycolmap.TwoViewGeometryConfiguration
    pairs = [(1, 2), (1, 3), (2, 3), (1, 4), (2, 5)]
    matrices = np.concatenate([fundamentals(3), np.random.default_rng(0).normal(size=(2, 3, 3))])
    with pycolmap.Database.open(database) as opened:
        for pair, matrix in zip(pairs, matrices, strict=True):
            geometry = pycolmap.TwoViewGeometry()
            geometry.F, geometry.config = matrix, kind.PLANAR if planar else kind.UNCALIBRATED
            geometry.inlier_matches = np.array([[0, 0]], np.uint32)
            opened.write_two_view_geometry(*pair, geometry)
    assert sfm_database.fundamental_matrices(database, 1).shape == (0 if planar else 3, 3, 3)
    before = matching.find_focal_lengths(database)
    with pycolmap.Database.open(database) as opened:
        first, second = opened.read_all_cameras()
    assert first.has_prior_focal_length == (not planar)
    assert first.params[:2] == pytest.approx([960.0 if planar else FOCAL] * 2, rel=0.017)
    assert first.params[2:].tolist() == [WIDTH / 2, HEIGHT / 2, 0, 0, 0, 0]
    assert second.params[:2].tolist() == [960.0, 960.0]
    sfm_database.write_cameras(database, before)  # as before the global mapper
    with pycolmap.Database.open(database) as opened:
        assert not opened.read_camera(1).has_prior_focal_length
        assert opened.read_camera(1).params[:2].tolist() == [960.0, 960.0]


@pytest.mark.parametrize(
    ("mapper", "many", "separate"),
    [("incremental", True, True), ("auto", False, True), ("auto", True, False), ("global", False, False)],
)
def test_pairs_are_verified_without_a_focal_length_unless_the_global_mapper_is_first(
    mapper, many, separate, tmp_path, monkeypatch
):
    entered = []

    @contextlib.contextmanager
    def noted(path):
        entered.append(path)
        yield

    monkeypatch.setattr(sfm_database, "separate_cameras", noted)
    monkeypatch.setattr(sfm_database, "image_names", lambda _: {})
    monkeypatch.setattr(sfm_database, "rename_images", lambda *_: None)
    monkeypatch.setattr(pycolmap, "match_image_pairs", lambda **_: None)
    monkeypatch.setattr(worker.Worker, "has_many_cameras", lambda _: many)
    photos = [Photo(f"{index}.jpg", f"{index}.jpg", 40, 30, ()) for index in range(3)]
    task = sfm_task(SfmSettings(mapper=mapper), photos, [], [], tmp_path, 1)
    worker.Worker(task, io.StringIO()).match_pairs([(1, 2)])
    assert len(entered) == separate

# SPDX-License-Identifier: Apache-2.0
"""Which features of photographs are kept."""

from __future__ import annotations

import io

import numpy as np
import pycolmap
import pytest
from PIL import Image as Pillow

from clsplat.scenes.sfm import worker
from clsplat.scenes.sfm.pipeline.database import keep_largest, largest_descriptors

SIZES = np.array([3.0, 1.0, 4.0, 1.0, 5.0, 9.0, 2.0, 6.0], np.float32)


@pytest.fixture(params=["scales", "shapes"])
def database(tmp_path, request):
    """One photograph with features of these sizes. The descriptor of each is its number."""
    path = tmp_path / "database.db"
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 640, 480)
    points = np.zeros((len(SIZES), 4 if request.param == "scales" else 6), np.float32)
    points[:, 0] = 10 * np.arange(len(SIZES))
    points[:, 2] = SIZES
    with pycolmap.Database.open(path) as opened:
        camera_id = opened.write_camera(camera)
        image = opened.write_image(pycolmap.Image(name="a.jpg", camera_id=camera_id))
        opened.write_keypoints(image, points)
        rows = np.repeat(np.arange(len(SIZES), dtype=np.uint8)[:, None], 128, axis=1)
        opened.write_descriptors(image, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, rows))
    return path


def kept(database):
    """Numbers of the features in the database, by keypoints and by descriptors."""
    with pycolmap.Database.open(database) as opened:
        return opened.read_keypoints(1)[:, 0] / 10, opened.read_descriptors(1).data[:, 0]


@pytest.mark.parametrize("most", [1, 2, 5, 7, 8, 9])
def test_the_largest_features_are_kept_in_their_order(database, most):
    wanted = sorted([5, 7, 4, 2, 0, 6, 1, 3][:most])  # of the two of size 1 the first is kept first
    keep_largest(database, most)
    by_point, by_descriptor = kept(database)
    assert by_point.tolist() == by_descriptor.tolist() == wanted
    assert {int(row[0]) for row in largest_descriptors(database, [1], most)[0]} == set(wanted)


def test_a_photograph_has_no_more_features_than_asked_for(tmp_path):
    """pycolmap alone leaves more."""
    photos = tmp_path / "photos"
    photos.mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (160, 160, 3), dtype=np.uint8)
    Pillow.fromarray(noise).save(photos / "a.png")
    task = {"photos": photos, "work": tmp_path, "groups": [["a.png"]], "threads": 1, "masks": [], "seed": 0}
    task |= {"features": "sift", "max_image_size": 1600, "max_features": 50, "camera_model": "auto"}
    work = worker.Worker(task, io.StringIO())
    work.extract()
    with pycolmap.Database.open(work.database) as opened:
        assert len(opened.read_keypoints(1)) == len(opened.read_descriptors(1).data) == 50

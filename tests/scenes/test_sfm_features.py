# SPDX-License-Identifier: Apache-2.0
"""Which features of photographs are kept, and to which size photographs are reduced for it."""

from __future__ import annotations

import io

import numpy as np
import pycolmap
import pytest
from PIL import Image as Pillow

from clsplat.scenes.sfm import worker
from clsplat.scenes.sfm.pipeline.database import feature_counts, keep_largest, largest_descriptors
from clsplat.scenes.sfm.pipeline.features import SAMPLED_PHOTOS, sufficient_size

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


@pytest.mark.parametrize(
    ("features", "width", "height", "wanted"),
    [
        (4096, 800, 533, 1600),  # enough for all: photographs stay as they are
        (4097, 800, 533, 792),  # 799.9, but 800 x 533 and 796 x 530.3 are no multiples of 4, 792 x 527.7 is
        (5300, 800, 533, 696),  # 800 x 0.879 = 703, and 696 x 463.7 rounds to 464
        (16384, 1000, 1000, 500),  # four times as many: half the sides
        (16384, 1000, 500, 496),  # 500 x 250 is no multiple of 4, 496 x 248 is
        (16384, 500, 1000, 496),
        (16384, 4000, 4000, 800),  # the sample was reduced to 1600 already
    ],
)
def test_photographs_with_more_features_than_are_kept_are_reduced(features, width, height, wanted):
    sample = [(features - 100, width, height), (features, width, height), (features + 100, width, height)]
    assert sufficient_size(sample, 4096, 1600) == wanted


@pytest.mark.parametrize("groups", ["one", "two", "each"])
def test_a_sample_of_many_photographs_decides_the_size_of_the_others(tmp_path, monkeypatch, groups):
    """The photographs of a camera keep their camera, though its features are extracted in two calls."""
    photos, names = tmp_path / "photos", [f"{index:03}.png" for index in range(70)]
    photos.mkdir()
    random = np.random.default_rng(0)
    for name in names:
        Pillow.fromarray(random.integers(0, 256, (48, 64), dtype=np.uint8)).save(photos / name)
    cameras = {"one": [names], "two": [names[:30], names[30:]], "each": [[name] for name in names]}[groups]
    task = {"photos": photos, "work": tmp_path, "groups": cameras, "threads": 1, "masks": [], "seed": 0}
    task |= {"features": "sift", "max_image_size": 1600, "max_features": 5, "camera_model": "auto"}
    calls, extract = [], pycolmap.extract_features

    def noted(**options):
        calls.append((len(options["image_names"]), options["extraction_options"].max_image_size))
        extract(**options)

    monkeypatch.setattr(pycolmap, "extract_features", noted)
    work = worker.Worker(task, io.StringIO())
    work.extract()
    sizes = {size for _, size in calls}
    assert sum(count for count, _ in calls) == 70
    assert sum(count for count, size in calls if size == 1600) == SAMPLED_PHOTOS
    assert len(sizes) == 2
    assert min(sizes) < 64
    with pycolmap.Database.open(work.database) as opened:
        cameras_of = {image.name: image.camera_id for image in opened.read_all_images()}
        assert len(opened.read_all_cameras()) == len(cameras)
    assert sorted(cameras_of) == names
    assert all(len({cameras_of[name] for name in group}) == 1 for group in cameras)
    assert max(feature_counts(work.database).values()) == 5

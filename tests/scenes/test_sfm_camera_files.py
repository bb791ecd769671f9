# SPDX-License-Identifier: Apache-2.0
"""HEIC, AVIF, WebP and raw photographs in structure from motion and training, and focal lengths from EXIF."""

from __future__ import annotations

import io
import json

import numpy as np
import pycolmap
import pytest
import ring
from calls import refuses, warnings_of
from camera_files import exif_bytes, write_avif, write_dng, write_heic
from demo_photographs import photographs
from PIL import Image as Pillow
from ring import write_colmap, write_transforms

from clsplat.images.reading import read_image
from clsplat.scenes.loading import load_scene
from clsplat.scenes.sfm import focal_lengths, worker
from clsplat.scenes.sfm import photos as sfm_photos
from clsplat.scenes.sfm import reconstruct as sfm
from clsplat.scenes.sfm.captured_files import SFM_RECORD_FILE

pytestmark = [pytest.mark.needs("pillow_heif"), pytest.mark.needs("rawpy")]

WIDTH, HEIGHT, COUNT = 240, 180, 12
GREY = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
SOFT = np.asarray(
    Pillow.fromarray(np.random.default_rng(1).integers(0, 256, (5, 7, 3), dtype=np.uint8)).resize((WIDTH, HEIGHT))
)


@pytest.fixture(scope="module")
def pictures():
    return photographs(range(COUNT), WIDTH, HEIGHT)


def equivalent_mm(focal_px):
    """35 mm equivalent of a focal length, by the picture's diagonal, as EXIF has it."""
    return focal_px * np.hypot(36, 24) / np.hypot(WIDTH, HEIGHT)


def stage(folder, target):
    paths, left_out = sfm_photos.find_photos(folder)
    return sfm_photos.stage_photos(folder, paths, target, lambda _: None, 2), left_out


def test_copies_are_upright_and_keep_what_pycolmap_reads(tmp_path):
    folder, target = tmp_path / "photos", tmp_path / "staged"
    folder.mkdir()
    picture, exif = SOFT, exif_bytes(6, 6.5, 26, gps=True)
    alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
    alpha[:20] = 0
    write_heic(folder / "a.HEIC", picture, exif)
    write_avif(folder / "b.avif", picture, exif)
    Pillow.fromarray(picture).save(folder / "c.webp", lossless=True, exif=exif)
    write_heic(folder / "d.heic", np.concatenate([picture, alpha], axis=2), exif)
    write_dng(folder / "e.dng", picture.astype(np.uint16) * 257, orientation=6, focal=(7, 26))
    write_heic(folder / "f.jpg", picture, exif)
    photos, left_out = stage(folder, target)
    assert left_out == {}
    names = ["a.HEIC.jpg", "b.avif.jpg", "c.webp.jpg", "d.heic.png", "e.dng.jpg", "f.jpg"]
    assert [photo.scene_name for photo in photos] == names == sorted(path.name for path in target.iterdir())
    assert [photo.transparent for photo in photos] == [name.startswith("d") for name in names]
    for photo in photos:
        assert (photo.width, photo.height) == (HEIGHT, WIDTH)
        copy = target / photo.scene_name
        upright = read_image(folder / photo.name)
        error = np.abs(read_image(copy)[:, :, :3] - upright[:, :, :3])
        # JPEG of quality 98 rounds to 8 bits and halves the chroma, which is soft here: less than two levels
        assert error.mean() < (2 / 255 if copy.suffix == ".jpg" else 1e-6)
        bitmap = pycolmap.Bitmap.read(copy, as_rgb=True)
        assert bitmap.exif_focal_length() == pytest.approx(26 * np.hypot(WIDTH, HEIGHT) / np.hypot(36, 24), rel=1e-3)
        assert photo.lens == ("Acme", "Cam 1", "", "7.000" if photo.name == "e.dng" else "6.500", "26")
        if photo.name != "e.dng":
            assert bitmap.exif_latitude() == pytest.approx(47.5) and bitmap.exif_longitude() == pytest.approx(8.25)
            assert bitmap.exif_altitude() == pytest.approx(400)


def test_without_the_extra_photographs_are_left_out_by_name(tmp_path, monkeypatch):
    for name in ("a.heic", "b.heic", "c.dng"):
        (tmp_path / name).write_bytes(b"")
    monkeypatch.setattr("clsplat.images.decoders.photo_decoders.find_spec", lambda _: None)
    told = r"has only 3 photo\(s\) such as a\.heic, and reading them needs another package: pip install .*\[photos\]'$"
    refuses(told, sfm_photos.find_photos, tmp_path)
    Pillow.fromarray(GREY).save(tmp_path / "c.jpg")
    photos, left_out = sfm_photos.find_photos(tmp_path)
    assert [path.name for path in photos] == ["c.jpg"]
    assert {why: [path.name for path in paths] for why, paths in left_out.items()} == {
        "reading them needs another package: pip install 'clsplat[photos]'": ["a.heic", "b.heic"],
        "their folder has the same photos in another format": ["c.dng"],
    }


def test_a_photograph_that_does_not_decode_is_named(tmp_path):
    write_heic(tmp_path / "a.heic", GREY)
    whole = (tmp_path / "a.heic").read_bytes()
    (tmp_path / "b.heic").write_bytes(whole[: len(whole) // 2])
    refuses(r"b\.heic: does not decode as a HEIC photograph", stage, tmp_path, tmp_path / "staged")


@pytest.mark.parametrize("write_scene", [write_colmap, write_transforms])
def test_a_model_whose_pictures_are_heic_and_raw(write_scene, tmp_path):
    folder = "" if write_scene is write_colmap else "images/"
    names = [f"{folder}view{index:02}.{'dng' if index % 2 else 'HEIC'}" for index in range(ring.COUNT)]
    write_scene(tmp_path, names, [f"{folder}other/{name}" for name in ring.NAMES])
    for index, name in enumerate(names):
        path = tmp_path / "images" / name.removeprefix("images/")
        grey = np.full((ring.HEIGHT, ring.WIDTH, 3), ring.level(index))
        if index % 2:
            write_dng(path, np.rint(65535 * ((grey + 0.055) / 1.055) ** 2.4))
        else:
            write_heic(path, np.rint(255 * grey).astype(np.uint8))
    scene = load_scene(tmp_path)
    for index, view in enumerate(sorted(scene.views, key=lambda view: view.name)):
        assert view.path.suffix == (".dng" if index % 2 else ".HEIC")
        assert view.load().mean() == pytest.approx(ring.level(index), abs=1 / 2048)  # LibRaw's curve; HEIC is exact


def test_focal_lengths_that_differ_are_told_in_one_line():
    def camera(name, found, photos=1):
        return {"photo": name, "photos": photos, "exif_px": 1000.0, "found_px": found}

    assert focal_lengths.told([]) == focal_lengths.told([camera("a", 1099.0), camera("b", 901.0)]) == ""
    told = focal_lengths.told([camera("a.jpg", 1300.0, 12), camera("b.jpg", 700.0), camera("c.jpg", 1000.0)])
    assert told.startswith(
        "the focal length found is 1300 px, +30% from EXIF's 1000 px (a.jpg and 11 more), "
        "700 px, -30% from EXIF's 1000 px (b.jpg); "
    )


def test_focal_lengths_of_exif_are_those_with_which_pycolmap_begins(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    for name, exif in (("a.jpg", exif_bytes(1, 5, 26)), ("b.jpg", exif_bytes(1, 5, 26)), ("c.jpg", b"")):
        Pillow.fromarray(noise).save(photos / name, exif=exif)
    task = {"photos": photos, "work": tmp_path, "groups": [["a.jpg", "b.jpg"], ["c.jpg"]], "threads": 2, "masks": []}
    task |= {"features": "sift", "max_image_size": 1600, "max_features": 100, "camera_model": "auto", "seed": 0}
    work = worker.Worker(task, io.StringIO())
    work.extract()
    given = focal_lengths.from_exif(work.database)
    assert given == {1: pytest.approx(26 * np.hypot(WIDTH, HEIGHT) / np.hypot(36, 24), rel=1e-3)}


@pytest.mark.slow
def test_cameras_of_heic_and_raw_photographs(tmp_path, pictures):
    """The focal length found is told, as EXIF says twice as much here."""
    folder = tmp_path / "photos"
    folder.mkdir()
    twice = round(equivalent_mm(2 * pictures[1][0].fx))
    for index, picture in enumerate(pictures[0]):
        if index % 2:
            write_heic(folder / f"{index:02d}.heic", picture, exif_bytes(1, 50, twice), quality=95, chroma=444)
        else:
            values = np.rint(65535 * (picture / 255.0) ** 2.2)
            write_dng(folder / f"{index:02d}.dng", values, focal=(50, twice))
    (message,) = warnings_of(
        lambda: sfm.reconstruct(folder, tmp_path / "scene", sfm.SfmSettings(camera_model="SIMPLE_PINHOLE"))
    )
    assert "photos: the focal length found is " in message and "-50% from EXIF's" in message
    assert "(00.dng.jpg and 11 more)" in message
    record = json.loads((tmp_path / "scene" / SFM_RECORD_FILE).read_text())
    assert record["unregistered"] == [] and len(record["focal_lengths"]) == 1
    assert record["focal_lengths"][0]["found_px"] == pytest.approx(pictures[1][0].fx, rel=0.03)
    scene = load_scene(tmp_path / "scene")
    assert sorted(view.name for view in scene.views) == [
        f"{index:02d}.{'heic' if index % 2 else 'dng'}.jpg" for index in range(COUNT)
    ]

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import contextlib
import io
import json
import shutil
import sys

import numpy as np
import OpenImageIO as oiio
import pycolmap
import pytest
from calls import noted, refuses, warnings_of
from compare import similarity
from demo_photographs import photographs
from pictures import write_pixels
from PIL import Image as Pillow
from systems import can_link, locked

from clsplat.config.masks import MaskUse
from clsplat.demo import ray_caster
from clsplat.errors import ClsplatError, InputError
from clsplat.scenes.loading import load_scene
from clsplat.scenes.sfm import photos as sfm_photos
from clsplat.scenes.sfm import reconstruct as sfm
from clsplat.scenes.sfm import worker
from clsplat.scenes.sfm.captured_files import SFM_RECORD_FILE

WIDTH, HEIGHT, COUNT = 240, 180, 12
PINHOLE = sfm.SfmSettings(camera_model="SIMPLE_PINHOLE")
# EXIF orientation: what a viewer does to stored pixels to show the photo; here its inverse, shown to stored
STORED_FROM_SHOWN = {
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    6: lambda image: np.rot90(image, 1),
    8: lambda image: np.rot90(image, -1),
}


def write_image(path, pixels, orientation=1):
    turned = {"Orientation": orientation} if orientation != 1 else {}
    write_pixels(path, pixels, attributes={"Compression": "jpeg:97", "jpeg:subsampling": "4:4:4", **turned})


def write_png(path, pixels):
    write_pixels(path, pixels, attributes={"oiio:UnassociatedAlpha": 1})


def read_image(path):
    return oiio.ImageInput.open(str(path)).read_image("uint8")


@pytest.fixture(scope="module")
def pictures():
    """A dozen neighbouring views of the demo's ring, (height, width, 3) uint8, and their true cameras."""
    return photographs(range(COUNT), WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def photos(pictures, tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    for index, picture in enumerate(pictures[0]):
        write_image(folder / f"view_{index:02d}.jpg", picture)
    return folder


@pytest.fixture(scope="module")
def scene(photos, tmp_path_factory):
    heard = []
    output = sfm.reconstruct(
        photos,
        tmp_path_factory.mktemp("scenes") / "scene",
        PINHOLE,
        progress=lambda text, fraction: heard.append((text, fraction)),
    )
    return output, heard


def thumbnail(pixels):
    """The green channel at the same 18 x 24 places of an image of any size."""
    rows, columns = (
        (np.linspace(0.05, 0.95, count) * side).astype(int) for count, side in zip((18, 24), pixels.shape, strict=False)
    )
    return pixels[np.ix_(rows, columns)][..., 1].ravel().astype(float)


def leftovers(folder):
    return [path.name for path in folder.iterdir()]


def test_every_pose_is_recovered(scene, pictures):
    output, heard = scene
    model = pycolmap.Reconstruction(output / "sparse/0")
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    assert [image.name for image in images] == [f"view_{index:02d}.jpg" for index in range(COUNT)]
    found = np.stack([image.projection_center() for image in images])
    true = np.stack([camera.position for camera in pictures[1]])
    scale, rotation, translation = similarity(found, true)
    errors = np.linalg.norm(scale * found @ rotation.T + translation - true, axis=1)
    assert errors.max() < 0.02  # metres; the cameras are 2.5 m from the middle
    (camera,) = model.cameras.values()
    assert camera.model_name == "PINHOLE"
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert camera.params[0] == pytest.approx(pictures[1][0].fx, rel=0.02)

    record = json.loads((output / SFM_RECORD_FILE).read_text())
    assert record["unregistered"] == []
    assert record["photos"] == len(record["registered"]) == COUNT
    assert record["mean_reprojection_error"] < 0.5
    stages = list(dict.fromkeys(text for text, _ in heard))
    matched = ["choosing pairs", "matching photos"]
    placing = ["placing cameras", "adding points", "undistorting photos"]
    assert stages == ["reading photos", "finding features", *matched, *placing]
    assert (record["matching"], record["pairs"]) == ("exhaustive", COUNT * (COUNT - 1) // 2)
    assert (record["mapper"], record["features"], record["fragments"]) == ("incremental", "sift", [])
    assert {"features", "pairs", "matches", "cameras", "points", "undistorting"} == set(record["seconds"])
    placed = [fraction.text for text, fraction in heard if text == "placing cameras"]
    assert (placed[0], placed[-1]) == (f"0 of {COUNT} cameras placed", f"{COUNT} of {COUNT} cameras placed")
    assert len(placed) > 3  # they are counted as they come
    assert leftovers(output.parent) == ["scene"]


def test_finished_result_is_used_again_and_never_replaced_unasked(scene, photos, tmp_path):
    output, _ = scene
    before = (output / "sparse/0/images.bin").stat().st_mtime_ns
    assert sfm.reconstruct(photos, output, PINHOLE) == output
    with pytest.raises(InputError, match="with other settings or from other photos"):
        sfm.reconstruct(photos, output, sfm.SfmSettings(camera_model="SIMPLE_PINHOLE", max_features=100))
    assert (output / "sparse/0/images.bin").stat().st_mtime_ns == before


@pytest.mark.slow
@pytest.mark.parametrize("change", ["gone", "cut"])
def test_a_result_that_has_changed_since_is_not_used_again(scene, photos, tmp_path, change):
    copy = shutil.copytree(scene[0], tmp_path / "scene")
    assert sfm.reconstruct(photos, copy, PINHOLE) == copy
    picture = copy / "images/view_03.jpg"
    if change == "gone":
        picture.unlink()
    else:
        picture.write_bytes(picture.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"scene: images/view_03\.jpg were removed or changed after .* --overwrite"):
        sfm.reconstruct(photos, copy, PINHOLE)


@pytest.mark.slow
def test_same_seed_same_bytes(scene, photos, tmp_path):
    again = sfm.reconstruct(photos, tmp_path / "again", PINHOLE, threads=3)
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (again / "sparse/0" / name).read_bytes() == (scene[0] / "sparse/0" / name).read_bytes(), name


@pytest.mark.slow
@pytest.mark.parametrize(
    "choice", [{"mapper": "global"}, {"matching": "retrieval"}, {"matching": "sequential"}, {"matching": "exhaustive"}]
)
def test_every_choice_gives_the_same_bytes_twice(choice, photos, tmp_path):
    settings = sfm.SfmSettings(camera_model="SIMPLE_PINHOLE", **choice)
    scenes = [sfm.reconstruct(photos, tmp_path / str(threads), settings, threads=threads) for threads in (1, 3)]
    record = json.loads((scenes[0] / SFM_RECORD_FILE).read_text())
    assert len(record["registered"]) == COUNT
    assert record["mean_reprojection_error"] < 0.5
    assert choice.items() <= record.items()
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert len({(scene / "sparse/0" / name).read_bytes() for scene in scenes}) == 1, name


@pytest.mark.slow
def test_photographs_of_two_things_are_two_models(pictures, tmp_path):
    """Mirrored pictures match among themselves, and not with the others."""
    for index, picture in enumerate(pictures[0]):
        write_image(tmp_path / f"photos/a {index}.jpg", picture)  # names with spaces
    for index, picture in enumerate(pictures[0][:6]):
        write_image(tmp_path / f"photos/b {index}.jpg", picture[:, ::-1])
    (message,) = warnings_of(lambda: sfm.reconstruct(tmp_path / "photos", tmp_path / "scene", PINHOLE))
    assert "6 photo(s) (b 0.jpg, b 1.jpg, b 2.jpg and 3 more) form a model of their own, with too few" in message
    assert f"to the {COUNT} photo(s) that are used" in message
    record = json.loads((tmp_path / "scene" / SFM_RECORD_FILE).read_text())
    assert record["fragments"] == [[f"b {index}.jpg" for index in range(6)]]
    assert len(record["registered"]) == COUNT


def test_a_smaller_model_is_named(photos, tmp_path, monkeypatch):
    def run(task, work, report):
        (work / "result" / "images").mkdir(parents=True)
        names = sorted(task["groups"][0])
        return {"result": {"registered": names[:7], "fragments": [names[7:10], names[10:11]]}}

    monkeypatch.setattr(sfm, "run_worker", run)
    monkeypatch.setattr(sfm, "turn_new", lambda *_: None)
    apart = "form a model of their own, with too few matches to the 7 photo(s) that are used; to join both, add photos"
    messages = warnings_of(lambda: sfm.reconstruct(photos, tmp_path / "out"))
    assert [message.split(": ", 1)[1] for message in messages] == [
        f"3 photo(s) (view_07.jpg, view_08.jpg, view_09.jpg) {apart} in between",
        f"1 photo(s) (view_10.jpg) {apart} in between",
        "no camera pose was found for 1 photo(s) (view_11.jpg), which will not be used",
    ]


@pytest.mark.parametrize(("count", "threads"), [(worker.MAX_SINGLE_THREAD_PHOTOS, 1), (81, 3)])
@pytest.mark.parametrize("mapper", ["global", "incremental"])
def test_matching_and_mapping_of_few_photos_have_one_thread(mapper, count, threads, tmp_path, monkeypatch):
    """With several threads the bytes differ in one of 70 runs on a busy machine, so that two equal runs show little."""
    names, given = [f"{index}.jpg" for index in range(count)], []
    monkeypatch.setattr(worker.matching, "matched_pairs", lambda *_: ("retrieval", [(1, 2)]))
    monkeypatch.setattr(worker.matching, "overlapping_pairs", lambda *_: [(1, 3)])
    monkeypatch.setattr(worker.pycolmap, "Reconstruction", lambda _: None)
    mappers = ("incremental_mapping", "calibrate_view_graph", "global_mapping", "triangulate_points")
    for name in ("match_image_pairs", *mappers):
        told = "matching_options" if name.startswith("match") else "options"
        monkeypatch.setattr(worker.pycolmap, name, lambda told=told, **all_: given.append(all_[told]) or {})
    monkeypatch.setattr(worker.matching.sfm_database, "image_names", lambda _: {})
    for name, stub in (("rename_images", lambda *_: None), ("separate_cameras", contextlib.nullcontext)):
        monkeypatch.setattr(worker.matching.sfm_database, name, stub)
    monkeypatch.setattr(worker.matching, "find_focal_lengths", lambda _: [])
    monkeypatch.setattr(worker, "write_cameras", lambda *_: None)
    settings = sfm.SfmSettings(mapper=mapper)
    photos = [sfm_photos.Photo(name, name, 40, 30, ()) for name in names]
    work = worker.Worker(sfm.sfm_task(settings, photos, [], [], tmp_path, 3), io.StringIO())
    assert work.match() == ("retrieval", 2)
    work.map()
    work.add_points(tmp_path)
    assert {options.num_threads for options in given if hasattr(options, "num_threads")} == {threads}
    if mapper == "global":
        assert given[-2].mapper.num_threads == threads


@pytest.mark.slow
def test_exif_orientation_subfolders_and_a_photo_of_something_else(pictures, tmp_path):
    folder = tmp_path / "photos"
    turns = [1, 6, 3, 8, 1, 2, 6, 8, 3, 1, 6, 1]
    for index, (picture, turn) in enumerate(zip(pictures[0], turns, strict=True)):
        write_image(
            folder / ("left" if index < 6 else "right") / f"{index:02d}.JPG", STORED_FROM_SHOWN[turn](picture), turn
        )
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT // 4, WIDTH // 4, 3), np.uint8)
    write_image(folder / "stray.jpg", noise.repeat(4, axis=0).repeat(4, axis=1))
    (folder / "phone.gif").write_bytes(b"not read")
    (folder / "notes.txt").write_text("not a photo")
    # the output may lie among the photos: it must not be taken for some
    output = folder / "scene"
    messages = warnings_of(lambda: sfm.reconstruct(folder, output))
    assert any("phone.gif" in message for message in messages)
    assert any("stray.jpg" in message and "no camera pose was found" in message for message in messages)
    assert json.loads((output / SFM_RECORD_FILE).read_text())["unregistered"] == ["stray.jpg"]

    found = sorted(path.relative_to(output / "images").as_posix() for path in (output / "images").rglob("*.JPG"))
    assert found == [f"{'left' if index < 6 else 'right'}/{index:02d}.JPG" for index in range(COUNT)]
    for name, picture in zip(found, pictures[0], strict=True):
        image = read_image(output / "images" / name).astype(float)
        assert np.corrcoef(thumbnail(image), thumbnail(picture))[0, 1] > 0.8, name
        assert image.shape[1] > image.shape[0]
    model = pycolmap.Reconstruction(output / "sparse/0")
    assert len(model.cameras) == 1
    assert sfm.reconstruct(folder, output) == output


@pytest.mark.slow
def test_photos_that_lose_their_alpha_are_named(pictures, tmp_path):
    for index, picture in enumerate(pictures[0]):
        alpha = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)
        alpha[:20] = 255 if index else 128  # one of them has a transparent part, the others only could have
        write_png(tmp_path / f"photos/{index:02d}.png", np.concatenate([picture, alpha], axis=2))
    (message,) = warnings_of(lambda: sfm.reconstruct(tmp_path / "photos", tmp_path / "scene"))
    wanted = (
        "photos: 1 photo(s) (00.png) lost their alpha when they were undistorted: their images in the scene are opaque"
    )
    assert wanted in message
    assert oiio.ImageInput.open(str(tmp_path / "scene/images/00.png")).spec().nchannels == 3
    # without distortion there is nothing to undo: pycolmap copies the files
    copied = warnings_of(lambda: sfm.reconstruct(tmp_path / "photos", tmp_path / "copied", PINHOLE))
    assert copied == []
    assert oiio.ImageInput.open(str(tmp_path / "copied/images/00.png")).spec().nchannels == 4


@pytest.mark.parametrize(
    ("name", "form", "begin", "off"),
    [
        ("view_03.jpg", "GIF", b"\xff\xd8\xff", 6),  # a palette of 256 colours, and JPEG
        ("view_03.png", "GIF", b"\x89PNG", 6),
        ("view_03.jpg", "WEBP", b"\xff\xd8\xff", 4),
    ],
)
def test_a_photo_of_another_kind_than_its_name_says_is_written_anew(
    name, form, begin, off, photos, tmp_path, monkeypatch
):
    """pycolmap reads neither GIF nor WebP."""
    folder = shutil.copytree(photos, tmp_path / "photos")
    picture = read_image(folder / "view_03.jpg")
    (folder / "view_03.jpg").unlink()
    Pillow.fromarray(picture).save(folder / name, form, quality=95)
    tasks = task_of(monkeypatch)
    assert warnings_of(lambda: sfm.reconstruct(folder, tmp_path / "out")) == []
    assert name in tasks[0]["groups"][0]
    assert tasks[1][name].startswith(begin)
    assert tasks[1]["view_04.jpg"] == (folder / "view_04.jpg").read_bytes()
    (tmp_path / name).write_bytes(tasks[1][name])
    assert np.abs(np.asarray(Pillow.open(tmp_path / name).convert("RGB"), float) - picture).mean() < off


def test_bad_folders(tmp_path, photos):
    refuses(r"missing: no such file or folder", sfm.reconstruct, tmp_path / "missing", tmp_path / "out")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty/a.gif").write_bytes(b"")
    with pytest.raises(InputError, match=r"empty: no photos found, only 1 in unsupported formats such as a\.gif"):
        sfm.reconstruct(tmp_path / "empty", tmp_path / "out")
    (tmp_path / "few").mkdir()
    shutil.copy(photos / "view_00.jpg", tmp_path / "few")
    refuses(r"few: only 1 photo\(s\) found, expected at least 3", sfm.reconstruct, tmp_path / "few", tmp_path / "out")
    for output, settings, told in [
        (tmp_path, {}, "is neither empty nor a result of sfm"),
        (tmp_path / "few/view_00.jpg", {}, "is a file"),
        (tmp_path / "out", {"matching": "nearest"}, "expected one of auto, exhaustive, sequential, spatial, retrieval"),
        (tmp_path / "out", {"mapper": "both"}, "mapper 'both': expected one of auto, global, incremental"),
        (tmp_path / "out", {"features": "orb"}, "features 'orb': expected one of sift, aliked"),
        (tmp_path / "out", {"weights": "w.onnx"}, "w.onnx: SIFT features have no weights, expected --features aliked"),
        (tmp_path / "out", {"camera_model": "LENS"}, "camera model 'LENS'"),
    ]:
        refuses(told, sfm.reconstruct, photos, output, sfm.SfmSettings(**settings))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("damage", ["garbage", "truncated", "empty"])
def test_photo_that_does_not_decode_is_named(photos, tmp_path, damage):
    folder = shutil.copytree(photos, tmp_path / "photos")
    whole = (folder / "view_05.jpg").read_bytes()
    broken = {"garbage": b"hello" * 100, "truncated": whole[: len(whole) // 2], "empty": b""}[damage]
    (folder / "view_05.jpg").write_bytes(broken)
    refuses(r"view_05\.jpg: (cannot be decoded|does not decode)", sfm.reconstruct, folder, tmp_path / "out")
    assert leftovers(tmp_path) == ["photos"]


def task_of(monkeypatch):
    """What the worker would have been given, in place of running it."""
    tasks = []

    def run(task, work, report):
        tasks.append(task)
        return {"result": {"registered": sorted(name for group in task["groups"] for name in group), "fragments": []}}

    def move(move):
        photos = move[0].parent / "photos"
        tasks.append({path.name: path.read_bytes() for path in photos.rglob("*") if path.is_file()})

    monkeypatch.setattr(sfm, "run_worker", run)
    monkeypatch.setattr(sfm, "turn_new", lambda *_: None)
    monkeypatch.setattr(sfm, "move_into_place", move)

    def stage(_images, _paths, target, *_):
        (target.parent / "result" / "images").mkdir(parents=True)

    noted(monkeypatch, sfm_photos, "stage_photos", stage)
    return tasks


def test_what_is_no_photo_is_left_out_with_a_line(photos, tmp_path, monkeypatch):
    folder = shutil.copytree(photos, tmp_path / "photos")
    (folder / "masks").mkdir()
    for index in range(COUNT):
        write_png(folder / "masks" / f"view_{index:02d}.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    broken = can_link()
    if broken:
        (folder / "gone.jpg").symlink_to(folder / "nowhere.jpg")
    tasks = task_of(monkeypatch)
    messages = warnings_of(lambda: sfm.reconstruct(folder, tmp_path / "out"))
    assert sorted(tasks[0]["groups"][0]) == [f"view_{index:02d}.jpg" for index in range(COUNT)]
    masks = (
        "12 photo(s) (masks/view_00.png, masks/view_01.png, masks/view_02.png and 9 more) left out: their names mark "
    )
    assert messages[-1].startswith(f"{folder}: {masks}")
    assert messages[:-1] == ([f"{folder}: 1 photo(s) (gone.jpg) left out: broken links"] if broken else [])


def test_a_folder_of_photos_that_cannot_be_read_is_named(photos, tmp_path, monkeypatch):
    folder = tmp_path / "photos"
    shutil.copytree(photos, folder / "a")
    locked(monkeypatch, folder / "locked")
    with pytest.raises(InputError, match="locked: cannot be searched for pictures: permission is denied; make it read"):
        sfm.reconstruct(folder, tmp_path / "out")


def test_photos_without_texture_say_what_there_was(tmp_path):
    for index in range(4):
        write_image(tmp_path / f"photos/{index}.jpg", np.full((HEIGHT, WIDTH, 3), 60 * index, np.uint8))
    with pytest.raises(
        InputError,
        match=r"no cameras could be recovered from 4 photos: the median photo has 0 features, 0 of \d+ pairs",
    ):
        sfm.reconstruct(tmp_path / "photos", tmp_path / "out")
    assert leftovers(tmp_path) == ["photos"]


@pytest.mark.parametrize("stage", ["reading photos", "finding features", "placing cameras"])
def test_interrupt_leaves_nothing(photos, tmp_path, stage):
    def interrupt(text, fraction):
        if text == stage:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sfm.reconstruct(photos, tmp_path / "out", progress=interrupt)
    assert leftovers(tmp_path) == []


def test_failing_worker_is_an_error_with_its_last_words(photos, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    refuses("structure from motion failed", sfm.reconstruct, photos, tmp_path / "out", error=ClsplatError)
    assert leftovers(tmp_path) == []


@pytest.mark.slow
def test_the_whole_demo_registers(tmp_path):
    ray_caster.write_photos(tmp_path / "photos")
    output = sfm.reconstruct(tmp_path / "photos", tmp_path / "scene", PINHOLE)
    record = json.loads((output / SFM_RECORD_FILE).read_text())
    assert record["unregistered"] == []
    assert record["points"] > 2000
    assert record["mean_reprojection_error"] < 0.3


@pytest.mark.slow
def test_cameras_of_their_own_and_sequential_matching(photos, tmp_path):
    output = sfm.reconstruct(photos, tmp_path / "scene", sfm.SfmSettings(matching="sequential", shared_camera=False))
    assert len(pycolmap.Reconstruction(output / "sparse/0").cameras) == COUNT


def with_masks(photos, folder, name, top):
    """images/ and masks/ with files of this name, whose upper quarter has this value, the rest the other."""
    shutil.copytree(photos, folder / "images")
    mask = np.full((HEIGHT, WIDTH, 3), 255 - top, np.uint8)
    mask[: HEIGHT // 4] = top
    for path in (folder / "images").iterdir():
        write_png(folder / "masks" / name.format(path), mask)
    return folder


def assert_no_feature_under_the_mask(folder):
    """But for what undistortion moves."""
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    seen = [point.xy[1] for image in model.images.values() for point in image.points2D if point.has_point3D()]
    assert min(seen) > HEIGHT // 4 - 6


def test_features_under_masks_are_left_out_and_masks_are_undistorted(photos, tmp_path):
    folder = with_masks(photos, tmp_path / "capture", "{0.name}.png", 0)
    out = sfm.reconstruct(folder / "images", tmp_path / "out", masks=MaskUse("ignore"))
    assert_no_feature_under_the_mask(out)
    view = load_scene(out, masks=MaskUse("ignore")).views[0]
    pixels = view.load_masked()
    assert not pixels[: HEIGHT // 4 - 6].any()
    assert pixels[HEIGHT // 4 + 6 :, :, 4].all()


def test_masks_that_are_asked_for_and_not_there(photos, tmp_path):
    refuses("has no masks, expected masks/", sfm.reconstruct, photos, tmp_path / "out", masks=MaskUse("ignore"))


@pytest.mark.slow
def test_photos_with_masks_are_trained_by_their_folder(photos, tmp_path, monkeypatch):
    """images/ and masks/ in one folder without cameras: the masks reach sfm, are inverted once, and count after it."""
    folder = with_masks(photos, tmp_path / "capture", "{0.stem}.png", 255)
    scene = load_scene(folder, masks=MaskUse("transparent", invert=True))
    assert_no_feature_under_the_mask(tmp_path / "capture_colmap")
    alpha = scene.views[0].load()[:, :, 3]
    assert not alpha[: HEIGHT // 4 - 6].any()
    assert alpha[HEIGHT // 4 + 6 :].all()
    monkeypatch.setattr(sfm, "run_worker", lambda *_: pytest.fail("reconstructed again"))
    ignored = load_scene(folder, masks=MaskUse("ignore", invert=True)).views[0].load_masked()
    assert not ignored[: HEIGHT // 4 - 6, :, 4].any(), "the same features, so the same reconstruction"


@pytest.mark.slow
def test_alpha_that_undistortion_loses_is_kept_as_masks(pictures, tmp_path):
    folder = tmp_path / "photos"
    for index, picture in enumerate(pictures[0]):
        alpha = np.full((*picture.shape[:2], 1), 255, np.uint8)
        alpha[: HEIGHT // 4] = 0
        write_png(folder / f"{index:02d}.png", np.concatenate([picture, alpha], axis=2))
    messages = warnings_of(lambda: load_scene(folder, masks=MaskUse(alpha="ignore")))
    assert not any("lost their alpha" in text for text in messages)
    view = load_scene(folder, masks=MaskUse(alpha="ignore")).views[0]
    counts = view.load_masked()[:, :, 4]
    assert not counts[: HEIGHT // 4 - 6].any()
    assert counts[HEIGHT // 4 + 6 :].all()


def test_two_meanings_of_photos_without_cameras(photos):
    with pytest.raises(InputError, match="--masks ignore and --alpha transparent: expected the same meaning"):
        load_scene(photos, masks=MaskUse("ignore", "transparent"))

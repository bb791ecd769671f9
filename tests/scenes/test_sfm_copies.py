# SPDX-License-Identifier: Apache-2.0
"""The same photograph twice in a folder for structure from motion: which one is used, and what is said."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import warnings_of
from demo_photographs import photographs
from numpy.typing import NDArray
from PIL import Image as Pillow
from quick import quick
from scipy.ndimage import map_coordinates

from clsplat.config.masks import MaskUse
from clsplat.errors import InputError
from clsplat.scenes.sfm import copies, photos
from clsplat.scenes.sfm import reconstruct as sfm

COUNT, WIDTH, HEIGHT = 4, 240, 180
Picture = NDArray[np.uint8]


@pytest.fixture(scope="module")
def pictures() -> list[Picture]:
    """Neighbouring views, (180, 240, 3)."""
    return photographs(range(COUNT), WIDTH, HEIGHT)[0]


def resized(picture: Picture, side: int) -> Picture:
    height, width = picture.shape[:2]
    return np.asarray(Pillow.fromarray(picture).resize((side, side * height // width), Pillow.Resampling.LANCZOS))


def write(path: Path, picture: Picture, side: int = WIDTH, **how: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Pillow.fromarray(picture if side == WIDTH else resized(picture, side))
    image.save(path, **{**({"quality": 92} if path.suffix.lower() == ".jpg" else {}), **how})


@pytest.fixture
def used(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], tuple[list[str], list[str]]]:
    """Names of the photos that structure from motion is given of a folder, and the warnings."""
    tasks: list[dict[str, Any]] = []

    def run(task: dict[str, Any], work: Path, report: object) -> dict[str, Any]:
        tasks.append(task)
        (work / "result" / "images").mkdir(parents=True)
        registered = sorted(name for group in task["groups"] for name in group)
        return {"result": {"registered": registered, "fragments": []}}

    monkeypatch.setattr(sfm, "run_worker", run)
    monkeypatch.setattr(sfm, "turn_new", lambda *_: None)
    monkeypatch.setattr(sfm, "_without_their_alpha", lambda *_: [])

    def work(folder: Path) -> tuple[list[str], list[str]]:
        messages = warnings_of(lambda: sfm.reconstruct(folder, folder.parent / "scene"))
        return sorted(name for group in tasks[-1]["groups"] for name in group), messages

    return work


def undone(picture: Picture, k1: float = -0.25, cut: int = 0) -> Picture:
    """A picture as of a lens whose distortion is undone, without a margin of `cut` pixels."""
    height, width = picture.shape[:2]
    row, column = np.mgrid[0:height, 0:width]
    y, x = (row - height / 2) / width, (column - width / 2) / width
    bent = 1 + k1 * (x * x + y * y)
    rows, columns = y * bent * width + height / 2, x * bent * width + width / 2
    planes = [map_coordinates(picture[:, :, channel], [rows, columns], order=1, mode="nearest") for channel in range(3)]
    return np.stack(planes, axis=2)[cut : height - cut, cut : width - cut]


def names(folder: str, extension: str = "jpg") -> list[str]:
    return [f"{folder}{index}.{extension}" for index in range(COUNT)]


@pytest.mark.brings("nerfstudio, 3DGS", "`images_2` and so on beside `images`, into `sfm`", "the largest alone")
@pytest.mark.parametrize(
    ("kept", "others"),
    [
        ("images", {"images_2": 120, "images_4": 60, "images_8": 30}),
        ("scan/images", {"scan/images_3": 80}),
        ("rgb", {"rgb_2": 120}),
        ("images_2", {"images_4": 120, "images_8": 60}),
    ],
)
def test_smaller_copies_in_folders_beside(
    kept: str, others: dict[str, int], pictures: list[Picture], tmp_path: Path, used: Any
) -> None:
    for index, picture in enumerate(pictures):
        write(tmp_path / "in" / kept / f"{index}.jpg", picture)
        for folder, side in others.items():
            write(tmp_path / "in" / folder / f"{index}.png", picture, side)
    found, (message,) = used(tmp_path / "in")
    assert found == names(f"{kept}/")
    first = min(others)
    told = f"{len(others) * COUNT} photographs are copies and left out ({first}/0.png is {kept}/0.jpg, smaller,"
    assert told in message


CHANGES: dict[str, Callable[[Picture], Picture]] = {
    "corrected": undone,
    "smaller": lambda picture: resized(picture, 120),
    "smaller than what is compared": lambda picture: resized(picture, 60),
    "same": lambda picture: picture,
}
"""Copies by what is told of them, which begins so."""


@pytest.mark.brings("Polycam, 3DGS", "`corrected_images` or `input` beside `images`, into `sfm`", "one of them")
@pytest.mark.brings("COLMAP, OpenSfM", "`dense/0/images`, `undistorted/images` beside `images`, into `sfm`", "one")
@pytest.mark.parametrize(
    ("kept", "other", "change"),
    [
        # before and after their lens was undone: by their names, as the pictures differ
        ("keyframes/images/{0}.jpg", "keyframes/corrected_images/{0}.jpg", "corrected"),
        ("keyframes/input/{0}.jpg", "keyframes/images/{0}.jpg", "corrected"),
        ("keyframes/images/{0}.jpg", "keyframes/undistorted/{0}.jpg", "corrected"),
        ("keyframes/Input/{0}.jpg", "keyframes/undistorted_images/{0}.jpg", "corrected"),
        # some folders deeper
        ("images/{0}.jpg", "undistorted/images/{0}.jpg", "corrected"),
        ("images/{0}.jpg", "opensfm/undistorted/images/{0}.jpg.jpg", "corrected"),
        ("images/{0}.jpg", "dense/images/{0}.jpg", "corrected"),
        ("images/{0}.jpg", "dense/0/images/{0}.jpg", "corrected"),
        ("images/left/{0}.jpg", "dense/0/images/left/{0}.jpg", "corrected"),
        ("{0}.jpg", "undistorted/{0}.png", "corrected"),
        ("left/{0}.jpg", "undistorted/left/{0}.jpg", "corrected"),
        # the larger one is kept, though its name says that it is the copy
        ("images/{0}.jpg", "input/{0}.jpg", "smaller"),
        # the same names and pictures in any folder, beside the photographs' folder or in it
        ("photos/{0}.jpg", "for the web/{0}.jpg", "smaller"),
        ("{0}.jpg", "backup/{0}.jpg", "same"),
        ("all/{0}.jpg", "all/deep/{0}.jpg", "smaller than what is compared"),
    ],
)
def test_copies_are_left_out(
    kept: str, other: str, change: str, pictures: list[Picture], tmp_path: Path, used: Any
) -> None:
    for index, picture in enumerate(pictures):
        write(tmp_path / "in" / kept.format(index), picture)
        write(tmp_path / "in" / other.format(index), CHANGES[change](picture), optimize=True)
    found, (message,) = used(tmp_path / "in")
    assert found == [kept.format(index) for index in range(COUNT)]
    assert f"{other.format(0)} is {kept.format(0)}, {change.split(maxsplit=1)[0]}" in message


@pytest.mark.brings("phones, raw converters", "IMG.jpg and IMG.png, into `sfm`", "one of them")
@pytest.mark.parametrize(("one", "other"), [("jpg", "png"), ("png", "tif"), ("JPG", "bmp")])
def test_one_stem_in_two_types(one: str, other: str, pictures: list[Picture], tmp_path: Path, used: Any) -> None:
    for index, picture in enumerate(pictures):
        write(tmp_path / "in" / f"{index}.{one}", picture)
        write(tmp_path / "in" / f"{index}.{other}", picture)
    found, (message,) = used(tmp_path / "in")
    lossless = one if one == "png" else other  # of two lossless ones the first by name
    assert found == names("", lossless)
    assert f"{COUNT} photographs are copies and left out (" in message


def test_a_photograph_turned_by_exif_is_its_upright_copy(pictures: list[Picture], tmp_path: Path, used: Any) -> None:
    exif = Pillow.Exif()
    exif[0x0112], exif[0x010F] = 6, "Maker"
    for index, picture in enumerate(pictures):
        (tmp_path / "in").mkdir(exist_ok=True)
        Pillow.fromarray(np.rot90(picture, 1)).save(tmp_path / "in" / f"{index}.jpg", exif=exif)
        write(tmp_path / "in" / f"{index}.png", picture)
    found, _ = used(tmp_path / "in")
    assert found == names("")  # with a lens in EXIF


@pytest.mark.parametrize("copy", ["0 (1).jpg", "copy of 0.jpg", "z/elsewhere/other.jpg"])
def test_the_same_bytes_under_another_name(copy: str, pictures: list[Picture], tmp_path: Path, used: Any) -> None:
    for index, picture in enumerate(pictures):
        write(tmp_path / "in" / f"{index}.jpg", picture)
    (tmp_path / "in" / copy).parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(tmp_path / "in" / "0.jpg", tmp_path / "in" / copy)
    found, (message,) = used(tmp_path / "in")
    assert found == names("")
    told = f"1 photograph is a copy of another and left out ({copy} is 0.jpg, same bytes); to use the copies instead"
    assert told in message


@pytest.mark.parametrize("folders", [("left", "right"), ("cam0", "cam1"), ("images_1", "images_2"), ("cam", "cam_2")])
def test_several_cameras_stay(folders: tuple[str, str], pictures: list[Picture], tmp_path: Path, used: Any) -> None:
    """One's pictures are the next view's of the other: a fortieth of a turn apart."""
    for index in range(COUNT - 1):
        for side, folder in enumerate(folders):
            write(tmp_path / "in" / folder / f"{index}.jpg", pictures[index + side])
    found, messages = used(tmp_path / "in")
    assert len(found) == 2 * (COUNT - 1) - (COUNT - 2)  # the rest is each the same file as one of the other camera's
    assert [text for text in messages if "same bytes" not in text] == []


@pytest.fixture(scope="module")
def elsewhere() -> list[Picture]:
    """Views from the other side, (180, 240, 3)."""
    return photographs(range(20, 20 + COUNT), WIDTH, HEIGHT)[0]


@pytest.mark.parametrize("side", quick([WIDTH, 120], 120))
@pytest.mark.parametrize(
    "folders",
    [
        *[("cam_1", "cam_2"), ("day-1", "day-2"), ("camera_2", "camera_4"), ("images_1", "images_2")],
        *[("images", "images_2"), ("raw", "images"), ("images", "corrected"), ("input", "undistorted")],
        *[("images", "dense/0/images"), ("", "undistorted/images")],
    ],
)
def test_other_pictures_in_folders_whose_names_tell_stay(
    folders: tuple[str, str], side: int, pictures: list[Picture], elsewhere: list[Picture], tmp_path: Path, used: Any
) -> None:
    """Of two cameras, the second of half the size too."""
    for index in range(COUNT):
        write(tmp_path / "in" / folders[0] / f"{index}.jpg", pictures[index])
        write(tmp_path / "in" / folders[1] / f"{index}.jpg", elsewhere[index], side)
    found, messages = used(tmp_path / "in")
    assert (len(found), messages) == (2 * COUNT, [])


@pytest.mark.brings("3DGS' convert.py", "`input/ images/ images_2/ images_4/`, into `sfm`", "one of them")
@pytest.mark.parametrize("extension", ["jpg", "png"])
@pytest.mark.parametrize("cut", [0, 6])
def test_smaller_copies_of_a_copy(cut: int, extension: str, pictures: list[Picture], tmp_path: Path, used: Any) -> None:
    for index, picture in enumerate(pictures):
        write(tmp_path / "in" / "input" / f"{index}.jpg", picture)
        pinhole = undone(picture, cut=cut)
        for folder, factor in (("images", 1), ("images_2", 2), ("images_4", 4)):
            side = WIDTH if factor == 1 else pinhole.shape[1] // factor
            write(tmp_path / "in" / folder / f"{index}.{extension}", pinhole, side)
    found, (message,) = used(tmp_path / "in")
    assert found == names("input/")
    assert f"{3 * COUNT} photographs are copies and left out (images/0.{extension} is input/0.jpg, " in message


def test_what_shows_nothing_goes_with_its_folder(pictures: list[Picture], tmp_path: Path, used: Any) -> None:
    """A dark picture is a copy as the others of its folder are."""
    for index, picture in enumerate([*pictures, np.full((HEIGHT, WIDTH, 3), 7, np.uint8)]):
        write(tmp_path / "in" / "images" / f"{index}.png", picture)
        write(tmp_path / "in" / "images_2" / f"{index}.png", picture, 120)
    found, _ = used(tmp_path / "in")
    assert found == [f"images/{index}.png" for index in range(COUNT + 1)]


def test_a_stereo_rig_stays(pictures: list[Picture], tmp_path: Path, used: Any) -> None:
    """Pictures that are apart by a hundredth of their width, with a dark one each."""
    for index, picture in enumerate(pictures):
        write(tmp_path / "in" / "left" / f"{index:04}.jpg", picture)
        write(tmp_path / "in" / "right" / f"{index:04}.jpg", np.roll(picture, 3, axis=1))
    for side, folder in enumerate(("left", "right")):
        write(tmp_path / "in" / folder / "dark.png", np.full((HEIGHT, WIDTH, 3), side, np.uint8))
    found, messages = used(tmp_path / "in")
    assert len(found) == 2 * COUNT + 2
    assert messages == []


def test_a_folder_without_copies_is_not_compared(
    pictures: list[Picture], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, used: Any
) -> None:
    monkeypatch.setattr(photos, "thumb_of", lambda *_: pytest.fail("compared"))
    monkeypatch.setattr(copies, "image_size", lambda *_: pytest.fail("looked at"))
    monkeypatch.setattr(copies, "short_digest", lambda *_: pytest.fail("read"))
    for index, picture in enumerate(pictures):
        write(tmp_path / "in" / "a" / f"{index}.jpg", picture)
        write(tmp_path / "in" / "b" / f"{index + COUNT}.jpg", np.roll(picture, 20, axis=0))
    found, messages = used(tmp_path / "in")
    assert (len(found), messages) == (2 * COUNT, [])


def test_copies_are_no_photographs_to_count(pictures: list[Picture], tmp_path: Path) -> None:
    for index, picture in enumerate(pictures[:2]):
        write(tmp_path / "in" / "a" / f"{index}.jpg", picture)
        write(tmp_path / "in" / "b" / f"{index}.png", picture)
    with pytest.warns(UserWarning, match="2 photo"), pytest.raises(InputError, match=r"only 2 photo\(s\) found"):
        sfm.reconstruct(tmp_path / "in", tmp_path / "scene")


def test_what_is_compared_has_one_scale_in_every_type() -> None:
    ramp = np.linspace(0, 1, WIDTH)[None, :, None] * np.ones((HEIGHT, 1, 3))
    thumbs = [
        copies.thumb_of(np.rint(255 * ramp).astype(np.uint8), -1),
        copies.thumb_of(np.rint(65535 * ramp).astype(np.uint16), -1),
        copies.thumb_of(ramp.astype(np.float32), -1),
        copies.thumb_of(np.rint(255 * ramp[:, :, :1]).astype(np.uint8), -1),
        copies.thumb_of(np.rint(255 * np.dstack([1 - ramp[:, :, 0], ramp])).astype(np.uint8), 0),
    ]
    for thumb in thumbs:
        assert thumb.shape == (72, 96)
        # means of two and a half columns of a ramp of about one level each, and two roundings
        assert np.abs(thumb[40].astype(float) - (np.arange(96) + 0.5) * 255 / 96).max() <= 1.5


def test_masks_are_those_of_what_is_kept(pictures: list[Picture], tmp_path: Path, monkeypatch: Any, used: Any) -> None:
    """Masks of copies are passed over, and those beside the only folder that is left are found."""
    staged: list[tuple[str, str]] = []
    monkeypatch.setattr(sfm, "stage_mask", lambda path, target, *_, **__: staged.append((path.name, target.name)))
    for index, picture in enumerate(pictures):
        write(tmp_path / "in" / "images" / f"{index}.jpg", picture)
        write(tmp_path / "in" / "images_2" / f"{index}.jpg", picture, 120)
        write(tmp_path / "in" / "masks" / f"{index}.jpg.mask.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    with pytest.warns(UserWarning, match="4 photographs are copies"):
        sfm.reconstruct(tmp_path / "in", tmp_path / "scene", masks=MaskUse("ignore"))
    assert staged == [(f"{index}.jpg.mask.png", f"{index}.jpg.png") for index in range(COUNT)]

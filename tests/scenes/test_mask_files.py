# SPDX-License-Identifier: Apache-2.0
"""The files of masks: their names, their sizes, and what is said of those that do not fit."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from calls import only, refuses, warned
from PIL import Image as Pillow
from tiny import HEIGHT, VIEWS, WIDTH, write_scene

from clsplat.config.masks import MaskUse
from clsplat.images.reading import companions, find_images
from clsplat.images.writing import write_image
from clsplat.scenes.analysis.photo_findings import findings
from clsplat.scenes.loading import load_scene
from clsplat.scenes.sfm import photos as sfm_photos
from clsplat.scenes.sfm import reconstruct
from clsplat.scenes.sfm.video_frames import VideoFrames
from clsplat.scenes.supervision.masks import OTHER_MASK_FOLDERS, find_masks, masks_beside, read_mask

IGNORE = MaskUse("ignore")
NO_VIDEOS = VideoFrames(Path("none"))


def mask_of(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    mask = np.ones((height, width, 3), np.float32)
    mask[:, : width // 2] = 0
    return mask


def frame(scene: Path, index: int, file_path: str, mask_path: str | None = None) -> dict[str, object]:
    """One of a transforms.json, 30 x 20, and its picture; `index` is where it stands."""
    (scene / file_path).parent.mkdir(parents=True, exist_ok=True)
    write_image(scene / file_path, np.full((20, 30, 3), 0.5, np.float32))
    pose = [[1.0, 0, 0, index], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    paths = {"file_path": file_path, **({"mask_path": mask_path} if mask_path else {})}
    return {**paths, "transform_matrix": pose}


def write_frames(scene: Path, frames: list[dict[str, object]]) -> None:
    (scene / "transforms.json").write_text(json.dumps({"fl_x": 30, "w": 30, "h": 20, "frames": frames}))


@pytest.mark.parametrize("form", ["{0}.png.png", "{0}.png", "{0}_mask.png", "mask_{0}.png", "{0}.mask.png"])
@pytest.mark.parametrize("folder", ["masks", "mask", "images/masks"])
def test_names_of_masks(tmp_path: Path, form: str, folder: str) -> None:
    scene = write_scene(tmp_path / "scene")
    (scene / folder).mkdir()
    for index in range(VIEWS):
        write_image(scene / folder / form.format(f"{index:02d}"), mask_of())
    for view in load_scene(scene, masks=IGNORE).views:
        pixels = view.load_masked()
        assert pixels[:, :, 4].mean() == 0.5
        assert not pixels[:, : WIDTH // 2].any()
    inverted = load_scene(scene, masks=MaskUse("ignore", invert=True)).views[0].load_masked()
    assert not inverted[:, WIDTH // 2 :].any()
    cut = load_scene(scene, masks=MaskUse("transparent")).views[0].load_masked()
    assert cut.shape[2] == 4
    assert cut[:, :, 3].mean() == 0.5


@pytest.mark.parametrize(
    ("name", "size", "told"),
    [
        ("elsewhere.png", (48, 40), r"masks: 1 mask\(s\) fit no photograph \(elsewhere\.png\): expected names"),
        ("03.png", (24, 20), r"03\.png: the mask has 24x20 pixels, expected the size of its photograph, 48x40"),
    ],
    ids=["of no photograph", "of another size"],
)
def test_a_mask_that_does_not_fit(name: str, size: tuple[int, int], told: str, tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    (scene / "masks").mkdir()
    write_image(scene / "masks" / name, mask_of(*size))
    refuses(told, load_scene, scene, masks=IGNORE)
    assert load_scene(scene).views[0].mask is None


def test_no_masks_at_all_and_some_missing(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    refuses("has no masks for --masks ignore; expected masks/", load_scene, scene, masks=IGNORE)
    (scene / "masks").mkdir()
    write_image(scene / "masks" / "03.png", mask_of())
    read = load_scene(scene, masks=IGNORE)
    assert any(f"{VIEWS - 1} photograph(s) have no mask and are used as a whole" in text for text in read.warnings)
    assert [view.load_masked().shape[2] for view in read.views[2:4]] == [3, 5]


def test_two_masks_of_one_photograph(tmp_path: Path) -> None:
    for name in ("a.png", "a.jpg.png"):
        write_image(tmp_path / name, mask_of())
    refuses(r"is a second mask of a\.jpg, beside", find_masks, tmp_path, ["a.jpg"])


def test_an_alpha_channel_to_ignore(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", alpha=True)
    blended, ignored = (load_scene(scene, masks=MaskUse(alpha=use)).views[0] for use in ("blend", "ignore"))
    alpha = blended.load_masked()[:, :, 3]
    pixels = ignored.load_masked()
    assert ((pixels[:, :, 4] > 0) == (alpha >= 0.5)).all()
    assert ignored.load().shape[2] == 3


def test_mask_path_of_a_frame(tmp_path: Path) -> None:
    write_frames(tmp_path, [frame(tmp_path, i, f"images/{i}.png", f"shapes/m{i}.png") for i in range(3)])
    masks_at(tmp_path, *(f"shapes/m{index}.png" for index in range(3)))
    read = load_scene(tmp_path, masks=IGNORE)
    assert read.views[1].load_masked()[:, :, 4].mean() == 0.5
    assert not any("ignored" in text for text in read.warnings)
    (tmp_path / "shapes" / "m1.png").unlink()
    refuses(r"m1\.png: no such image file", load_scene, tmp_path, masks=IGNORE)


def test_one_mask_for_all_frames(tmp_path: Path) -> None:
    """As nerfstudio writes it, in a folder where names would be of photographs; one more has its own there."""
    listed = ("masks/mask.png", "masks/mask.png", None)
    write_frames(tmp_path, [frame(tmp_path, i, f"images/{i}.png", mask) for i, mask in enumerate(listed)])
    masks_at(tmp_path, "masks/mask.png")
    write_image(tmp_path / "masks" / "2.png", np.ones((20, 30, 3), np.float32))
    read = load_scene(tmp_path, masks=IGNORE)
    assert [view.load_masked()[:, :, 4].mean() for view in read.views] == [0.5, 0.5, 1.0]


def test_masks_of_something_else_beside_the_scene(tmp_path: Path) -> None:
    """Photographs beside transforms.json have theirs in the same folder; what is outside it is not asked then."""
    scene = tmp_path / "scene"
    write_frames(scene, [frame(scene, index, f"{index}.png") for index in range(3)])
    masks_at(tmp_path, "masks/of-another.png", *(f"scene/masks/{index}.png" for index in range(3)))
    read = load_scene(scene, masks=IGNORE)
    assert [view.load_masked()[:, :, 4].mean() for view in read.views] == [0.5] * 3


def test_grey_from_a_half_on_counts(tmp_path: Path) -> None:
    values = np.array([[0.0, 0.4, 0.6, 1.0]] * 2, np.float32)[:, :, None] * np.ones(3, np.float32)
    write_image(tmp_path / "m.png", values)
    assert read_mask(tmp_path / "m.png", orient=False, invert=False)[0, :, 0].tolist() == [0, 0, 1, 1]


def test_masks_of_polycam_are_beside_the_keyframes(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "keyframes")
    (scene / "images").rename(scene / "corrected_images")
    (scene / "masks").mkdir()
    for index in range(VIEWS):
        write_image(scene / "masks" / f"{index:02d}.png", mask_of())
    read = load_scene(scene, images="corrected_images", masks=IGNORE)
    assert all(view.mask is not None and view.mask.path is not None for view in read.views)


@dataclass(frozen=True)
class Photo:
    name: str
    path: Path


def photographs(folder: Path, *names: str) -> list[Photo]:
    for index, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Pillow.fromarray(np.full((20, 30, 3), 40 + index, np.uint8)).save(folder / name)
    return [Photo(name, folder / name) for name in names]


def masks_at(scene: Path, *places: str) -> None:
    for place in places:
        (scene / place).parent.mkdir(parents=True, exist_ok=True)
        write_image(scene / place, mask_of(30, 20))


MASKS = {
    "IMG_1.jpg": (
        *("masks/IMG_1.jpg.mask.png", "mask/IMG_1.jpg_mask.png", ".mask/IMG_1.jpg.mask.png", "images/.mask/IMG_1.png"),
        *(".masks/IMG_1.jpg.png", "Masks/IMG_1.png", "images/IMG_1.mask.png", "images/IMG_1_mask.png"),
        *("images/IMG_1.jpg.mask.png", "images/IMG_1.jpg.png", "masks/IMG_1-mask.png", "images/IMG_1-mask.png"),
    ),
    "IMG_1.JPG": ("masks/IMG_1.jpg.PNG", "masks/img_1.jpg.mask.png", "masks/mask-IMG_1.png"),
    "IMG_1.png": ("masks/IMG_1.jpg.mask.png",),
    "a/IMG_1.jpg": (
        *("masks/IMG_1.png", "images/a/.mask/IMG_1.jpg.mask.png", "images/a/masks/IMG_1.png"),
        "images/a/IMG_1.jpg-mask.png",
    ),
    "a/b/IMG_1.jpg": ("masks/IMG_1.jpg.mask.png",),
    "a/IMG_1.JPG": ("images/a/img_1_MASK.PNG",),
}
"""Masks by their photograph."""


@pytest.mark.brings(
    "RealityScan, Brush, LichtFeld", "masks as `IMG.jpg.mask.png`, in `.mask/`, flat, beside the picture", "masks"
)
@pytest.mark.parametrize(("photo", "mask"), [(photo, mask) for photo, masks in MASKS.items() for mask in masks])
def test_masks_of_other_programs(photo: str, mask: str, tmp_path: Path) -> None:
    """For scenes and for structure from motion, which takes none of them for a photograph."""
    images = photographs(tmp_path / "images", photo, "other/IMG_2.jpg")
    masks_at(tmp_path, mask)
    assert masks_beside(images) == {photo: tmp_path / mask}
    paths, _ = sfm_photos.find_photos(tmp_path / "images")
    assert sorted(paths) == sorted(image.path for image in images)
    assert reconstruct._masks(tmp_path / "images", paths, IGNORE, NO_VIDEOS) == {photo: tmp_path / mask}
    present = find_images(tmp_path / "images")
    listed = {image.path for image in images}
    assert {path for path in present if path not in listed} == companions(
        [path for path in present if path not in listed], listed, tmp_path / "images"
    )


@pytest.mark.brings("SAM's users, matting tools", "`images_mask/`, `mattes/`, `segmentation/`", "masks, if asked for")
@pytest.mark.parametrize(
    "mask",
    [
        *["images_mask/IMG_1.png", "Images_Masks/IMG_1.jpg.png", "mattes/IMG_1.png", "segmentation/IMG_1-mask.png"],
        *["silhouettes/img_1.png", "images/images_mask/IMG_1.png"],
    ],
)
def test_folders_of_masks_by_other_names(mask: str, tmp_path: Path) -> None:
    images = photographs(tmp_path / "images", "IMG_1.jpg", "IMG_2.jpg")
    masks_at(tmp_path, mask)
    assert masks_beside(images) == {}
    found = {"IMG_1.jpg": tmp_path / mask}
    assert masks_beside(images, others=OTHER_MASK_FOLDERS) == found
    assert reconstruct._masks(tmp_path / "images", [image.path for image in images], IGNORE, NO_VIDEOS) == found
    masks_at(tmp_path, "masks/IMG_1.png")  # these go first
    assert masks_beside(images, others=OTHER_MASK_FOLDERS) == {"IMG_1.jpg": tmp_path / "masks" / "IMG_1.png"}


def test_white_may_be_what_moves(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    for index in range(VIEWS):
        (scene / "dynamic_masks").mkdir(exist_ok=True)
        write_image(scene / "dynamic_masks" / f"{index:02d}.png", mask_of())
    read = load_scene(scene, masks=IGNORE)
    assert [view.load_masked()[:, :, 4].mean() for view in read.views] == [0.5] * VIEWS
    assert (
        "white pixels are the ones to keep, as in all masks; if white marks moving objects there, add --invert-masks"
        in only([text for text in read.warnings if "dynamic_masks" in text])
    )
    inverted = load_scene(scene, masks=MaskUse("ignore", invert=True))
    assert not [text for text in inverted.warnings if "dynamic_masks" in text]
    paths = sorted((scene / "images").iterdir())
    warned("white pixels are the ones to keep", reconstruct._masks, scene / "images", paths, IGNORE, NO_VIDEOS)


@pytest.mark.brings("renderers, video tools", "masks/mask_0007.png for image_0007.png", "by their numbers")
@pytest.mark.parametrize(
    ("photo", "mask"),
    [
        ("image_{0:04}.png", "mask_{0:04}.png"),
        ("frame{0:05}.jpg", "matte_{0:03}.png"),
        ("a/IMG_{0}.jpg", "segmented-{0}.jpg.png"),
        ("{0:04}.png", "{0}.png"),
    ],
)
def test_two_series_go_together_by_their_numbers(photo: str, mask: str, tmp_path: Path) -> None:
    images = photographs(tmp_path / "images", *(photo.format(number) for number in range(1, 4)))
    masks_at(tmp_path, *(f"masks/{mask.format(number)}" for number in range(1, 3)))
    wanted = {photo.format(number): tmp_path / "masks" / mask.format(number) for number in range(1, 3)}
    assert masks_beside(images) == wanted
    masks_at(tmp_path, f"masks/{mask.format(7)}")
    refuses(r"masks: 1 mask\(s\) fit no photograph", masks_beside, images)


@pytest.mark.parametrize(
    ("photos", "masks"),
    [
        (("image_1.jpg", "photo_2.jpg"), ("mask_1.png", "mask_2.png")),
        (("a/image_1.jpg", "b/image_2.jpg"), ("m_1.png", "m_2.png")),
        (("image_1.jpg", "image_2.jpg"), ("mask_1.png", "other_2.png")),
        (("image_1.jpg", "image_01.jpg"), ("m_1.png", "m_2.png")),
        (("image_1.jpg", "image_2.jpg"), ("m_1.png", "m_01.png")),
        (("image_1.jpg", "image_2.jpg"), ("m_1.png",)),
        (("image_1.jpg", "image_2.jpg"), ("image_1.png", "m_2.png")),
    ],
)
def test_numbers_that_are_of_no_series(photos: tuple[str, ...], masks: tuple[str, ...], tmp_path: Path) -> None:
    images = photographs(tmp_path / "images", *photos)
    masks_at(tmp_path, *(f"masks/{name}" for name in masks))
    refuses(r"mask\(s\) fit no photograph", masks_beside, images)


@pytest.mark.brings("matting and label tools", "IMG_silhouette.png, IMG_fg.png, labels/, into `sfm`", "no photographs")
@pytest.mark.parametrize(
    "mask",
    [
        *["IMG_{0}_silhouette.png", "IMG_{0}_fg.png", "labels/IMG_{0}.png", "IMG_{0}-foreground.png"],
        *["silhouettes/IMG_{0}.png", "fg_IMG_{0}.png", "images_labels/IMG_{0}.jpg.png", "mattes/IMG_{0}.png"],
    ],
)
def test_masks_are_no_photographs(mask: str, tmp_path: Path) -> None:
    images = photographs(tmp_path, *(f"IMG_{index}.jpg" for index in range(3)))
    masks_at(tmp_path, *(mask.format(index) for index in range(3)))
    paths, left_out = sfm_photos.find_photos(tmp_path)
    assert sorted(paths) == sorted(image.path for image in images)
    assert [len(each) for each in left_out.values()] == [3]


@pytest.mark.parametrize(
    ("photos", "masks"),
    [
        (("_091-0_mask_0.jpg", "_091-1_mask_0.jpg"), ("masks/_091-0_mask_0.png", "masks/_091-1_mask_0.png")),
        (("labels/IMG_1.jpg", "bottles/IMG_2.jpg"), ()),
        (("labels/IMG_1.jpg", "labels/IMG_2.jpg"), ()),
        (("IMG_1_fg.jpg", "IMG_2_fg.jpg"), ()),
        (("cof.jpg", "coffg.jpg", "x/cof_silhouette_left.jpg"), ()),
    ],
)
def test_photographs_by_names_of_masks_stay(photos: tuple[str, ...], masks: tuple[str, ...], tmp_path: Path) -> None:
    images = photographs(tmp_path, *photos)
    masks_at(tmp_path, *masks)
    paths, _ = sfm_photos.find_photos(tmp_path)
    assert sorted(paths) == sorted(image.path for image in images)


@pytest.mark.parametrize(
    ("photos", "mask"),
    [
        (("a/1.jpg", "b/1.jpg"), "masks/1.png"),
        (("IMG.jpg", "img.png"), "masks/Img.png"),
        (("1.jpg", "2.jpg"), "masks/3.jpg.mask.png"),
        (("a/1.jpg", "a/2.jpg"), "masks/12.png"),
    ],
)
def test_masks_that_may_be_of_several_photographs_are_of_none(
    photos: tuple[str, ...], mask: str, tmp_path: Path
) -> None:
    images = photographs(tmp_path / "images", *photos)
    masks_at(tmp_path, mask)
    refuses(r"masks: 1 mask\(s\) fit no photograph", masks_beside, images)
    assert masks_beside(images, strict=False) == {}


def test_exact_names_go_before_loose_ones(tmp_path: Path) -> None:
    images = photographs(tmp_path / "images", "a/1.jpg", "b/1.jpg", "b/2.jpg")
    masks_at(tmp_path, "masks/a/1.png", "masks/b/1.jpg.mask.png", "masks/2.png")
    wanted = {"a/1.jpg": "a/1.png", "b/1.jpg": "b/1.jpg.mask.png", "b/2.jpg": "2.png"}
    assert masks_beside(images) == {name: tmp_path / "masks" / mask for name, mask in wanted.items()}
    masks_at(tmp_path, "masks/B/2.png")
    refuses(r"is a second mask of b/2\.jpg, beside", masks_beside, images)


def test_pictures_beside_the_photographs_that_are_no_masks(tmp_path: Path) -> None:
    images = photographs(tmp_path / "images", "1.jpg", "2.jpg")
    masks_at(tmp_path, "images/1.png", "images/1_depth.png", "images/masked 2.png", "images/3_mask.png")
    assert masks_beside(images) == {}
    masks_at(tmp_path, "masks/1.png", "images/2_mask.png")  # a folder of masks has all of them
    assert masks_beside(images) == {"1.jpg": tmp_path / "masks" / "1.png"}


def test_masks_beside_the_photographs_are_found_and_used(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    for index in range(VIEWS):
        write_image(scene / "images" / f"{index:02d}.png.mask.png", mask_of())
    text = next(each.text for each in findings(load_scene(scene)) if each.kind == "masks")
    assert f"{VIEWS} of {VIEWS} photographs have masks" in text
    read = load_scene(scene, masks=IGNORE)
    assert [view.load_masked()[:, :, 4].mean() for view in read.views] == [0.5] * VIEWS
    assert not any("does not list" in text for text in read.warnings)

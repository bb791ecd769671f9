# SPDX-License-Identifier: Apache-2.0
"""The files of masks: their names, their sizes, and what is said of those that do not fit."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow
from tiny import HEIGHT, VIEWS, WIDTH, write_scene

from clsplat.config.masks import MaskUse
from clsplat.errors import InputError
from clsplat.images.reading import companions, find_images
from clsplat.images.writing import write_image
from clsplat.scenes import sfm, sfm_photos
from clsplat.scenes.findings import findings
from clsplat.scenes.loading import load_scene
from clsplat.scenes.masks import find_masks, masks_beside, read_mask

IGNORE = MaskUse("ignore")


def mask_of(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    mask = np.ones((height, width, 3), np.float32)
    mask[:, : width // 2] = 0
    return mask


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


def test_a_mask_of_no_photograph(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    (scene / "masks").mkdir()
    write_image(scene / "masks" / "elsewhere.png", mask_of())
    with pytest.raises(InputError, match=r"masks: 1 mask\(s\) fit no photograph \(elsewhere\.png\): expected names"):
        load_scene(scene, masks=IGNORE)
    assert load_scene(scene).views[0].mask is None


def test_a_mask_of_another_size(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    (scene / "masks").mkdir()
    write_image(scene / "masks" / "03.png", mask_of(24, 20))
    with pytest.raises(InputError, match=r"03\.png: the mask is 24 x 20 pixels, expected its photograph's 48 x 40"):
        load_scene(scene, masks=IGNORE)


def test_no_masks_at_all_and_some_missing(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    with pytest.raises(InputError, match="--masks ignore, and there are none; expected masks/"):
        load_scene(scene, masks=IGNORE)
    (scene / "masks").mkdir()
    write_image(scene / "masks" / "03.png", mask_of())
    read = load_scene(scene, masks=IGNORE)
    assert any(f"{VIEWS - 1} photograph(s) have no mask and count as a whole" in text for text in read.warnings)
    assert [view.load_masked().shape[2] for view in read.views[2:4]] == [3, 5]


def test_two_masks_of_one_photograph(tmp_path: Path) -> None:
    for name in ("a.png", "a.jpg.png"):
        write_image(tmp_path / name, mask_of())
    with pytest.raises(InputError, match=r"is a second mask of a\.jpg, beside"):
        find_masks(tmp_path, ["a.jpg"])


def test_an_alpha_channel_to_ignore(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", alpha=True)
    blended, ignored = (load_scene(scene, masks=MaskUse(alpha=use)).views[0] for use in ("blend", "ignore"))
    alpha = blended.load_masked()[:, :, 3]
    pixels = ignored.load_masked()
    assert ((pixels[:, :, 4] > 0) == (alpha >= 0.5)).all()
    assert ignored.load().shape[2] == 3


def test_mask_path_of_a_frame(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "shapes").mkdir()
    frames = []
    for index in range(3):
        write_image(tmp_path / "images" / f"{index}.png", np.full((20, 30, 3), 0.5, np.float32))
        write_image(tmp_path / "shapes" / f"m{index}.png", mask_of(30, 20))
        pose = np.eye(4)
        pose[0, 3] = index
        paths = {"file_path": f"images/{index}.png", "mask_path": f"shapes/m{index}.png"}
        frames.append({**paths, "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30, "w": 30, "h": 20, "frames": frames}))
    read = load_scene(tmp_path, masks=IGNORE)
    assert read.views[1].load_masked()[:, :, 4].mean() == 0.5
    assert not any("ignored" in text for text in read.warnings)
    (tmp_path / "shapes" / "m1.png").unlink()
    with pytest.raises(InputError, match=r"m1\.png: no such image file"):
        load_scene(tmp_path, masks=IGNORE)


def test_one_mask_for_all_frames(tmp_path: Path) -> None:
    """As nerfstudio writes it, in a folder where names would be of photographs; one more has its own there."""
    for folder in ("images", "masks"):
        (tmp_path / folder).mkdir()
    frames = []
    for index in range(3):
        write_image(tmp_path / "images" / f"{index}.png", np.full((20, 30, 3), 0.5, np.float32))
        pose = np.eye(4)
        pose[0, 3] = index
        paths = {"file_path": f"images/{index}.png", "mask_path": "masks/mask.png"}
        frames.append({**paths, "transform_matrix": pose.tolist()})
    write_image(tmp_path / "masks" / "mask.png", mask_of(30, 20))
    del frames[2]["mask_path"]
    write_image(tmp_path / "masks" / "2.png", np.ones((20, 30, 3), np.float32))
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30, "w": 30, "h": 20, "frames": frames}))
    read = load_scene(tmp_path, masks=IGNORE)
    assert [view.load_masked()[:, :, 4].mean() for view in read.views] == [0.5, 0.5, 1.0]


def test_masks_of_something_else_beside_the_scene(tmp_path: Path) -> None:
    """Photographs beside transforms.json have theirs in the same folder; what is outside it is not asked then."""
    scene = tmp_path / "scene"
    (scene / "masks").mkdir(parents=True)
    (tmp_path / "masks").mkdir()
    write_image(tmp_path / "masks" / "of-another.png", mask_of(30, 20))
    frames = []
    for index in range(3):
        write_image(scene / f"{index}.png", np.full((20, 30, 3), 0.5, np.float32))
        write_image(scene / "masks" / f"{index}.png", mask_of(30, 20))
        pose = np.eye(4)
        pose[0, 3] = index
        frames.append({"file_path": f"{index}.png", "transform_matrix": pose.tolist()})
    (scene / "transforms.json").write_text(json.dumps({"fl_x": 30, "w": 30, "h": 20, "frames": frames}))
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


@pytest.mark.brings(
    "RealityScan, Brush, LichtFeld", "masks as `IMG.jpg.mask.png`, in `.mask/`, flat, beside the picture", "masks"
)
@pytest.mark.parametrize(
    ("photo", "mask"),
    [
        ("IMG_1.jpg", "masks/IMG_1.jpg.mask.png"),
        ("IMG_1.jpg", "mask/IMG_1.jpg_mask.png"),
        ("IMG_1.jpg", ".mask/IMG_1.jpg.mask.png"),
        ("IMG_1.jpg", "images/.mask/IMG_1.png"),
        ("IMG_1.jpg", ".masks/IMG_1.jpg.png"),
        ("IMG_1.jpg", "Masks/IMG_1.png"),
        ("IMG_1.JPG", "masks/IMG_1.jpg.PNG"),
        ("IMG_1.JPG", "masks/img_1.jpg.mask.png"),
        ("IMG_1.png", "masks/IMG_1.jpg.mask.png"),
        ("a/IMG_1.jpg", "masks/IMG_1.png"),
        ("a/b/IMG_1.jpg", "masks/IMG_1.jpg.mask.png"),
        ("a/IMG_1.jpg", "images/a/.mask/IMG_1.jpg.mask.png"),
        ("a/IMG_1.jpg", "images/a/masks/IMG_1.png"),
        ("IMG_1.jpg", "images/IMG_1.mask.png"),
        ("IMG_1.jpg", "images/IMG_1_mask.png"),
        ("IMG_1.jpg", "images/IMG_1.jpg.mask.png"),
        ("IMG_1.jpg", "images/IMG_1.jpg.png"),
        ("a/IMG_1.JPG", "images/a/img_1_MASK.PNG"),
    ],
)
def test_masks_of_other_programs(photo: str, mask: str, tmp_path: Path) -> None:
    """For scenes and for structure from motion, which takes none of them for a photograph."""
    images = photographs(tmp_path / "images", photo, "other/IMG_2.jpg")
    masks_at(tmp_path, mask)
    assert masks_beside(images) == {photo: tmp_path / mask}
    paths, _ = sfm_photos.find_photos(tmp_path / "images")
    assert sorted(paths) == sorted(image.path for image in images)
    assert sfm._masks(tmp_path / "images", paths, IGNORE) == {photo: tmp_path / mask}
    present = find_images(tmp_path / "images")
    listed = {image.path for image in images}
    assert {path for path in present if path not in listed} == companions(
        [path for path in present if path not in listed], listed, tmp_path / "images"
    )


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
    with pytest.raises(InputError, match=r"masks: 1 mask\(s\) fit no photograph"):
        masks_beside(images)
    assert masks_beside(images, strict=False) == {}


def test_exact_names_go_before_loose_ones(tmp_path: Path) -> None:
    images = photographs(tmp_path / "images", "a/1.jpg", "b/1.jpg", "b/2.jpg")
    masks_at(tmp_path, "masks/a/1.png", "masks/b/1.jpg.mask.png", "masks/2.png")
    wanted = {"a/1.jpg": "a/1.png", "b/1.jpg": "b/1.jpg.mask.png", "b/2.jpg": "2.png"}
    assert masks_beside(images) == {name: tmp_path / "masks" / mask for name, mask in wanted.items()}
    masks_at(tmp_path, "masks/B/2.png")
    with pytest.raises(InputError, match=r"is a second mask of b/2\.jpg, beside"):
        masks_beside(images)


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
    assert f"there are masks for {VIEWS} of {VIEWS} photographs" in text
    read = load_scene(scene, masks=IGNORE)
    assert [view.load_masked()[:, :, 4].mean() for view in read.views] == [0.5] * VIEWS
    assert not any("does not list" in text for text in read.warnings)


def save_levels(path: Path, levels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Pillow.fromarray(levels).save(path)


@pytest.mark.brings("label tools", "masks of 0 and 1, 8 or 16 bit", "1 counts")
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("extension", ["png", "tif"])
def test_masks_of_0_and_1(dtype: type, extension: str, tmp_path: Path) -> None:
    labels = np.array([[0, 1, 1, 0]] * 3, dtype)
    for name, levels in (("some", labels), ("all", np.ones_like(labels)), ("none", np.zeros_like(labels))):
        save_levels(tmp_path / f"{name}.{extension}", levels)
        mask = read_mask(tmp_path / f"{name}.{extension}", orient=False, invert=False)
        assert mask[:, :, 0].tolist() == levels.tolist()
        inverted = read_mask(tmp_path / f"{name}.{extension}", orient=False, invert=True)
        assert inverted[:, :, 0].tolist() == (1 - levels.astype(int)).tolist()


def test_a_mask_of_0_and_1_in_colour_and_in_alpha(tmp_path: Path) -> None:
    labels = np.array([[0, 1, 1, 0]] * 3, np.uint8)
    save_levels(tmp_path / "rgb.png", np.repeat(labels[:, :, None], 3, axis=2))
    save_levels(tmp_path / "alpha.png", np.dstack([np.full((3, 4, 3), 255, np.uint8), labels]))
    palette = Pillow.fromarray(labels, "P")
    palette.putpalette([0, 0, 0, 1, 1, 1])
    palette.save(tmp_path / "palette.png")
    for name in ("rgb", "alpha", "palette"):
        assert read_mask(tmp_path / f"{name}.png", orient=False, invert=False)[:, :, 0].tolist() == labels.tolist()


@pytest.mark.parametrize(
    ("levels", "told"),
    [
        (np.array([[0, 64]], np.uint8), "0 and 64, all of them dark, expected 0 and 255"),
        (np.array([[0, 127]], np.uint8), "0 and 127, all"),
        (np.array([[0, 255]], np.uint16), "0 and 255, all of them dark, expected 0 and 65535"),
        (np.array([[64, 64]], np.uint8), "64, all"),
        (np.array([[1, 2]], np.uint8), "1 and 2, all"),
        (np.array([[0, 1, 2, 7, 20]], np.uint8), "5 from 0 to 20, all"),
    ],
)
def test_masks_that_are_all_dark(levels: np.ndarray, told: str, tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    for index in range(VIEWS):
        tiled = np.resize(levels[0], (HEIGHT, WIDTH)).astype(levels.dtype)
        save_levels(scene / "masks" / f"{index:02d}.png", tiled)
    with pytest.raises(InputError, match=rf"masks/00\.png: the mask's values are {told}"):
        load_scene(scene, masks=IGNORE).check_pictures()


def test_a_soft_mask_may_be_dark_where_others_are_not(tmp_path: Path) -> None:
    """Nothing of it counts then, as in any mask; two values that are dark are none of a soft mask."""
    save_levels(tmp_path / "a.png", np.array([[0, 3, 9, 40, 90]], np.uint8))
    save_levels(tmp_path / "b.png", np.array([[0, 3, 9, 140, 250]], np.uint8))
    save_levels(tmp_path / "c.png", np.array([[0, 9, 9, 0, 9]], np.uint8))
    Pillow.fromarray(np.full((16, 16), 1, np.uint8)).save(tmp_path / "d.jpg", quality=95)
    assert not read_mask(tmp_path / "a.png", orient=False, invert=False).any()
    assert not read_mask(tmp_path / "d.jpg", orient=False, invert=False).any()  # JPEG's 1 is about 0
    with pytest.raises(InputError, match=r"c\.png: the mask's values are 0 and 9"):
        read_mask(tmp_path / "c.png", orient=False, invert=False)
    (tmp_path / "b.png").unlink()
    with pytest.raises(InputError, match=r"a\.png: the mask's values are 5 from 0 to 90"):
        read_mask(tmp_path / "a.png", orient=False, invert=False)

# SPDX-License-Identifier: Apache-2.0
"""The values of masks: grey, labels, labels with void, and what is all dark."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from calls import refuses
from PIL import Image as Pillow
from tiny import HEIGHT, VIEWS, WIDTH, write_scene

from clsplat.config.masks import MaskUse
from clsplat.errors import InputError
from clsplat.scenes.loading import load_scene
from clsplat.scenes.supervision.masks import read_mask

IGNORE = MaskUse("ignore")


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
        (np.array([[0, 64]], np.uint8), "0 and 64, all below a half, expected 0 and 255"),
        (np.array([[0, 127]], np.uint8), "0 and 127, all"),
        (np.array([[0, 255]], np.uint16), "0 and 255, all below a half, expected 0 and 65535"),
        (np.array([[64, 64]], np.uint8), "64, all"),
        (np.array([[1, 2]], np.uint8), "1 and 2, all"),
        (np.array([[0, 1, 2, 7, 20]], np.uint8), "5 from 0 to 20, all"),
        (np.array([[[0, 0, 0], [255, 0, 0]]], np.uint8), r"\(0, 0, 0\) and \(255, 0, 0\), all below a half"),
        (np.array([[[0, 0, 0], [128, 0, 0]]], np.uint8), r"\(0, 0, 0\) and \(128, 0, 0\), all"),
        (
            np.array([[[0, 40, 0], [0, 0, 90], [9, 9, 9]]], np.uint8),
            r"3 colours such as \(0, 0, 90\), \(0, 40, 0\), \(",
        ),
        (np.array([[[7, 7, 7], [0, 0, 0]]], np.uint8), "0 and 7, all"),
    ],
)
def test_masks_that_are_all_dark(levels: np.ndarray, told: str, tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    for index in range(VIEWS):
        tiled = np.resize(levels[0], (HEIGHT, WIDTH, *levels.shape[2:])).astype(levels.dtype)
        save_levels(scene / "masks" / f"{index:02d}.png", tiled)
    refuses(rf"masks/00\.png: the mask's values are {told}", load_scene(scene, masks=IGNORE).check_pictures)


def test_a_soft_mask_may_be_dark_where_others_are_not(tmp_path: Path) -> None:
    """Nothing of it counts then, as in any mask; two values that are dark are none of a soft mask."""
    save_levels(tmp_path / "a.png", np.array([[0, 3, 9, 40, 90]], np.uint8))
    save_levels(tmp_path / "b.png", np.array([[0, 3, 9, 140, 250]], np.uint8))
    save_levels(tmp_path / "c.png", np.array([[0, 9, 9, 0, 9]], np.uint8))
    Pillow.fromarray(np.full((16, 16), 1, np.uint8)).save(tmp_path / "d.jpg", quality=95)
    assert not read_mask(tmp_path / "a.png", orient=False, invert=False).any()
    assert not read_mask(tmp_path / "d.jpg", orient=False, invert=False).any()  # JPEG's 1 is about 0
    refuses(r"c\.png: the mask's values are 0 and 9", read_mask, tmp_path / "c.png", orient=False, invert=False)
    (tmp_path / "b.png").unlink()
    refuses(r"a\.png: the mask's values are 5 from 0 to 90", read_mask, tmp_path / "a.png", orient=False, invert=False)


def labels_with_void(*areas: int, kind: type = np.uint8, void: int = 255) -> np.ndarray:
    """A picture (10, 20) of 0 with so many pixels of void, of 1, of 2 and so on."""
    levels = np.zeros(200, kind)
    ends = np.cumsum(areas)
    for label, (first, last) in enumerate(zip([0, *ends[:-1]], ends, strict=True)):
        levels[first:last] = label or void
    return levels.reshape(10, 20)


@pytest.mark.brings("VOC, Cityscapes", "masks of 0, 1 and 255, which is void", "1 counts, void never")
@pytest.mark.parametrize(
    "levels",
    [
        labels_with_void(20, 60),
        labels_with_void(60, 60),
        labels_with_void(10, 190),
        labels_with_void(20, 60, kind=np.uint16),
        labels_with_void(20, 60, kind=np.uint16, void=65535),
        np.repeat(labels_with_void(20, 60)[:, :, None], 3, axis=2),
    ],
)
@pytest.mark.parametrize("extension", ["png", "tif"])
def test_labels_with_void(levels: np.ndarray, extension: str, tmp_path: Path) -> None:
    path = tmp_path / f"m.{extension}"
    save_levels(path, levels)
    plain = levels if levels.ndim == 2 else levels[:, :, 0]
    assert (read_mask(path, orient=False, invert=False)[:, :, 0] == (plain == 1)).all()
    assert (read_mask(path, orient=False, invert=True)[:, :, 0] == (plain == 0)).all()


def test_small_things_with_void_are_told_by_the_other_masks(tmp_path: Path) -> None:
    """The borders of a small thing are more than itself; a folder of black and white has a few pixels of 1 by noise."""
    save_levels(tmp_path / "small.png", labels_with_void(20, 5))
    with pytest.raises(
        InputError, match=r"small\.png: the mask's values are 0, 1 and 255, either labels 0 and 1 with void or"
    ):
        read_mask(tmp_path / "small.png", orient=False, invert=False)
    save_levels(tmp_path / "large.png", labels_with_void(20, 90))
    assert read_mask(tmp_path / "small.png", orient=False, invert=False).sum() == 5
    save_levels(tmp_path / "large.png", labels_with_void(150))
    save_levels(tmp_path / "small.png", labels_with_void(150, 1))
    assert read_mask(tmp_path / "small.png", orient=False, invert=False).sum() == 150


def test_labels_of_several_things_with_void_are_named(tmp_path: Path) -> None:
    save_levels(tmp_path / "m.png", labels_with_void(20, 30, 30))
    with pytest.raises(
        InputError, match=r"m\.png: the mask's values are 0, 1, 2 and 255, labels of several things and"
    ):
        read_mask(tmp_path / "m.png", orient=False, invert=False)


@pytest.mark.parametrize(
    "levels",
    [
        labels_with_void(100, 20, 20),  # soft edges that begin low
        np.where(labels_with_void(20, 60) == 1, 9, labels_with_void(20, 60)).astype(np.uint8),
        np.where(labels_with_void(20, 60) == 1, 90, labels_with_void(20, 60)).astype(np.uint8),
        np.where(labels_with_void(20, 60) == 255, 200, labels_with_void(20, 60)).astype(np.uint8),
    ],
)
def test_black_and_white_with_dark_grey_is_read_as_it_was(levels: np.ndarray, tmp_path: Path) -> None:
    save_levels(tmp_path / "m.png", levels)
    assert (read_mask(tmp_path / "m.png", orient=False, invert=False)[:, :, 0] == (levels >= 128)).all()

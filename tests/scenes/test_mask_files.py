# SPDX-License-Identifier: Apache-2.0
"""The files of masks: their names, their sizes, and what is said of those that do not fit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tiny import HEIGHT, VIEWS, WIDTH, write_scene

from clsplat.config.masks import MaskUse
from clsplat.errors import InputError
from clsplat.images.writing import write_image
from clsplat.scenes.masks import find_masks, read_mask
from clsplat.scenes.scene import load_scene

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

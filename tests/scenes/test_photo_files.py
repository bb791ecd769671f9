# SPDX-License-Identifier: Apache-2.0
"""Pictures under other names than a data set lists, in other folders, missing; and lists of held-out ones."""

from __future__ import annotations

import unicodedata
from pathlib import Path, PurePath

import numpy as np
import pytest
from calls import only, refuses
from ring import COUNT, HEIGHT, NAMES, WIDTH, level, matrix_of, poses, write_colmap, write_pictures, write_transforms
from systems import posix

from clsplat.config.depth import DepthUse
from clsplat.config.masks import MaskUse
from clsplat.scenes.depth_sources import with_depths
from clsplat.scenes.loading import load_scene
from clsplat.scenes.photo_names import match, nearest
from clsplat.scenes.readers.colmap import read_cameras
from clsplat.scenes.readers.transforms import read_poses, read_transforms
from clsplat.scenes.scene import Scene


def assert_each_has_its_picture(scene: Scene, skipped: tuple[int, ...] = ()) -> None:
    """The cameras are in the order of the ring, and see the picture that was taken there."""
    indices = [index for index in range(COUNT) if index not in skipped]
    assert len(scene.views) == len(indices)
    for view in scene.views:
        east, _, south = view.camera.position
        index = round(np.arctan2(east, -south) / (2 * np.pi) * COUNT) % COUNT
        assert view.load()[0, 0, 0] == pytest.approx(level(index), abs=1e-6), view.name
        indices.remove(index)
    assert indices == []


def raw(name: str, encoding: str) -> str:
    """The name as a file in another encoding than UTF-8 is read."""
    return name.encode(encoding).decode("utf-8", "surrogateescape")


ACCENTS = [f"Küche {index:02}é.jpg".replace("jpg", "png") for index in range(COUNT)]
LOOSE = {
    "case": (NAMES, [name.upper() for name in NAMES], "20 by case (view00.png is VIEW00.PNG)"),
    "case of the extension": ([n.replace("png", "PNG") for n in NAMES], NAMES, "20 by case"),
    "no extension": ([n[:-4] for n in NAMES], NAMES, "20 by extension (view00 is view00.png)"),
    "dots in a label": ([f"a.{n[:-4]}.v1" for n in NAMES], [f"a.{n[:-4]}.v1.png" for n in NAMES], "20 by extension"),
    "before they were converted": ([n.replace("png", "HEIC") for n in NAMES], NAMES, "20 by extension"),
    "another type": ([n.replace("png", "tiff") for n in NAMES], NAMES, "20 by extension"),
    "backslashes": ([f"cam1\\{n}" for n in NAMES], [f"cam1/{n}" for n in NAMES], "20 by slashes"),
    "a drive": ([f"D:\\job 1\\photos\\{n}" for n in NAMES], NAMES, "20 by folder (job 1/photos/view00.png is view00"),
    "an absolute path": ([f"/home/bob/set/images/{n}" for n in NAMES], NAMES, "20 by folder"),
    "a folder more": ([f"images/{n}" for n in NAMES], NAMES, "20 by folder (images/view00.png is view00.png)"),
    "a folder less": (NAMES, [f"left/{n}" for n in NAMES], "20 by folder (view00.png is left/view00.png)"),
    "two cameras": (
        [f"rig\\cam{i % 2}\\{i // 2:04}.JPG" for i in range(COUNT)],
        [f"cam{i % 2}/{i // 2:04}.png" for i in range(COUNT)],
        "20 by folder and extension",
    ),
    "macOS": (ACCENTS, [unicodedata.normalize("NFD", name) for name in ACCENTS], "20 by slashes or Unicode form"),
    "Windows, western": ([raw(name, "cp1252") for name in ACCENTS], ACCENTS, "20 by encoding"),
    "Windows, Chinese": (
        [raw(f"厨房{index:02}.png", "gb18030") for index in range(COUNT)],
        [f"厨房{index:02}.png" for index in range(COUNT)],
        "20 by encoding (gb18030)",
    ),
    "Windows, Japanese": (
        [raw(f"台所カメラ{index:02}.png", "cp932") for index in range(COUNT)],
        [f"台所カメラ{index:02}.png" for index in range(COUNT)],
        "20 by encoding",
    ),
}


@pytest.mark.brings("RealityScan, Metashape, COLMAP on Windows", "pictures by other names", "found where one is meant")
@pytest.mark.parametrize("kind", LOOSE)
def test_pictures_are_found_under_other_names(kind: str, tmp_path: Path) -> None:
    listed, files, told = LOOSE[kind]
    scene = load_scene(write_colmap(tmp_path, listed, files))
    (warning,) = scene.warnings
    assert "20 listed picture(s) not found by name; files with similar names are used instead: " in warning
    assert told in warning
    assert_each_has_its_picture(scene)
    assert len(scene.test_views) == 3


@pytest.mark.parametrize("kind", ["case", "no extension", "backslashes", "an absolute path", "a folder less", "macOS"])
def test_those_of_a_transforms_json_too(kind: str, tmp_path: Path) -> None:
    listed, files, _ = LOOSE[kind]
    scene = load_scene(write_transforms(tmp_path, [f"images/{n}" if n[0] not in "/D" else n for n in listed],
                                        [f"images/{n}" for n in files]))  # fmt: skip
    assert_each_has_its_picture(scene)
    assert len(scene.warnings) == (kind not in ("no extension", "backslashes"))  # which it has always read


def test_a_name_that_could_be_two_pictures_is_missing(tmp_path: Path) -> None:
    """And is never taken for one of them."""
    write_colmap(tmp_path, ["VIEW00.png", *NAMES[1:]], ["View00.png", *NAMES[1:]])
    write_pictures(tmp_path / "images", ["view00.png"])
    (warning, unlisted) = load_scene(tmp_path).warnings
    assert "lists 1 image(s) that are missing: " in warning
    assert "does not list 2 image(s)" in unlisted
    refuses(r"VIEW00\.png; similar names are View00\.png; to train and evaluate", load_scene, tmp_path, missing="error")


def test_two_names_are_not_one_picture(tmp_path: Path) -> None:
    write_colmap(tmp_path, ["view00.jpg", "view00.tif", *NAMES[2:]], ["view00.png", "other.png", *NAMES[2:]])
    (warning, _) = load_scene(tmp_path).warnings
    assert "lists 2 image(s) that are missing" in warning


def test_masks_and_smaller_copies_are_no_pictures(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    (tmp_path / "images" / NAMES[3]).unlink()
    for folder in ("masks", "images/masks", "images_2", "images_4", "depth"):
        write_pictures(tmp_path / folder, [NAMES[3]])
    assert "lists 1 image(s) that are missing" in only(load_scene(tmp_path).warnings)


def test_one_deleted_picture_is_not_one_of_another_folder(tmp_path: Path) -> None:
    """Thumbnails, renders, other cameras of a rig, pictures that were moved away: equal names say nothing there."""
    write_colmap(tmp_path, [f"cam0/{name}" for name in NAMES])
    for folder in ("cam1", "thumbs", "cam0/rejected"):
        write_pictures(tmp_path / "images" / folder, [NAMES[3]])
    (tmp_path / "images" / "cam0" / NAMES[3]).unlink()
    (tmp_path / "images" / "cam0" / NAMES[8]).rename(tmp_path / "images" / "cam0" / NAMES[8].upper())
    scene = load_scene(tmp_path)
    assert_each_has_its_picture(scene, (3,))
    assert "lists 1 image(s) that are missing: " in scene.warnings[1]
    assert [view.name for view in scene.test_views] == [f"cam0/{NAMES[index]}" for index in (0, 8, 16)]


@pytest.mark.parametrize("split", ["train", "test"])
def test_one_of_blenders_pictures_is_not_the_other_splits(split: str, tmp_path: Path) -> None:
    for name in ("train", "test"):
        write_transforms(tmp_path, [f"./{name}/{each[:-4]}" for each in NAMES], [f"{name}/{each}" for each in NAMES],
                         name=f"transforms_{name}.json")  # fmt: skip
    (tmp_path / split / NAMES[3]).unlink()
    scene = load_scene(tmp_path)
    assert len(scene.views) == 2 * COUNT - 1
    assert f"{split}/{NAMES[3]}" not in {view.name for view in scene.views}


def test_names_in_another_case_keep_the_split_and_their_names(tmp_path: Path) -> None:
    """Renamed files are the same pictures of the same run."""
    write_colmap(tmp_path, [name.upper() for name in NAMES], NAMES)
    for index in (4, 9):
        (tmp_path / "images" / NAMES[index]).unlink()
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.test_views] == [NAMES[index].upper() for index in (0, 8, 16)]


@pytest.mark.parametrize(
    ("listed", "present", "found"),
    [
        (["a.png"], ["a.png", "A.png"], {"a.png": "a.png"}),  # exact before loose
        (["a.jpg"], ["a.png", "b/a.jpg"], {"a.jpg": "a.png"}),  # the extension before the folder
        (["x/b/a.jpg"], ["b/a.jpg", "c/a.jpg"], {"x/b/a.jpg": "b/a.jpg"}),  # the longest ending
        (["x/a.jpg"], ["b/a.jpg", "c/a.jpg"], {}),
        (["a.jpg", "a.JPG"], ["a.jpg"], {"a.jpg": "a.jpg"}),  # one that is taken is no other's
        (["", "a"], ["a"], {"a": "a"}),
        ([], ["a"], {}),
    ],
)
def test_the_steps_of_a_match(listed: list[str], present: list[str], found: dict[str, str]) -> None:
    assert match(listed, present).names == found


def test_the_nearest_name() -> None:
    assert nearest("images/DSC_0001.jpg", ["x/DSC_0010.jpg", "y/other.png"]) == "x/DSC_0010.jpg"
    assert nearest("a.jpg", ["completely different.png"]) == ""


@posix
def test_cameras_alone_have_legible_names(tmp_path: Path) -> None:
    write_colmap(tmp_path, [raw(name, "cp1252") for name in ACCENTS], ACCENTS)
    assert all(name.isprintable() for name in read_cameras(tmp_path))


# Missing pictures


@pytest.mark.brings("RealityScan, users who tidy up", "pictures that are listed and not there", "the others")
@pytest.mark.parametrize("kind", ["colmap", "transforms", "blender"])
def test_a_few_missing_pictures_are_left_out(kind: str, tmp_path: Path) -> None:
    if kind == "colmap":
        write_colmap(tmp_path)
    else:
        file = {"transforms": "transforms.json", "blender": "transforms_train.json"}[kind]
        write_transforms(tmp_path, w=None, h=None, name=file)
    before = load_scene(tmp_path)
    for index in (3, 8):
        (tmp_path / "images" / NAMES[index]).unlink()
    scene = load_scene(tmp_path)
    (warning,) = scene.warnings
    assert "lists 2 image(s) that are missing: " in warning
    assert NAMES[3] in warning
    assert warning.endswith("the other 18 are used")
    assert_each_has_its_picture(scene, (3, 8))
    split = {view.name: view.split for view in before.views}
    assert all(view.split == split[view.name] for view in scene.views)
    refuses("lists 2 image", load_scene, tmp_path, missing="error")


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_many_missing_pictures_are_an_error_that_says_what_to_give(kind: str, tmp_path: Path) -> None:
    write_colmap(tmp_path) if kind == "colmap" else write_transforms(tmp_path)
    for index in range(1, 8):
        (tmp_path / "images" / NAMES[index]).unlink()
    refuses(r"lists 7 image.*; to train and evaluate with the others, add --missing skip$", load_scene, tmp_path)
    scene = load_scene(tmp_path, missing="skip")
    assert_each_has_its_picture(scene, tuple(range(1, 8)))
    assert [Path(view.name).name for view in scene.test_views] == ["view00.png", "view08.png", "view16.png"]
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    write_pictures(tmp_path / "images", ["another.png"])
    said = refuses("lists 20 image", load_scene, tmp_path, missing="skip")
    assert "--missing" not in said, "which would not help"


def test_masks_and_depths_of_missing_pictures_are_passed_over(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    for folder in ("masks", "depths"):
        write_pictures(tmp_path / folder)
    (tmp_path / "images" / NAMES[3]).unlink()
    scene = load_scene(tmp_path, masks=MaskUse("ignore"))
    assert all(view.mask is not None and view.mask.path == tmp_path / "masks" / view.name for view in scene.views)
    deep = with_depths(scene, DepthUse("maps"))
    assert all(view.depth is not None for view in deep.train_views)
    write_pictures(tmp_path / "images", [NAMES[3]])
    write_pictures(tmp_path / "masks", ["other.png"])
    refuses("fit no photograph", load_scene, tmp_path, masks=MaskUse("ignore"))


# Other folders


@pytest.mark.brings("DL3DV, nerfstudio", "`images_4/` or another factor alone", "taken in place of `images/`")
@pytest.mark.parametrize("kind", ["colmap", "transforms"])
@pytest.mark.parametrize("factors", [(2,), (8,), (8, 4)])
def test_smaller_copies_are_taken_where_there_is_nothing_else(
    factors: tuple[int, ...], kind: str, tmp_path: Path
) -> None:
    write_colmap(tmp_path) if kind == "colmap" else write_transforms(tmp_path)
    for factor in factors:
        write_pictures(tmp_path / f"images_{factor}", NAMES, (WIDTH // factor, HEIGHT // factor))
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    (tmp_path / "images").rmdir()
    scene = load_scene(tmp_path)
    assert f"the pictures are read from {tmp_path / f'images_{min(factors)}'}" in only(scene.warnings)
    assert_each_has_its_picture(scene)
    assert scene.views[0].camera.width == WIDTH // min(factors)
    assert scene.views[0].camera.fx == pytest.approx(40 / min(factors))
    chosen = load_scene(tmp_path, images=f"images_{max(factors)}")
    assert chosen.views[0].camera.width == WIDTH // max(factors)


def test_those_in_sub_folders_too(tmp_path: Path) -> None:
    write_transforms(tmp_path, [f"images/cam{i % 2}/{i:02}.png" for i in range(COUNT)])
    (tmp_path / "images").rename(tmp_path / "images_4")
    scene = load_scene(tmp_path)
    assert_each_has_its_picture(scene)
    assert scene.views[0].name == "images/cam0/00.png"


def test_each_folder_has_a_smaller_copy_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice the folders take twice the work, counted in comparisons of paths: three times leaves room for sorting."""
    compared = 0

    def counted(one: PurePath, other: object) -> bool:
        nonlocal compared
        compared += 1
        return equal(one, other)

    equal = PurePath.__eq__
    counts = []
    for cameras in (20, 40):
        folder = tmp_path / str(cameras)
        listed, files = ([f"cam{index:02}{end}/view.png" for index in range(cameras)] for end in ("", "_2"))
        write_transforms(folder, listed, files, matrices=[matrix_of(poses()[0])] * cameras)
        compared = 0
        with monkeypatch.context() as patched:
            patched.setattr(PurePath, "__eq__", counted)
            with pytest.warns(UserWarning, match="are read from"):
                images = read_transforms(folder / "transforms.json").images
        assert [image.path for image in images] == [folder / file for file in files]
        counts.append(compared)
    assert 0 < counts[1] < 3 * counts[0]


@pytest.mark.brings("3DGS' convert.py", "`input/` in place of `images/`", "taken where there is no `images/`")
@pytest.mark.parametrize(
    ("images", "model"), [("input", "sparse/0"), ("rgb", "sparse"), (".", "."), ("frames", "colmap/sparse/0")]
)
def test_folders_of_other_names(images: str, model: str, tmp_path: Path) -> None:
    """RealityScan writes model and pictures into one."""
    scene = load_scene(write_colmap(tmp_path, images=images, model=model))
    assert_each_has_its_picture(scene)
    assert [text for text in scene.warnings if "the pictures are read from" in text] == scene.warnings
    assert len(scene.warnings) == 1


@pytest.mark.parametrize("given", ["sparse", "sparse/0"])
@pytest.mark.parametrize("images", ["images", "Images", "INPUT"])
def test_the_models_folder_may_be_given(given: str, images: str, tmp_path: Path) -> None:
    write_colmap(tmp_path, images=images)
    assert_each_has_its_picture(load_scene(tmp_path / given))


def test_sizes_that_are_not_told_are_those_of_the_larger_pictures(tmp_path: Path) -> None:
    write_transforms(tmp_path, w=None, h=None)
    before = load_scene(tmp_path).views[0].camera
    write_pictures(tmp_path / "images_2", NAMES, (WIDTH // 2, HEIGHT // 2))
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    camera = load_scene(tmp_path).views[0].camera
    assert (camera.width, camera.fx, camera.cx) == (before.width / 2, before.fx / 2, before.cx / 2)


@pytest.mark.parametrize("listed", ["/home/bob/set/images/{}", "../../data/images/{}", "C:\\set\\images\\{}"])
def test_cameras_alone_are_read_where_pictures_are_elsewhere(listed: str, tmp_path: Path) -> None:
    write_transforms(tmp_path, [listed.format(name) for name in NAMES], [f"images/{name}" for name in NAMES])
    plain = load_scene(tmp_path)
    assert_each_has_its_picture(plain)
    cameras = read_poses(tmp_path / "transforms.json")
    assert set(cameras) == {view.name for view in plain.views}


# Sizes


@pytest.mark.brings(
    "gsplat's users", "pictures resized by other factors across and down", "each axis by its own, with a warning"
)
@pytest.mark.parametrize(
    ("camera", "focal"),
    [
        (f"PINHOLE {WIDTH} {HEIGHT} 40 40 24 16", (40, 30)),
        (f"SIMPLE_PINHOLE {WIDTH} {HEIGHT} 40 24 16", (40, 30)),
        (f"SIMPLE_RADIAL {WIDTH} {HEIGHT} 40 24 16 0", (40, 30)),
    ],
)
def test_uneven_pictures(camera: str, focal: tuple[float, float], tmp_path: Path) -> None:
    write_colmap(tmp_path, camera=camera)
    write_pictures(tmp_path / "images", size=(WIDTH, 24))
    scene = load_scene(tmp_path)
    assert "has 1 times the width and 0.75 times the height of its camera" in only(scene.warnings)
    seen = scene.views[0].camera
    assert (seen.width, seen.height, seen.fx, seen.fy, seen.cx, seen.cy) == (WIDTH, 24, *focal, 24, 12)
    assert_each_has_its_picture(scene)


def test_a_lens_that_bends_stays_the_same_lens(tmp_path: Path) -> None:
    write_colmap(tmp_path, camera=f"SIMPLE_RADIAL {WIDTH} {HEIGHT} 40 24 16 -0.1")
    even = load_scene(tmp_path).views[0].lens
    write_pictures(tmp_path / "images", size=(WIDTH, 24))
    uneven = load_scene(tmp_path).views[0].lens
    rays = np.array([[0.3, 0.2, 1.0], [-0.4, 0.1, 1.0]])
    np.testing.assert_allclose(uneven.img_from_cam(rays), even.img_from_cam(rays) * [1, 0.75], rtol=1e-12)


@pytest.mark.parametrize("size", [(47, 32), (24, 17), (25, 16), (1000, 667)])
def test_rounded_sizes_are_even(size: tuple[int, int], tmp_path: Path) -> None:
    write_colmap(tmp_path)
    write_pictures(tmp_path / "images", NAMES, size)
    assert load_scene(tmp_path).warnings == []


# Lists of what is held out


@pytest.mark.brings("3DGS, hierarchical-3d-gaussians", "`test.txt` beside the model", "the split")
@pytest.mark.parametrize(
    "text",
    [
        "view03.png\nview10.png\n",
        "view10\r\n\r\nview03.PNG\r\n",
        "\ufeff# held out\n  images/view03.png \nview10.jpg",
        '"view03.png",\n"view10.png"\n',
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_list_of_held_out_pictures(text: str, encoding: str, tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "sparse" / "0" / "test.txt").write_bytes(text.encode(encoding))
    scene = load_scene(tmp_path)
    assert scene.warnings == []
    assert [view.name for view in scene.test_views] == ["view03.png", "view10.png"]


def test_a_list_beside_a_transforms_json(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    (tmp_path / "test.txt").write_text("view05.png\n")
    assert [view.name for view in load_scene(tmp_path).test_views] == ["images/view05.png"]
    write_transforms(tmp_path, test_filenames=["images/view07.png"])
    assert [view.name for view in load_scene(tmp_path).test_views] == ["images/view07.png"]


def test_a_list_of_others_is_told_and_not_used(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    path = tmp_path / "sparse" / "0" / "test.txt"
    path.write_text("notes\n")
    scene = load_scene(tmp_path)
    assert scene.warnings == [f"{path}: lists notes to hold out, but no picture has such a name; the list is not used"]
    assert [view.name for view in scene.test_views] == ["view00.png", "view08.png", "view16.png"]
    path.write_text("view02.png\nview99.png\n")
    scene = load_scene(tmp_path)
    told = f"{path}: lists view99.png to hold out, but no picture has such a name; these lines are ignored"
    assert scene.warnings == [told]
    assert [view.name for view in scene.test_views] == ["view02.png"]
    path.write_text("")
    assert len(load_scene(tmp_path).test_views) == 3
    path.write_text("\n".join(NAMES))
    refuses(r"test\.txt: holds out all 20 pictures", load_scene, tmp_path)


def test_a_list_of_what_is_missing_holds_out_the_rest(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    (tmp_path / "sparse" / "0" / "test.txt").write_text("view03.png\nview10.png\n")
    (tmp_path / "images" / "view03.png").unlink()
    assert [view.name for view in load_scene(tmp_path).test_views] == ["view10.png"]
    (tmp_path / "images" / "view10.png").unlink()
    scene = load_scene(tmp_path)
    assert scene.test_views == []
    assert scene.warnings[-1].endswith(
        "test.txt: all pictures that it holds out are missing; held-out quality will not be measured"
    )

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import codecs
import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from calls import refuses
from compare import similarity
from models import real_file
from needs import SCENES
from PIL import Image as Pillow
from systems import links, locked

from clsplat.camera import Camera
from clsplat.images.reading import companions, read_image
from clsplat.images.writing import write_image
from clsplat.scenes.folder_layouts import detect
from clsplat.scenes.loading import camera_bounds, load_scene
from clsplat.scenes.scene import spread

RNG = np.random.default_rng(2)
WIDTH, HEIGHT = 48, 32


def make_colmap(folder: Path, count: int = 9, camera: str = f"PINHOLE {WIDTH} {HEIGHT} 40 41 24 16") -> Path:
    """Cameras at (i, 0, 0) looking along z, as text; pictures of their own colour in images/, one in a sub-folder."""
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "images" / "sub").mkdir(parents=True)
    (folder / "sparse" / "0" / "cameras.txt").write_text(f"1 {camera}\n")
    lines = []
    for index in range(count):
        name = f"{index}.png" if index else "sub/0.png"
        lines.append(f"{index + 1} 1 0 0 0 {-index} 0 0 1 {name}\n\n")
        write_image(folder / "images" / name, np.full((HEIGHT, WIDTH, 3), index / 10, np.float32))
    (folder / "sparse" / "0" / "images.txt").write_text("".join(lines))
    (folder / "sparse" / "0" / "points3D.txt").write_text("1 0.5 0 4 255 0 51 0.1\n")
    return folder


def picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((HEIGHT, WIDTH, 3)).astype(np.float32)


def test_colmap(tmp_path: Path) -> None:
    scene = load_scene(make_colmap(tmp_path / "toy"))
    assert scene.name == "toy"
    assert scene.warnings == []
    assert [view.name for view in scene.views] == [*(f"{index}.png" for index in range(1, 9)), "sub/0.png"]
    assert [view.name for view in scene.test_views] == ["1.png", "sub/0.png"]
    assert len(scene.train_views) == 7
    np.testing.assert_array_equal(scene.points, [[0.5, 0, 4]])
    np.testing.assert_allclose(scene.point_colors, [[1, 0, 0.2]])
    assert scene.extent == pytest.approx(1.1 * 3)  # training cameras at 2 to 8
    view = scene.views[2]
    np.testing.assert_array_equal(view.camera.position, [3, 0, 0])
    image = view.load()
    assert (image.shape, image.dtype) == ((HEIGHT, WIDTH, 3), np.float32)
    np.testing.assert_allclose(image, 0.3, atol=2e-3)
    assert view.load(24, 16).shape == (16, 24, 3)


def test_split(tmp_path: Path) -> None:
    make_colmap(tmp_path)
    assert len(load_scene(tmp_path, test_every=0).test_views) == 0
    assert [view.name for view in load_scene(tmp_path, test_every=3).test_views] == ["1.png", "4.png", "7.png"]
    every_second = [view.name for view in load_scene(tmp_path, test_every=2, test_most=0).test_views]
    assert len(every_second) == 5
    assert [view.name for view in load_scene(tmp_path, test_every=2, test_most=5).test_views] == every_second
    few = [view.name for view in load_scene(tmp_path, test_every=2, test_most=3).test_views]
    assert few == [every_second[index] for index in (0, 1, 3)]
    assert [view.name for view in load_scene(tmp_path, test_every=1, test_most=2).test_views] == ["1.png", "5.png"]


def test_resolution(tmp_path: Path) -> None:
    make_colmap(tmp_path)
    camera = load_scene(tmp_path, resolution=24).views[0].camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (24, 16, 20, 20.5, 12, 8)
    assert load_scene(tmp_path, resolution=5000).views[0].camera.width == WIDTH  # never enlarged
    assert load_scene(tmp_path, resolution=24).views[0].load().shape == (16, 24, 3)


def test_large_pictures_are_worked_on_at_1600(tmp_path: Path) -> None:
    make_colmap(tmp_path, 1, "PINHOLE 3000 10 40 41 1500 5")
    write_image(tmp_path / "images" / "sub" / "0.png", np.zeros((10, 3000, 3), np.float32))
    camera = load_scene(tmp_path).views[0].camera
    assert (camera.width, camera.height) == (1600, 5)
    assert load_scene(tmp_path, resolution=2000).views[0].camera.width == 2000


def test_folders_of_smaller_pictures_stand_in_where_they_fit(tmp_path: Path) -> None:
    make_colmap(tmp_path)
    for factor in (2, 4):
        for path in sorted((tmp_path / "images").rglob("*.png")):
            smaller = tmp_path / f"images_{factor}" / path.relative_to(tmp_path / "images")
            smaller.parent.mkdir(parents=True, exist_ok=True)
            write_image(smaller, np.full((HEIGHT // factor, WIDTH // factor, 3), 1 / factor, np.float32))
    for resolution, folder in ((0, "images"), (24, "images_2"), (12, "images_4"), (13, "images"), (6, "images")):
        view = load_scene(tmp_path, resolution=resolution).views[0]
        assert view.path == tmp_path / folder / "1.png"
        assert view.load().shape == (view.camera.height, view.camera.width, 3)
    assert view.camera.resized(WIDTH, HEIGHT).fx == pytest.approx(40)
    view = load_scene(tmp_path, images="images_4").views[0]
    assert (view.camera.width, view.camera.fx, view.path.parent.name) == (12, 10, "images_4")
    refuses("images_16: no such folder", load_scene, tmp_path, images="images_16")


def test_pictures_of_another_scale_than_the_camera(tmp_path: Path) -> None:
    make_colmap(tmp_path, camera=f"PINHOLE {2 * WIDTH} {2 * HEIGHT} 80 82 48 32")
    camera = load_scene(tmp_path).views[0].camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (48, 32, 40, 41, 24, 16)


def test_pictures_of_another_size_are_refused(tmp_path: Path) -> None:
    make_colmap(tmp_path)
    write_image(tmp_path / "images" / "3.png", np.zeros((30, 70, 3), np.float32))
    refuses(r"3\.png: has 70x30 pixels, expected its camera's size, 48x32", load_scene, tmp_path)


def test_exif_orientation_is_left_alone_unless_only_the_turned_picture_fits(tmp_path: Path) -> None:
    make_colmap(tmp_path)
    path = tmp_path / "images" / "3.png"
    pixels = RNG.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    exif = Pillow.Exif()
    exif[0x112] = 6
    Pillow.fromarray(pixels).save(path, exif=exif)
    np.testing.assert_array_equal(load_scene(tmp_path).views[2].load(), read_image(path, orient=False))
    Pillow.fromarray(pixels.transpose(1, 0, 2)).save(path, exif=exif)
    np.testing.assert_array_equal(load_scene(tmp_path).views[2].load(), read_image(path, orient=True))


def test_missing_and_unlisted_pictures_are_named(tmp_path: Path) -> None:
    make_colmap(tmp_path)
    for name in ("extra.png", "sub/more.JPG"):
        shutil.copy(tmp_path / "images" / "1.png", tmp_path / "images" / name)
    (tmp_path / "images" / "Thumbs.db").touch()
    (tmp_path / "images" / ".hidden.png").touch()
    (warning,) = load_scene(tmp_path).warnings
    assert "does not list 2 image(s)" in warning
    assert str(tmp_path / "images" / "sub" / "more.JPG") in warning
    gone = [tmp_path / "images" / name for name in ("2.png", "sub/0.png")]
    for path in gone:
        path.unlink()
    said = refuses("lists 2 image", load_scene, tmp_path)
    assert all(str(path) in said for path in gone)


def test_of_many_missing_pictures_three_are_named(tmp_path: Path) -> None:
    make_colmap(tmp_path, 20)
    for index in range(2, 19):
        (tmp_path / "images" / f"{index}.png").unlink()
    said = refuses(r"lists 17 image\(s\) that are missing: .* and 14 more; ", load_scene, tmp_path)
    assert said.count("/images/") == 3
    assert said.endswith(
        f"3 others are in {tmp_path / 'images'}; to train and evaluate with the others, add --missing skip"
    )


def test_depths_and_normals_beside_the_pictures_are_silent(tmp_path: Path) -> None:
    """NeRF's synthetic scenes as they are published, and what others put beside their pictures."""
    pose = np.eye(4).tolist()
    for split in ("train", "test"):
        (tmp_path / split).mkdir()
        frames = [{"file_path": f"./{split}/r_{index}", "transform_matrix": pose} for index in range(30)]
        for index in range(30):
            write_image(tmp_path / split / f"r_{index}.png", picture(index + 100 * (split == "test")))
        (tmp_path / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    for index in range(30):
        for name in (f"r_{index}_depth_0001", f"r_{index}_normal_0001", f"mask_r_{index}", f"r_{index}.png"):
            shutil.copy(tmp_path / "test" / "r_0.png", tmp_path / "test" / f"{name}.png")
    assert load_scene(tmp_path).warnings == []
    for index in range(30, 70):
        shutil.copy(tmp_path / "test" / "r_0.png", tmp_path / "test" / f"r_{index}.png")
    (warning,) = load_scene(tmp_path).warnings
    assert "does not list 40 image(s) of its folder" in warning
    assert warning.endswith("r_32.png and 37 more")


SILENT = [
    *("masks/1.png", "depth_maps/x.png", "sub/normals/0.png", "1_mask.png", "1.normal.exr", "dynamic_mask_1.png"),
    "1.png.png",
]


@pytest.mark.parametrize("name", [*SILENT, "10.png", "1_2.png", "edge.png", "flowers/1.png"])
def test_which_pictures_go_with_others(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    pictures = [folder / "1.png", folder / "sub" / "0.png"]
    assert bool(companions([folder / name], pictures, folder)) == (name in SILENT)


def test_photos_in_a_folder_of_masks_are_photos_where_there_are_no_others(tmp_path: Path) -> None:
    photos = [tmp_path / "masks" / f"{index}.jpg" for index in range(3)]
    assert not companions(photos, photos, tmp_path)
    both = [*photos, *(tmp_path / "a" / f"{index}.jpg" for index in range(2))]
    assert companions(both, both, tmp_path) == set(photos[:2])


@links
def test_links_that_lead_nowhere_are_no_pictures(tmp_path: Path) -> None:
    make_colmap(tmp_path)
    (tmp_path / "images" / "extra.png").symlink_to(tmp_path / "gone.png")
    assert load_scene(tmp_path).warnings == []
    (tmp_path / "images" / "2.png").unlink()
    (tmp_path / "images" / "2.png").symlink_to(tmp_path / "gone.png")
    refuses(r"lists 1 image\(s\) that are missing: .*2\.png; 8 others are in .*images; ", load_scene, tmp_path)


def test_a_folder_that_cannot_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_colmap(tmp_path)
    locked(monkeypatch, tmp_path / "images" / "locked")
    refuses(r"images/locked: cannot be searched for pictures: permission is denied", load_scene, tmp_path)


def test_pictures_that_are_held_out_and_trained_on_are_told(tmp_path: Path) -> None:
    make_colmap(tmp_path)
    shutil.copy(tmp_path / "images" / "3.png", tmp_path / "images" / "2.png")
    assert load_scene(tmp_path).warnings == []  # both are trained on
    scene = load_scene(tmp_path)
    held_out, trained = scene.test_views[0], scene.train_views[0]
    shutil.copy(trained.path, held_out.path)
    (warning,) = load_scene(tmp_path).warnings
    assert warning.startswith("1 of the held-out pictures are also training pictures")
    assert f"{held_out.name} is {trained.name}" in warning
    assert load_scene(tmp_path, test_every=0).warnings == []


def test_webp_under_another_name_is_read_as_what_it_is(tmp_path: Path) -> None:
    make_colmap(tmp_path)
    path = tmp_path / "images" / "1.png"
    pixels = read_image(path)
    whole = np.rint(255 * pixels).astype(np.uint8)
    Pillow.fromarray(whole).save(path, "WEBP", lossless=True)
    scene = load_scene(tmp_path)
    assert scene.warnings == []
    scene.check_pictures()
    np.testing.assert_allclose(next(view for view in scene.views if view.name == "1.png").load(), pixels, atol=0.01)


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_a_mark_of_the_byte_order_is_passed_over(kind: str, tmp_path: Path) -> None:
    make_colmap(tmp_path)
    files = list((tmp_path / "sparse" / "0").glob("*.txt"))
    if kind == "transforms":
        frames = [{"file_path": f"images/{index}", "transform_matrix": np.eye(4).tolist()} for index in range(1, 8)]
        shutil.rmtree(tmp_path / "sparse")
        files = [tmp_path / "transforms.json"]
        files[0].write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
    before = [view.name for view in load_scene(tmp_path).views]
    assert files
    for path in files:
        path.write_bytes(codecs.BOM_UTF8 + path.read_bytes())
    assert [view.name for view in load_scene(tmp_path).views] == before


def test_undecodable_pictures_are_found_before_training(tmp_path: Path) -> None:
    make_colmap(tmp_path)
    path = tmp_path / "images" / "5.png"
    for data in (path.read_bytes()[:-20], b"no picture"):
        path.write_bytes(data)
        refuses(r"5\.png: does not decode", load_scene, tmp_path)


def test_a_distorted_camera_becomes_a_pinhole(tmp_path: Path) -> None:
    make_colmap(tmp_path, camera=f"SIMPLE_RADIAL {WIDTH} {HEIGHT} 40 24 16 -0.1")
    view = load_scene(tmp_path).views[0]
    assert not view.lens.is_pinhole
    assert view.camera.fx == 40
    assert view.load().shape == (view.camera.height, view.camera.width, 3)
    small = load_scene(tmp_path, resolution=20).views[0]
    assert small.load().shape == (small.camera.height, 20, 3)


def test_differing_cameras_sizes_and_kinds_in_one_scene(tmp_path: Path) -> None:
    make_colmap(tmp_path)
    model = tmp_path / "sparse" / "0"
    (model / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 40 41 24 16\n2 SIMPLE_PINHOLE 20 30 25 10 15\n")
    lines = (model / "images.txt").read_text().replace(" 1 3.png", " 2 3.exr").replace(" 1 4.png", " 1 4.png")
    (model / "images.txt").write_text(lines)
    (tmp_path / "images" / "3.png").unlink()
    write_image(tmp_path / "images" / "3.exr", np.full((30, 20, 3), 2.5, np.float32))
    write_image(tmp_path / "images" / "4.png", RNG.random((HEIGHT, WIDTH, 4)))
    views = {view.name: view for view in load_scene(tmp_path).views}
    assert views["3.exr"].camera.fx == 25
    np.testing.assert_array_equal(views["3.exr"].load(), np.full((30, 20, 3), 2.5, np.float32))
    assert views["4.png"].load().shape == (HEIGHT, WIDTH, 4)


def test_the_models_own_folder_finds_its_pictures(tmp_path: Path) -> None:
    make_colmap(tmp_path)
    assert len(load_scene(tmp_path / "sparse" / "0").views) == 9
    shutil.rmtree(tmp_path / "images")
    refuses(r"images: no such folder, expected the 9 images", load_scene, tmp_path)
    (tmp_path / "images").mkdir()
    refuses("no images found", load_scene, tmp_path)


def test_detect(tmp_path: Path) -> None:
    refuses("nothing: no such folder", detect, tmp_path / "nothing")
    refuses("no images found", detect, tmp_path)
    (tmp_path / "notes.txt").touch()
    refuses(r"notes\.txt: is a file", detect, tmp_path / "notes.txt")
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "a.jpg").touch()
    assert detect(tmp_path) == "photos"
    (tmp_path / "transforms.json").touch()
    assert detect(tmp_path) == detect(tmp_path / "transforms.json") == "transforms"
    (tmp_path / "colmap" / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "colmap" / "sparse" / "0" / "cameras.bin").touch()
    assert detect(tmp_path) == "transforms"
    (tmp_path / "transforms.json").unlink()
    assert detect(tmp_path) == "colmap"
    (tmp_path / "transforms_train.json").touch()
    assert detect(tmp_path) == "blender"


def test_photos_go_through_sfm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    write_image(photos / "a.png", np.zeros((HEIGHT, WIDTH, 3), np.float32))
    calls = []

    def reconstruct(images: Path, output: Path, **options: object) -> Path:
        calls.append((images, output, options["progress"]))
        warnings.warn("b.png could not be placed", stacklevel=1)
        return make_colmap(output)

    monkeypatch.setattr("clsplat.scenes.loading.reconstruct", reconstruct)
    scene = load_scene(photos)
    assert calls == [(photos, tmp_path / "photos_colmap", None)]
    assert len(scene.views) == 9
    assert scene.name == "photos"
    assert scene.warnings == ["b.png could not be placed"]
    load_scene(photos, work_dir=tmp_path / "work")
    assert calls[1][1] == tmp_path / "work"


def test_transforms_unlisted_and_bounds(tmp_path: Path) -> None:
    make_colmap(tmp_path / "pictures")
    shutil.move(tmp_path / "pictures" / "images", tmp_path / "images")
    pose = np.eye(4).tolist()
    frames = [{"file_path": f"images/{index}", "transform_matrix": pose} for index in range(1, 8)]
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames, "aabb_scale": 0.1}))
    scene = load_scene(tmp_path)
    assert scene.name == tmp_path.name
    assert [view.name for view in scene.test_views] == ["images/1.png"]
    assert scene.extent == 1  # all cameras in one place
    assert str(tmp_path / "images" / "8.png") in scene.warnings[0]
    assert scene.points.shape == (0, 3)
    side = 0.05 / 0.33
    np.testing.assert_allclose(scene.bounds, [[-side] * 3, [side, side, 0]])  # instant-ngp's, and ahead (z < 0) only
    assert len(load_scene(tmp_path / "transforms.json").views) == 7
    assert [view.name for view in load_scene(tmp_path, images="images").views] == [view.name for view in scene.views]
    refuses("photos: no such folder", load_scene, tmp_path, images="photos")


def ring(facing: float, count: int = 12) -> list[Camera]:
    """Cameras on a circle of radius 2 around (5, 0, 1), looking inward (1) or outward (-1)."""
    cameras = []
    for angle in np.arange(count) * 2 * np.pi / count:
        away = np.array([np.cos(angle), 0, np.sin(angle)])
        ahead, down = -facing * away, np.array([0, 1.0, 0])
        rotation = np.stack([np.cross(down, ahead), down, ahead])
        cameras.append(Camera(8, 8, 8, 8, 4, 4, rotation, -rotation @ (np.array([5, 0, 1]) + 2 * away)))
    return cameras


def test_bounds_lie_about_what_the_cameras_look_at() -> None:
    low, high = camera_bounds(ring(1))
    np.testing.assert_allclose((low + high) / 2, [5, 0, 1], atol=1e-6)
    np.testing.assert_allclose(high - low, 4, rtol=1e-6)
    low, high = camera_bounds(ring(-1))
    np.testing.assert_allclose(high - low, 12, rtol=1e-6)
    parallel = [Camera(8, 8, 8, 8, 4, 4, np.eye(3), np.array([-x, 0.0, 0])) for x in (0.0, 1, 2)]
    low, high = camera_bounds(parallel)
    assert np.isfinite([low, high]).all()
    assert low[2] < 1 < high[2]


@pytest.mark.needs("scenes")
@pytest.mark.parametrize(
    ("name", "views", "held_out", "points"),
    [
        ("fox", 50, 7, 13_560),
        ("banana", 15, 2, 7_426),
        ("sceaux_castle", 11, 2, 8_378),
        ("lego_blender_400", 100, 13, 0),
    ],
)
def test_real_scenes(name: str, views: int, held_out: int, points: int) -> None:
    scene = load_scene(SCENES / name)
    assert (len(scene.views), len(scene.test_views), len(scene.points)) == (views, held_out, points)
    assert scene.warnings == []
    image, camera = scene.views[0].load(), scene.views[0].camera
    assert image.shape == (camera.height, camera.width, 4 if name.startswith("lego") else 3)
    assert 0 <= image.min() < image.max() <= 1
    low, high = scene.bounds
    inside = ((scene.points > low) & (scene.points < high)).all(axis=1)
    assert inside.mean() > 0.8 if points else (high - low == 2.6).all()


@pytest.mark.needs("scenes")
def test_two_descriptions_of_the_fox_agree() -> None:
    """The distorted transforms.json by others and our undistorted COLMAP model of the same photos.

    Poses: the camera centres coincide after a similarity. Axes and undistortion: a point of one, projected by the
    other, finds the colour that it has in the first.
    """
    ours, theirs = load_scene(SCENES / "fox"), load_scene(SCENES / "fox_ngp_360x640")
    assert [Path(view.name).name for view in theirs.views] == [view.name for view in ours.views]
    centres = [np.stack([view.camera.position for view in scene.views]) for scene in (ours, theirs)]
    scale, rotation, translation = similarity(*centres)
    residual = np.linalg.norm(scale * centres[0] @ rotation.T + translation - centres[1], axis=1)
    assert np.median(residual) < 0.01 * theirs.extent

    model = pycolmap.Reconstruction(SCENES / "fox" / "sparse" / "0")
    by_name = {image.name: image for image in model.images.values()}
    differences, distorted = [], []
    for index in range(0, 50, 10):
        seen = [point.point3D_id for point in by_name[ours.views[index].name].points2D]
        points = np.stack([model.points3D[key].xyz for key in seen])
        colour = sample(ours.views[index].camera, ours.views[index].load(225), points)
        moved = scale * points @ rotation.T + translation
        differences.append(np.abs(colour - sample(theirs.views[index].camera, theirs.views[index].load(), moved)))
        distorted.append(
            np.abs(colour - sample(theirs.views[index].camera, read_image(theirs.views[index].path), moved))
        )
    assert np.concatenate(differences).mean() < 0.035
    assert np.concatenate(differences).mean() < 0.75 * np.concatenate(distorted).mean()


def sample(camera: Camera, image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Colours (N, 3) of the pixels that points (N, 3) fall on; the image may have another size than the camera."""
    camera = camera.resized(image.shape[1], image.shape[0])
    local = points @ camera.rotation.T + camera.translation
    pixels = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    x, y = np.clip(np.floor(pixels), 0, [image.shape[1] - 1, image.shape[0] - 1]).astype(int).T
    found: np.ndarray = image[y, x]
    return found


def test_a_cut_jpeg_is_found_before_training(tmp_path: Path) -> None:
    """Its header is whole, so that load_scene cannot know."""
    folder = tmp_path / "banana"
    for source in sorted(real_file("banana").rglob("*")):  # copied without the modes: the data may be read-only
        if source.is_file():
            target = folder / source.relative_to(real_file("banana"))
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(source.read_bytes())
    cut = sorted((folder / "images").iterdir())[8]
    data = cut.read_bytes()
    cut.unlink()
    cut.write_bytes(data[: len(data) // 2])
    scene = load_scene(folder)
    refuses(cut.name, scene.check_pictures)


def test_a_selection_is_spread_evenly() -> None:
    assert spread([], 8) == []
    assert spread(range(1), 8) == [0]
    assert spread(range(8), 8) == list(range(8))
    assert spread(range(15), 8) == [0, 2, 4, 6, 8, 10, 12, 14]
    assert spread(range(5), 2) == [0, 4]

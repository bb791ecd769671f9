# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import random
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from calls import only, refuses, warned, warnings_of
from needs import SCENES

from clsplat.errors import InputError
from clsplat.rotations import rotation_from_quaternion
from clsplat.scenes.readers.colmap import find_model, read_cameras, read_model

TRACK = "9 1 2 3 255 255 255 0.5 1 2"


def make_model(folder: Path, names: list[str] | None = None, model: str = "PINHOLE") -> pycolmap.Reconstruction:
    """A small model, written by pycolmap as binary and as text."""
    rng = np.random.default_rng(3)
    made = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, model, 40.0, 48, 32)
    made.add_camera_with_trivial_rig(camera)
    for index, name in enumerate(names or ["b/2 with blank.png", "a/1.png", "é.png"]):
        image = pycolmap.Image(name=name, camera_id=1, image_id=index + 1, keypoints=rng.random((4, 2)) * 32)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rng.normal(size=4)), rng.normal(size=3))
        pose.rotation.normalize()
        made.add_image_with_trivial_frame(image, pose)
    for _ in range(5):
        color = rng.integers(0, 256, 3).astype(np.uint8)
        track = pycolmap.Track([pycolmap.TrackElement(1, 0)]) if made.num_points3D() == 0 else pycolmap.Track()
        made.add_point3D(rng.normal(size=3), track, color)
    for kind in ("bin", "txt"):
        (folder / kind).mkdir(parents=True)
        getattr(made, {"bin": "write_binary", "txt": "write_text"}[kind])(folder / kind)
    return made


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_reads_what_pycolmap_wrote(tmp_path: Path, kind: str) -> None:
    made = make_model(tmp_path)
    model = read_model(tmp_path / kind)
    assert [image.name for image in model.images] == ["a/1.png", "b/2 with blank.png", "é.png"]
    by_name = {image.name: image for image in made.images.values()}
    for image in model.images:
        expected = by_name[image.name].cam_from_world().matrix()
        np.testing.assert_allclose(np.c_[image.rotation, image.translation], expected, atol=1e-12)
        assert (image.lens.model, image.lens.width, image.lens.height) == ("PINHOLE", 48, 32)
    points = [made.points3D[key] for key in made.points3D]
    assert {tuple(point) for point in model.points} == {tuple(point.xyz) for point in points}
    assert model.colors.dtype == np.float32
    rounded = {tuple(color) for color in np.rint(model.colors * 255).astype(int).tolist()}
    assert rounded == {tuple(point.color.tolist()) for point in points}


def test_binary_goes_before_text(tmp_path: Path) -> None:
    make_model(tmp_path)
    for file in (tmp_path / "txt").iterdir():
        shutil.copy(file, tmp_path / "bin")
    (tmp_path / "bin" / "images.txt").write_text("nonsense")
    assert len(read_model(tmp_path / "bin").images) == 3


def test_text_without_observations_and_points(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("# a comment\n1 SIMPLE_PINHOLE 8 6 10 4 3\n")
    (tmp_path / "images.txt").write_text("# two lines each\n1 1 0 0 0 0 0 0 1 a.png\n\n2 1.5 0 0 0 1 2 3 1 b.png\n")
    model = read_model(tmp_path)
    assert [image.name for image in model.images] == ["a.png", "b.png"]
    np.testing.assert_array_equal(model.images[1].translation, [1, 2, 3])
    np.testing.assert_array_equal(model.images[1].rotation, np.eye(3))  # the quaternion 1.5 0 0 0 is normalised
    assert model.points.shape == model.colors.shape == (0, 3)


def test_text_without_the_lines_of_observations(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 8 6 10 4 3\n")
    pose = "1 0 0 0 0 0 0 1"
    seen = "1.5 2.5 -1 3.5 4.5 7 5.5 6.5 8 1.5 2.5 -1"  # of 12 words, as the line of a picture whose name has blanks
    lines = [
        f"1 {pose} 1.png",
        f"2 {pose} 2 and 3.png",
        f"3 {pose} 004",
        seen,
        f"4 {pose} 5.png",
        "",
        f"5 {pose} 6.png",
    ]
    (tmp_path / "images.txt").write_text("\n".join(lines))
    expected = ["004", "1.png", "2 and 3.png", "5.png", "6.png"]
    assert [image.name for image in read_model(tmp_path).images] == expected
    assert list(read_cameras(tmp_path)) == expected
    (tmp_path / "images.txt").write_text("\n".join([*lines[:4], f"4 {pose}"]))
    refuses(r"images\.txt: line 5 does not read as IMAGE_ID QW", read_model, tmp_path)
    (tmp_path / "images.txt").write_text("\n".join([*lines[:3], seen[:-4], lines[4]]))
    refuses(r"images\.txt: line 4 does not read as repeated X Y POINT3D_ID, or", read_model, tmp_path)


@pytest.mark.parametrize(("stem", "kept"), [("images", -2), ("points3D", -1)])
def test_text_that_is_cut_at_the_end_of_a_line_is_told(tmp_path: Path, stem: str, kept: int) -> None:
    make_model(tmp_path)
    path = tmp_path / "txt" / f"{stem}.txt"
    assert warnings_of(lambda: read_model(tmp_path / "txt")) == []
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("\ufeff" + "".join(lines[:kept]), "utf-8")
    counts = {"images": (3, 2), "points3D": (5, 4)}[stem]
    told = f"{path}: its header announces {counts[0]} records, only {counts[1]} are read; was it cut off or edited?"
    assert warnings_of(lambda: read_model(tmp_path / "txt")) == [told]
    if stem == "images":
        warned("its header announces 3 records, only 2 are read", read_cameras, tmp_path / "txt")


def test_text_that_was_edited_beside_a_binary_file_is_told(tmp_path: Path) -> None:
    make_model(tmp_path)
    folder = tmp_path / "bin"
    for file in (tmp_path / "txt").iterdir():
        shutil.copy(file, folder)
    for file in folder.iterdir():
        os.utime(file, (1000, 1000))
    os.utime(folder / "images.txt", (1030, 1030))  # a slow disk
    assert warnings_of(lambda: read_model(folder)) == []
    for stem in ("images", "points3D"):
        os.utime(folder / f"{stem}.txt", (2000, 2000))
    read, newer = "images.bin, points3D.bin", "images.txt, points3D.txt"
    told = f"{folder}: {read} is read, and the newer {newer} is not; remove the outdated one"
    assert warnings_of(lambda: read_model(folder)) == [told]


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_every_truncation_of_a_binary_file_is_found(tmp_path: Path, stem: str) -> None:
    make_model(tmp_path)
    path = tmp_path / "bin" / f"{stem}.bin"
    whole = path.read_bytes()
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        refuses(rf"{stem}\.bin: truncated or corrupt: ", read_model, tmp_path / "bin")
    path.write_bytes(whole + b"\0")
    refuses(rf"{stem}\.bin: truncated or corrupt: 1 bytes follow", read_model, tmp_path / "bin")


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_flipped_bytes_are_read_or_refused_but_never_crash(tmp_path: Path, stem: str) -> None:
    make_model(tmp_path)
    path = tmp_path / "bin" / f"{stem}.bin"
    whole = path.read_bytes()
    chance = random.Random(5)
    refused = []
    for _ in range(600):
        damaged = bytearray(whole)
        damaged[chance.randrange(len(whole))] ^= chance.randrange(1, 256)
        path.write_bytes(damaged)
        try:
            read_model(tmp_path / "bin")  # a flip in a coordinate may well pass
        except InputError as error:
            refused.append(str(error))
    assert all(str(tmp_path) in message and "\n" not in message for message in refused)
    assert len(refused) > 40


@pytest.mark.parametrize(
    ("stem", "cut", "told"),
    [
        ("images", lambda lines: [*lines[:-2], lines[-2][:30]], r"line \d+ does not read as IMAGE_ID QW"),
        ("points3D", lambda _: [TRACK, f"{TRACK} 3"], "line 2 does not read as POINT3D_ID"),
    ],
    ids=["an image", "a track"],
)
def test_truncated_text_is_refused_with_the_line(tmp_path: Path, stem: str, cut: Any, told: str) -> None:
    make_model(tmp_path)
    path = tmp_path / "txt" / f"{stem}.txt"
    path.write_text("\n".join(cut(path.read_text().splitlines())))
    refuses(rf"{stem}\.txt: {told}", read_model, tmp_path / "txt")


def test_unknown_camera_models_are_refused_by_name(tmp_path: Path) -> None:
    make_model(tmp_path)
    path = tmp_path / "bin" / "cameras.bin"
    data = bytearray(path.read_bytes())
    data[12] = 77
    path.write_bytes(data)
    refuses(r"cameras\.bin: camera 1 has the unknown camera model id 77", read_model, tmp_path / "bin")
    for line, told in [
        ("KALEIDOSCOPE 48 32 1 2 3", r"cameras\.txt: camera 1: unknown camera model KALEIDOSCOPE, expected one of"),
        ("EQUIRECTANGULAR 48 32 48 30", r"parameters are \[48.0, 30.0\], expected the size of a full panorama, 48 32"),
        ("PINHOLE 48 32 1 2 3", "PINHOLE has 3 parameters, expected 4"),
        ("PINHOLE 48 32 -1 2 3 4", "focal lengths above 0"),
    ]:
        (tmp_path / "txt" / "cameras.txt").write_text(f"1 {line}\n")
        refuses(told, read_model, tmp_path / "txt")


@pytest.mark.parametrize(
    ("images", "found"),
    [
        ("1 1 0 0 0 0 0 0 2 a.png\n\n", "camera 2, which is not in the model"),
        ("1 1 0 0 0 0 0 0 1 ../..\n\n", "expected a path inside"),
        ("1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 0 1 a.png\n\n", "a.png occurs twice"),
        ("1 0 0 0 0 0 0 0 1 a.png\n\n", "expected a unit quaternion"),
        ("1 1 0 0 0 nan 0 0 1 a.png\n\n", "expected a unit quaternion and a finite translation"),
        ("# nothing\n", "holds no images"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, images: str, found: str) -> None:
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 8 6 10 4 3\n")
    (tmp_path / "images.txt").write_text(images)
    refuses(found, read_model, tmp_path)


def test_find_model_prefers_the_largest_of_several(tmp_path: Path) -> None:
    make_model(tmp_path / "small", ["a.png"])
    make_model(tmp_path / "large")
    (tmp_path / "sparse").mkdir()
    shutil.copytree(tmp_path / "small" / "bin", tmp_path / "sparse" / "0")
    assert find_model(tmp_path) == tmp_path / "sparse" / "0"
    shutil.copytree(tmp_path / "large" / "txt", tmp_path / "sparse" / "1")
    assert find_model(tmp_path) == tmp_path / "sparse" / "1"
    assert find_model(tmp_path / "sparse") == tmp_path / "sparse" / "1"
    assert find_model(tmp_path / "sparse" / "0") == tmp_path / "sparse" / "0"
    assert find_model(tmp_path / "nothing") is None


def test_read_cameras(tmp_path: Path) -> None:
    make_model(tmp_path)
    cameras = read_cameras(tmp_path / "bin")
    assert list(cameras) == ["a/1.png", "b/2 with blank.png", "é.png"]
    camera = cameras["a/1.png"]
    assert (camera.width, camera.height, camera.fx, camera.cx, camera.cy) == (48, 32, 40, 24, 16)
    refuses("none: no COLMAP model", read_cameras, tmp_path / "none")
    (tmp_path / "bin" / "cameras.bin").unlink()
    refuses(r"has no cameras\.bin or cameras\.txt", read_cameras, tmp_path / "bin")


def test_an_absurd_lens_is_told_where_cameras_alone_are_read(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_RADIAL 48 32 40 24 16 5\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n")
    warned(r"a\.png distorts the picture implausibly \(SIMPLE_RADIAL 40 24 16 5\)", read_cameras, tmp_path)


def test_rotation_from_quaternion() -> None:
    quaternion = np.array([0.5, 0.1, -0.7, 0.3])
    quaternion /= np.linalg.norm(quaternion)
    xyzw = quaternion[[1, 2, 3, 0]]
    np.testing.assert_allclose(rotation_from_quaternion(quaternion), pycolmap.Rotation3d(xyzw).matrix(), atol=1e-15)


@pytest.mark.needs("scenes")
@pytest.mark.parametrize("name", ["fox", "sceaux_castle"])
def test_real_points_project_to_their_observations(name: str) -> None:
    """Our cameras, our points and COLMAP's keypoints, matched by COLMAP's tracks: the README's reprojection error."""
    folder = SCENES / name / "sparse" / "0"
    model = read_model(folder)
    cameras = read_cameras(SCENES / name)
    oracle = pycolmap.Reconstruction(folder)
    assert len(model.points) == oracle.num_points3D()
    where = {tuple(point): index for index, point in enumerate(model.points)}
    errors = []
    for image in oracle.images.values():
        camera = cameras[image.name]
        seen = [point for point in image.points2D if point.has_point3D()]
        index = [where[tuple(oracle.points3D[point.point3D_id].xyz)] for point in seen]
        local = model.points[index] @ camera.rotation.T + camera.translation
        pixels = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        assert (local[:, 2] > 0).all()
        errors.append(np.linalg.norm(pixels - [point.xy for point in seen], axis=1))
    per_image = np.array([error.mean() for error in errors])
    assert per_image.max() < 1
    assert np.concatenate(errors).mean() < 0.45


@pytest.mark.parametrize("name", ["../../etc/a.png", "/etc/a.png", "C:\\etc\\a.png", "..\\etc\\a.png", "./etc/./a.png"])
def test_a_name_from_elsewhere_stays_inside(name: str, tmp_path: Path) -> None:
    """It is looked for by its ending, and nothing outside is ever opened."""
    make_model(tmp_path)
    (tmp_path / "txt" / "images.txt").write_text(f"1 1 0 0 0 0 0 0 1 {name}\n\n")
    assert only(read_model(tmp_path / "txt").images).name in ("etc/a.png", "./etc/./a.png")

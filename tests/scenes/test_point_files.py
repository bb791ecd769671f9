# SPDX-License-Identifier: Apache-2.0
"""Clouds as other programs write them: where they lie, and what their colours count to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from calls import no_warnings, warned
from models import random_gaussians
from needs import missing
from ring import points, write_cloud, write_colmap, write_transforms
from test_scene import make_colmap

from clsplat.config.points import DEFAULT_MAX_FILE_POINTS, StartPoints
from clsplat.config.training import TrainConfig
from clsplat.scenes.analysis import sanity_checks
from clsplat.scenes.loading import load_scene
from clsplat.scenes.point_files import PLY_COLOUR_PROPERTIES, START_CLOUD_NAMES, read_cloud, read_point_cloud
from clsplat.scenes.readers.colmap import read_model, read_tracks
from clsplat.scenes.start.point_cloud import with_points

XYZ, RGB = points(60)
RGB[0], RGB[1] = 0, 255
NO_POINTS = (np.empty((0, 3)), np.empty((0, 3), np.uint8))


# Colours


@pytest.mark.brings("Metashape, CloudCompare, Open3D", "clouds' colours in 16 bits, in floats to 1, 255 or 65535",
                    "by their values")  # fmt: skip
@pytest.mark.parametrize(
    ("kind", "scale"),
    [("uchar", 255), ("ushort", 255), ("ushort", 65535), ("int", 255), ("int", 65535), ("float", 1), ("float", 255),
     ("float", 65535), ("double", 1), ("double", 255)],
)  # fmt: skip
@pytest.mark.parametrize("names", PLY_COLOUR_PROPERTIES)
def test_colours_count_by_their_values(kind: str, scale: int, names: tuple[str, ...], tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.ply", XYZ, RGB / 255 * scale, kind, names)
    xyz, colours = read_point_cloud(tmp_path / "a.ply")
    np.testing.assert_array_equal(xyz, XYZ.astype(np.float32))
    np.testing.assert_allclose(colours, RGB / 255, atol=1e-6)  # float32's rounding
    assert colours.dtype == np.float32
    write_transforms(tmp_path, ply_file_path="a.ply")
    np.testing.assert_array_equal(load_scene(tmp_path).point_colors, colours)


def test_a_dark_cloud_of_bytes_stays_dark(tmp_path: Path) -> None:
    dark = (RGB > 127).astype(np.uint8)
    write_cloud(tmp_path / "a.ply", XYZ, dark)
    np.testing.assert_allclose(read_point_cloud(tmp_path / "a.ply")[1], dark / 255, atol=1e-6)


def test_a_model_of_gaussians_has_the_colours_of_its_sh(tmp_path: Path) -> None:
    """Brush's init.ply is one."""
    model = random_gaussians(50, 2)
    model.save(tmp_path / "init.ply")
    cloud = read_cloud(tmp_path / "init.ply")
    np.testing.assert_array_equal(cloud.points, model.means)
    np.testing.assert_allclose(cloud.colors, np.clip(0.5 + 0.28209479 * model.sh[:, 0], 0, 1), atol=1e-6)


@pytest.mark.skipif(bool(missing("laspy")), reason=missing("laspy"))
@pytest.mark.parametrize("scale", [1, 257])
def test_those_of_las(scale: int, tmp_path: Path) -> None:
    import laspy

    las = laspy.create(point_format=2)
    las.x, las.y, las.z = XYZ.T
    las.red, las.green, las.blue = RGB.astype(np.uint16).T * scale
    las.write(tmp_path / "a.las")
    np.testing.assert_allclose(read_cloud(tmp_path / "a.las").colors, RGB / 255, atol=1e-6)


def write_points(folder: Path, lines: list[str]) -> Path:
    make_colmap(folder)
    (folder / "sparse" / "0" / "points3D.txt").write_text("\n".join(lines) + "\n")
    return folder / "sparse" / "0"


@pytest.mark.brings("exporters of COLMAP's text", "points without error and track, colours such as 128.0",
                    "points and colours")  # fmt: skip
@pytest.mark.parametrize(
    "lines",
    [
        ["1 1 2 3 255 0 51", "2 4 5 6 0 0 0"],
        ["1 1 2 3 255.0 0.0 51.0 0.7", "2 4 5 6 0.0 0.0 0.0 -1"],
        ["1 1 2 3 1.0 0 0.2 0.7 1 0", "2 4 5 6 0 0 0 0.1 1 1 2 5"],
        ["1 1 2 3 65535 0 13107", "2 4 5 6 0 0 0"],
    ],
)
def test_text_of_points(lines: list[str], tmp_path: Path) -> None:
    model = read_model(write_points(tmp_path, lines))
    np.testing.assert_array_equal(model.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(model.colors, [[1, 0, 0.2], [0, 0, 0]], atol=1e-6)


@pytest.mark.parametrize("name", ["points3d.txt", "Points3D.txt"])
def test_points_in_another_case(name: str, tmp_path: Path) -> None:
    """hierarchical-3d-gaussians writes points3d.bin."""
    folder = write_points(tmp_path, ["1 1 2 3 255 0 51"])
    (folder / "points3D.txt").rename(folder / name)
    assert len(read_model(folder).points) == 1


def test_points_without_tracks_are_seen_by_nothing(tmp_path: Path) -> None:
    tracks = read_tracks(write_points(tmp_path, ["1 1 2 3 255 0 51", "2 4 5 6 0 0 0 0.5 1 0"]))
    np.testing.assert_array_equal(tracks.errors, [0, 0.5])
    assert {name: rows.tolist() for name, rows in tracks.by_image.items()} == {"sub/0.png": [1]}


@pytest.mark.brings("scanners, filters", "points of NaN in PLY, LAS or points3D.txt", "left out and counted")
@pytest.mark.parametrize("kind", ["position", "colour"])
def test_points_that_are_no_numbers_are_left_out(kind: str, tmp_path: Path) -> None:
    xyz, rgb = XYZ.copy(), RGB / 255
    (xyz if kind == "position" else rgb)[5, 1] = np.nan
    write_cloud(tmp_path / "a.ply", xyz, rgb, "float")
    with pytest.warns(UserWarning, match="1 of 60 points have values that are not finite, and are left"):
        found, colours = read_point_cloud(tmp_path / "a.ply")
    np.testing.assert_array_equal(found, np.delete(XYZ, 5, axis=0).astype(np.float32))
    np.testing.assert_allclose(colours, np.delete(RGB, 5, axis=0) / 255, atol=1e-6)


def test_those_of_text_too_and_points_of_places_alone(tmp_path: Path) -> None:
    folder = write_points(tmp_path, ["1 1 2 3", "2 nan 5 6", "3 7 8 9"])
    model = warned("1 of 3 points have NaN values and are left out", read_model, folder)
    np.testing.assert_array_equal(model.points, [[1, 2, 3], [7, 8, 9]])
    assert (model.colors == model.colors[0]).all()


def test_highlights_do_not_make_a_cloud_black(tmp_path: Path) -> None:
    rgb = RGB / 255
    rgb[7, 0] = 3.7
    write_cloud(tmp_path / "a.ply", XYZ, rgb, "float")
    np.testing.assert_allclose(read_point_cloud(tmp_path / "a.ply")[1], np.clip(rgb, 0, 1), atol=1e-6)


@pytest.mark.parametrize(
    "names", [("Red", "Green", "Blue"), ("R", "G", "B"), ("scalar_Red", "scalar_Green", "scalar_Blue")]
)
def test_names_of_colours_in_any_case(names: tuple[str, ...], tmp_path: Path) -> None:
    write_cloud(tmp_path / "a.ply", XYZ, RGB, "uchar", names)
    np.testing.assert_allclose(read_point_cloud(tmp_path / "a.ply")[1], RGB / 255, atol=1e-6)


def test_a_named_cloud_in_another_case_is_found(tmp_path: Path) -> None:
    write_transforms(tmp_path, ply_file_path="sub\\Cloud.PLY")
    write_cloud(tmp_path / "sub" / "cloud.ply", XYZ, RGB)
    scene = load_scene(tmp_path)
    assert (len(scene.points), scene.warnings) == (60, [])


# Clouds beside a scene


@pytest.mark.brings("3DGS, nerfstudio, Brush", "clouds that no file names, such as `points3d.ply`",
                    "started from where the scene has no points, else named")  # fmt: skip
@pytest.mark.parametrize("name", [*START_CLOUD_NAMES, "POINTS3D.PLY"])
@pytest.mark.parametrize("kind", ["blender", "transforms", "colmap"])
def test_a_cloud_beside_a_scene_without_points_is_taken(kind: str, name: str, tmp_path: Path) -> None:
    if kind == "colmap":
        write_colmap(tmp_path, cloud=NO_POINTS)
    else:
        write_transforms(tmp_path, name="transforms_train.json" if kind == "blender" else "transforms.json")
    assert len(load_scene(tmp_path).points) == 0
    path = tmp_path / ("sparse/0" if kind == "colmap" else "") / name
    write_cloud(path, XYZ, RGB)
    scene = load_scene(tmp_path)
    np.testing.assert_array_equal(scene.points, XYZ.astype(np.float32))
    np.testing.assert_allclose(scene.point_colors, RGB / 255, atol=1e-6)
    assert f"{path}: its 60 points are used, as the scene itself has no points" in scene.warnings
    assert not [text for text in sanity_checks.of_scene(scene, "black") if "not used" in text]


def test_of_several_the_first_by_name_is_taken_and_the_others_told(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    write_cloud(tmp_path / "init.ply", XYZ[:50], RGB[:50])
    write_cloud(tmp_path / "points3d.ply", XYZ, RGB)
    scene = load_scene(tmp_path)
    assert len(scene.points) == 60
    (told,) = [text for text in sanity_checks.of_scene(scene, "black") if "--points" in text]
    assert told.startswith(f"{tmp_path / 'init.ply'} (50 points) is not used, as the scene itself has points")


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_one_beside_a_scene_with_points_is_told(kind: str, tmp_path: Path) -> None:
    if kind == "colmap":
        write_colmap(tmp_path)
    else:
        write_transforms(tmp_path, ply_file_path="given.ply")
        write_cloud(tmp_path / "given.ply", *points())
    plain = load_scene(tmp_path)
    write_cloud(tmp_path / "sparse_pc.ply", XYZ, RGB)
    scene = load_scene(tmp_path)
    np.testing.assert_array_equal(scene.points, plain.points)
    assert scene.warnings == []
    (told,) = [text for text in sanity_checks.of_scene(scene, "black") if "--points" in text]
    assert told.startswith(f"{tmp_path / 'sparse_pc.ply'} (60 points) is not used")
    chosen = with_points(scene, StartPoints(str(tmp_path / "sparse_pc.ply"), "replace", 100))
    assert not [text for text in sanity_checks.of_scene(chosen, "black") if "--points" in text], "it is now"


def test_the_copy_that_3dgs_makes_of_the_models_points_is_silent(tmp_path: Path) -> None:
    write_colmap(tmp_path)
    write_cloud(tmp_path / "sparse" / "0" / "points3D.ply", *points())
    scene = load_scene(tmp_path)
    assert not [text for text in sanity_checks.of_scene(scene, "black") if "--points" in text]
    assert scene.warnings == []


def test_a_cloud_that_is_named_and_missing_is_found_beside(tmp_path: Path) -> None:
    write_transforms(tmp_path, ply_file_path="gone.ply")
    write_cloud(tmp_path / "sparse_pc.ply", XYZ, RGB)
    scene = load_scene(tmp_path)
    assert len(scene.points) == 60
    assert "'ply_file_path' are missing" in scene.warnings[0]
    assert scene.warnings[0].endswith("using sparse_pc.ply")


def test_a_cloud_that_does_not_read_or_lies_elsewhere_is_told_and_passed_over(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    (tmp_path / "points3d.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 5\n")
    write_cloud(tmp_path / "sparse_pc.ply", XYZ + np.array([1e6, 0, 0]), RGB)
    scene = load_scene(tmp_path)
    assert len(scene.points) == 0
    assert len(scene.warnings) == 2
    assert "points3d.ply" in scene.warnings[0]
    assert "their distance from the cameras that see them is 1e+06" in scene.warnings[1]
    assert all(text.endswith("; it is not used") for text in scene.warnings)
    assert not [text for text in sanity_checks.of_scene(scene, "black") if "points of its own" in text]


# How many


def test_a_limit_is_of_the_scenes_own_points_too(tmp_path: Path) -> None:
    scene = load_scene(write_colmap(tmp_path, cloud=points(3000)))
    assert len(with_points(scene, TrainConfig().start_points).points) == 3000
    thinned = with_points(scene, TrainConfig(points_limit=500).start_points)
    assert 400 < len(thinned.points) <= 500
    assert with_points(scene, TrainConfig(points_limit=3000).start_points).points is scene.points
    assert TrainConfig(points="a.ply").start_points.limit == DEFAULT_MAX_FILE_POINTS
    assert TrainConfig(points="a.ply", points_limit=7).start_points.limit == 7


def test_very_many_points_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(write_colmap(tmp_path))
    monkeypatch.setattr(sanity_checks, "MANY_START_POINTS", 399)
    (told,) = [text for text in sanity_checks.of_scene(scene, "black") if "--points-limit" in text]
    assert told.startswith("each of 400 initial points becomes a Gaussian")
    monkeypatch.setattr(sanity_checks, "MANY_START_POINTS", 400)
    with no_warnings():
        assert not [text for text in sanity_checks.of_scene(scene, "black") if "--points-limit" in text]

# SPDX-License-Identifier: Apache-2.0
"""Known depths: what COLMAP's tracks and depth maps say of a view's pixels, and which of them are refused."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calls import refuses, warned
from depths import add_maps, add_tracks, depth_of
from models import real_file
from pictures import write_pixels
from tiny import HEIGHT, WIDTH, cameras, write_scene

from clsplat.config.depth import DepthUse
from clsplat.config.training import TrainConfig
from clsplat.errors import InputError
from clsplat.images.depth_maps import map_header, read_map
from clsplat.scenes.dataset import Lens
from clsplat.scenes.depth_sources import KnownDepth, with_depths
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers.colmap import read_tracks
from clsplat.scenes.scene import Scene

POINTS, MAPS, RELATIVE = DepthUse("points"), DepthUse("maps"), DepthUse("maps", "relative")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene")


def planes(scene: Scene, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Nearness and weight (H, W) of view `index` at its own size."""
    view = scene.views[index]
    pixels, nearness, weights = view.depth.at(view.camera, view.lens)
    found = np.zeros((2, view.camera.height * view.camera.width))
    found[0][pixels], found[1][pixels] = nearness, weights
    return found[0].reshape(view.camera.height, -1), found[1].reshape(view.camera.height, -1)


def test_tracks_say_which_points_a_photograph_shows(folder: Path) -> None:
    add_tracks(folder)
    scene = with_depths(load_scene(folder), POINTS)
    tracks = read_tracks(folder / "sparse" / "0")
    assert tracks.points.shape == (40, 3)
    assert [view.name for view in scene.views if view.depth is None] == [view.name for view in scene.test_views]
    for index, view in enumerate(scene.views):
        assert tracks.by_image[view.name].tolist() == list(range(index % 2, 40, 2))
        if view.split == "test":
            continue
        nearness, weights = planes(scene, index)
        rows, columns = np.nonzero(weights)
        assert 10 < len(rows) <= 20
        np.testing.assert_allclose(weights[rows, columns], 1 / 1.25)  # an error of half a pixel
        camera = cameras()[index]
        local = tracks.points[tracks.by_image[view.name]] @ camera.rotation.T + camera.translation
        x, y = (
            np.floor(50 * local[:, k] / local[:, 2] + half).astype(int) for k, half in ((0, WIDTH / 2), (1, HEIGHT / 2))
        )
        for row, column in zip(rows, columns, strict=True):
            here = local[(x == column) & (y == row), 2]
            assert nearness[row, column] == pytest.approx(1 / here.min(), rel=1e-6), "of several the nearest"


def test_tracks_of_binary_files_are_those_of_text(folder: Path) -> None:
    add_tracks(folder)
    model = folder / "sparse" / "0"
    text = read_tracks(model)
    record = b""
    for row, (point, error) in enumerate(zip(text.points, text.errors, strict=True)):
        seen = [int(name[:2]) + 1 for name, rows in text.by_image.items() if row in rows]
        record += struct.pack("<Q3d3BdQ", row + 1, *point, 1, 2, 3, error, len(seen))
        record += b"".join(struct.pack("<2I", image, 7) for image in [*seen, seen[0]][: len(seen)])
    (model / "points3D.bin").write_bytes(struct.pack("<Q", len(text.points)) + record)
    (model / "points3D.txt").unlink()
    binary = read_tracks(model)
    np.testing.assert_array_equal(binary.points, text.points)
    np.testing.assert_array_equal(binary.errors, text.errors)
    assert {name: rows.tolist() for name, rows in binary.by_image.items()} == {
        name: rows.tolist() for name, rows in text.by_image.items()
    }
    (model / "points3D.bin").write_bytes(struct.pack("<Q", len(text.points)) + record[:-3])
    refuses(r"points3D\.bin: truncated or corrupt", read_tracks, model)


def test_tracks_of_a_real_model_are_pycolmap_s() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = real_file("fox") / "sparse" / "0"
    theirs, ours = pycolmap.Reconstruction(str(model)), read_tracks(model)
    for image in theirs.images.values():
        seen = {point.point3D_id for point in image.points2D if point.has_point3D()}
        places = np.array(sorted(theirs.points3D[key].xyz.tolist() for key in seen))
        mine = np.array(sorted(ours.points[ours.by_image[image.name]].tolist()))
        np.testing.assert_array_equal(mine, places)


@pytest.mark.parametrize("kind", [".png", ".exr", ".npy"])
@pytest.mark.parametrize("name", ["depths", "depth"])
def test_maps_beside_the_photographs(folder: Path, kind: str, name: str) -> None:
    add_maps(folder, kind, name)
    scene = with_depths(load_scene(folder), MAPS)
    for index in (1, 3):
        nearness, weights = planes(scene, index)
        wanted = depth_of(index)
        np.testing.assert_array_equal(weights, wanted > 0)
        # a thousandth in PNG, half a float in the other two
        np.testing.assert_allclose(nearness[wanted > 0], 1 / wanted[wanted > 0], rtol=2e-4 if kind == ".png" else 1e-6)


def test_a_map_of_another_size_is_sampled_and_never_blended(folder: Path) -> None:
    (folder / "depths").mkdir()
    small = np.zeros((HEIGHT // 4, WIDTH // 4), np.uint16)
    small[:, 3:], small[:, 5:], small[:, 7:] = 2000, 4000, 65535
    for index in range(len(cameras())):
        write_pixels(folder / "depths" / f"{index:02d}.png.png", small[:, :, None])
    scene = with_depths(load_scene(folder), MAPS)
    nearness, weights = planes(scene, 2)
    assert set(np.unique(nearness)) == {0.0, 0.25, 0.5}, "0 and 65535 are unknown"
    assert (weights[:, 12:28] == 1).all()
    assert weights.sum() == 16 * HEIGHT
    half = scene.views[2].camera.resized(WIDTH // 2, HEIGHT // 2)
    pixels, values, _ = KnownDepth(*nothing(), folder / "depths" / "02.png.png", 0.5e-3, whole=True).at(
        half, scene.views[2].lens
    )
    assert set(values) == {np.float32(0.5), np.float32(1.0)}
    assert len(pixels) == 8 * HEIGHT // 2


def nothing() -> tuple[np.ndarray, np.ndarray]:
    return np.empty((0, 3)), np.empty(0)


def test_a_map_is_undistorted_with_its_photograph(tmp_path: Path) -> None:
    """The pixel of the pinhole picture has the value of where the lens shows its ray."""
    lens = Lens("SIMPLE_RADIAL", 120, 80, (90.0, 60.0, 40.0, 0.15))
    columns = np.arange(120, dtype=np.float32)[None, :] + np.zeros((80, 1), np.float32)
    np.save(tmp_path / "map.npy", columns + 1)
    camera = lens.pinhole(np.eye(3), np.zeros(3))
    pixels, nearness, _ = KnownDepth(*nothing(), tmp_path / "map.npy").at(camera, lens)
    rows, places = pixels // camera.width, pixels % camera.width
    rays = np.stack(
        [(places + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy, np.ones(len(rows))], axis=1
    )
    np.testing.assert_allclose(1 / nearness - 1, np.floor(lens.img_from_cam(rays)[:, 0]), atol=1e-4)
    assert len(pixels) > 0.9 * camera.width * camera.height


def test_relative_maps_are_brought_to_scale(folder: Path) -> None:
    add_tracks(folder, error=0.0)
    (folder / "depths").mkdir()
    tracks = read_tracks(folder / "sparse" / "0")
    for index, camera in enumerate(cameras()):
        # the map has the points' nearness in other units
        local = tracks.points @ camera.rotation.T + camera.translation
        x, y, n = (
            50 * local[:, 0] / local[:, 2] + WIDTH / 2,
            50 * local[:, 1] / local[:, 2] + HEIGHT / 2,
            1 / local[:, 2],
        )
        values = np.full((HEIGHT, WIDTH), np.median(n), np.float32)
        for k in np.argsort(n):  # the nearest last
            if 0 <= x[k] < WIDTH and 0 <= y[k] < HEIGHT and k % 2 == index % 2:
                values[int(y[k]), int(x[k])] = n[k]
        np.save(folder / "depths" / f"{index:02d}.npy", (values - 0.1) / (0.05 + 0.001 * index))
    scene = with_depths(load_scene(folder), RELATIVE)
    for view in scene.train_views:
        index = int(view.name[:2])
        # float32 of the files
        assert view.depth.fit[0] == pytest.approx(0.05 + 0.001 * index, rel=1e-4)
        assert view.depth.fit[1] == pytest.approx(0.1, abs=1e-5)
    _, weights = planes(scene, 3)
    assert weights.all(), "known everywhere, and not at the points alone"
    for path in (folder / "depths").iterdir():
        np.save(path, np.zeros_like(np.load(path)))
    refuses("no relative depth map agrees with the points", with_depths, load_scene(folder), RELATIVE)


def test_a_scene_of_nerfstudio_names_its_maps(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "scene")
    add_maps(folder)
    frames = []
    for index, camera in enumerate(cameras()):
        (folder / "depths" / f"{index:02d}.png").rename(folder / "depths" / f"of_{index}.png")  # no photograph's name
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = camera.rotation.T @ np.diag([1.0, -1.0, -1.0]), camera.position
        paths = {"file_path": f"images/{index:02d}.png", "depth_file_path": f"depths/of_{index}.png"}
        frames.append({**paths, "transform_matrix": pose.tolist()})
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": 50.0, "fl_y": 50.0, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    path = folder / "transforms.json"
    path.write_text(json.dumps({**lens, "camera_model": "PINHOLE", "frames": frames}))
    scene = with_depths(load_scene(path), MAPS)
    nearness, weights = planes(scene, 1)
    np.testing.assert_allclose(nearness[weights > 0], 1 / depth_of(1)[depth_of(1) > 0], rtol=2e-4)
    with pytest.raises(InputError, match="needs to know which photographs show a point, expected a COLMAP model"):
        with_depths(replace(load_scene(path), source=tmp_path), POINTS)


def test_what_is_refused(folder: Path) -> None:
    scene = load_scene(folder)
    refuses(r"has no depth maps for --depth maps; expected depths/IMAGE\.png", with_depths, scene, MAPS)
    refuses("no point has a track", with_depths, scene, POINTS)
    add_maps(folder)
    maps = folder / "depths"
    (maps / "99.png").write_bytes((maps / "00.png").read_bytes())
    refuses(r"1 depth map\(s\) fit no photograph \(99\.png\)", with_depths, scene, MAPS)
    (maps / "99.png").unlink()
    (maps / "00_depth.png").write_bytes((maps / "00.png").read_bytes())
    refuses(r"is a second depth map of 00\.png, besides 00\.png", with_depths, scene, MAPS)
    (maps / "00_depth.png").unlink()
    write_pixels(maps / "03.png", np.ones((HEIGHT, WIDTH // 2, 1), np.uint16))
    refuses(r"03\.png: the depth map has 24x40 pixels, expected the aspect ratio", with_depths, scene, MAPS)
    (maps / "03.png").write_bytes(b"no picture")
    refuses(r"03\.png", with_depths, scene, MAPS)
    (maps / "03.png").unlink()
    with pytest.warns(UserWarning, match=r"no depths are known for 1 photograph\(s\) \(03\.png\)"):
        assert with_depths(scene, MAPS).views[3].depth is None
    refuses("--depth-maps relative", with_depths, scene, RELATIVE)
    refuses("no depth maps are used, expected --depth maps too", TrainConfig(depth_maps="relative").check)


def test_maps_in_which_nothing_is_known(folder: Path) -> None:
    add_maps(folder)
    for name, level in (("03", 0), ("04", 65535)):
        write_pixels(folder / "depths" / f"{name}.png", np.full((HEIGHT, WIDTH, 1), level, np.uint16))
    warned(r"no depths are known for 2 photograph\(s\) \(03\.png, 04\.png\)", with_depths, load_scene(folder), MAPS)


@pytest.mark.parametrize("array", [np.zeros((2, 3, 4)), np.array(["a"]), np.zeros((0, 5))])
def test_arrays_that_are_no_maps(tmp_path: Path, array: np.ndarray) -> None:
    np.save(tmp_path / "map.npy", array)
    refuses(r"map\.npy", map_header, tmp_path / "map.npy")
    (tmp_path / "map.npy").write_bytes(b"\x93NUMPY")
    refuses("cannot be read as NPY", read_map, tmp_path / "map.npy")


def test_depths_are_part_of_what_a_run_knows_of_its_scene(folder: Path) -> None:
    plain = load_scene(folder).digests
    add_maps(folder)
    first = with_depths(load_scene(folder), MAPS).digests
    assert first != plain
    assert with_depths(load_scene(folder), replace(MAPS, unit=2e-3)).digests != first
    write_pixels(folder / "depths" / "03.png", np.full((HEIGHT, WIDTH, 1), 9, np.uint16))
    changed = with_depths(load_scene(folder), MAPS).digests
    assert [name for name in first if changed[name] != first[name]] == ["03.png"]
    scene = with_depths(load_scene(folder), MAPS)
    assert with_depths(scene, MAPS) is scene

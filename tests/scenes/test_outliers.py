# SPDX-License-Identifier: Apache-2.0
"""Cameras and points far off the others: sizes are of the others, strays are named, other scenes keep their numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ring import COUNT, NAMES, centre_of, matrix_of, moved, points, poses, write_cloud, write_colmap, write_transforms

from clsplat.camera import Camera
from clsplat.config.points import StartPoints
from clsplat.config.training import TrainConfig
from clsplat.scenes.loading import load_scene
from clsplat.scenes.outliers import MAX_OUTLIER_CAMERA_FRACTION, OUTLIER_DISTANCE_RATIO, strays
from clsplat.scenes.scene import Scene
from clsplat.scenes.start.point_cloud import sky_points, with_points
from clsplat.shots.read import choose_shot
from clsplat.training.cameras.poses import Poses
from clsplat.viewer.pose import start_of


def spoilt(rows: dict[int, float]) -> list[tuple[np.ndarray, np.ndarray]]:
    """The ring's poses, some of them so many times as far from the origin."""
    return [moved(pose, centre_of(pose) * rows[index]) if index in rows else pose for index, pose in enumerate(poses())]


def without(folder: Path, rows: dict[int, float], model: str) -> Scene:
    """The scene without these pictures, with the others held out as they are with them."""
    kept = [index for index in range(COUNT) if index not in rows]
    held_out = [f"images/{NAMES[index]}" for index in kept if index % 8 == 0]
    if model == "transforms":
        listed = [f"images/{NAMES[index]}" for index in kept]
        matrices = [matrix_of(poses()[index]) for index in kept]
        return load_scene(write_transforms(folder, listed, matrices=matrices, test_filenames=held_out))
    cloud = points() if model == "colmap" else (np.empty((0, 3)), np.empty((0, 3), np.uint8))
    names = [NAMES[index] for index in kept]
    write_colmap(folder, names, posed=[poses()[index] for index in kept], cloud=cloud)
    (folder / "sparse" / "0" / "test.txt").write_text("\n".join(held_out))
    return load_scene(folder)


@pytest.mark.brings(
    "any structure from motion", "some poses far off the others", "sizes are of the others, strays named"
)
@pytest.mark.parametrize("model", ["colmap", "colmap without points", "transforms"])
@pytest.mark.parametrize("rows", [{5: 30.0}, {1: 2000.0, 13: 60.0}, {2: 1e6, 3: 1e6, 11: 1e3, 18: 40.0}])
def test_sizes_are_those_of_the_other_cameras(rows: dict[int, float], model: str, tmp_path: Path) -> None:
    if model == "transforms":
        write_transforms(tmp_path, matrices=[matrix_of(pose) for pose in spoilt(rows)])
    else:
        cloud = points() if model == "colmap" else (np.empty((0, 3)), np.empty((0, 3), np.uint8))
        write_colmap(tmp_path, posed=spoilt(rows), cloud=cloud)
    scene, plain = load_scene(tmp_path), without(tmp_path / "plain", rows, model)
    assert len(scene.views) == COUNT, "they are trained on all the same"
    assert scene.extent == plain.extent
    assert scene.near == plain.near
    np.testing.assert_array_equal(scene.origin, plain.origin)
    np.testing.assert_allclose(scene.bounds, plain.bounds, rtol=1e-12)  # sums of as many, in another order
    (warning,) = [text for text in scene.warnings if "times as far away" in text]
    assert f"{len(rows)} camera(s) are over 5 times as far away as the others" in warning
    assert NAMES[min(rows)] in warning
    assert not [text for text in plain.warnings if "times as far away" in text]


def test_a_far_scene_has_its_own_origin(tmp_path: Path) -> None:
    """A stray near the world's origin of a georeferenced scene is one, and the others' middle stays the origin."""
    far = np.array([4e5, 5e6, 100.0])
    posed = [moved(pose, centre_of(pose) + far) for pose in poses()]
    cloud = (points()[0] + far, points()[1])
    plain = load_scene(write_colmap(tmp_path / "plain", posed=posed, cloud=cloud))
    posed[5] = moved(posed[5], np.zeros(3))
    scene = load_scene(write_colmap(tmp_path, posed=posed, cloud=cloud))
    assert scene.stray_cameras == {NAMES[5]}
    assert np.linalg.norm(scene.origin - far) < 8
    assert scene.extent == pytest.approx(plain.extent, rel=0.1)  # a camera fewer


@pytest.mark.parametrize(
    "rows",
    [{}, {5: 3.0}, dict.fromkeys(range(6), 100.0), dict.fromkeys(range(0, COUNT, 2), 6.0)],
    ids=["none", "a bit apart", "three tenths", "two rings"],
)
def test_captures_have_none(rows: dict[int, float], tmp_path: Path) -> None:
    scene = load_scene(write_colmap(tmp_path, posed=spoilt(rows)))
    assert not scene.stray_cameras
    centres = np.stack([view.camera.position for view in scene.train_views])
    assert scene.extent == 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    assert not [text for text in scene.warnings if "times as far away" in text]


def test_a_tripod_and_a_walk_have_none() -> None:
    """Cameras that only turn, but for some; and a line, however long."""
    tripod = np.zeros((20, 3))
    tripod[:3] = [[1, 0, 0], [0, 1, 0], [0, 0, 2]]
    assert not strays(tripod, MAX_OUTLIER_CAMERA_FRACTION).any()
    jitter = tripod + np.random.default_rng(1).normal(0, 1e-3, tripod.shape)
    assert strays(jitter, MAX_OUTLIER_CAMERA_FRACTION).sum() == 3, (
        "without points there is nothing else to compare with"
    )
    assert not strays(jitter, MAX_OUTLIER_CAMERA_FRACTION, least=3.0).any(), "what they look at is further off"
    tripod[:3] = [[1e4, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert strays(tripod, MAX_OUTLIER_CAMERA_FRACTION, least=3.0).sum() == 1
    walk = np.linspace(0, 1e4, 50)[:, None] * [1.0, 0, 0]
    assert not strays(walk, MAX_OUTLIER_CAMERA_FRACTION).any()


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_of_few_cameras_none_is_a_stray(count: int) -> None:
    assert not strays(np.arange(3.0 * count).reshape(count, 3) ** 4, MAX_OUTLIER_CAMERA_FRACTION).any()


def test_a_chain_of_strays_hides_none() -> None:
    """Each 4 times as far as the one before it; the first is no further than a capture may be."""
    places = np.array([centre_of(pose) for pose in poses()])
    places[:4] *= np.array([4.0, 16, 64, 256])[:, None]
    assert np.flatnonzero(strays(places, MAX_OUTLIER_CAMERA_FRACTION)).tolist() == [1, 2, 3]


@pytest.mark.parametrize("shown", [True, False])
def test_another_room_is_no_stray(shown: bool, tmp_path: Path) -> None:
    """By its points; or without any as a group of cameras."""
    room = [moved(pose, centre_of(pose) / 4 + np.array([60.0, 0, 0])) for pose in poses()[::5]]
    posed = [*poses()[4:], *room]
    xyz, rgb = points()
    there = (np.concatenate([xyz, xyz[:100] / 4 + np.array([60.0, 0, 0])]), np.concatenate([rgb, rgb[:100]]))
    cloud = there if shown else (np.empty((0, 3)), np.empty((0, 3), np.uint8))
    scene = load_scene(write_colmap(tmp_path, posed=posed, cloud=cloud))
    assert not scene.stray_cameras
    assert scene.extent > 30


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_the_edge_of_the_rule(factor: float) -> None:
    places = np.array([centre_of(pose) for pose in poses()])
    middle = np.median(places[1:], axis=0)
    farthest = np.linalg.norm(places[1:] - middle, axis=1).max()
    places[0] = middle + np.array([1.0, 0, 0]) * OUTLIER_DISTANCE_RATIO * farthest * factor
    found = strays(places, MAX_OUTLIER_CAMERA_FRACTION, middle=middle)
    assert found.tolist() == [factor > 1, *[False] * (COUNT - 1)]


# Points


@pytest.mark.brings("any structure from motion", "some points far off the others", "left out and counted")
@pytest.mark.parametrize(("count", "distance"), [(1, 30.0), (3, 1e5), (4, 1e20)])
def test_stray_points_are_left_out(count: int, distance: float, tmp_path: Path) -> None:
    xyz, rgb = points()
    plain = load_scene(write_colmap(tmp_path / "plain", cloud=(xyz[count:], rgb[count:])))
    xyz = xyz.copy()
    xyz[:count] *= distance / np.linalg.norm(xyz[:count], axis=1, keepdims=True)
    for scene in (load_scene(write_colmap(tmp_path, cloud=(xyz, rgb))), load_ply(tmp_path / "nerfstudio", xyz, rgb)):
        np.testing.assert_allclose(scene.points, plain.points, rtol=1e-6)
        np.testing.assert_array_equal(scene.point_colors, plain.point_colors)
        (warning,) = scene.warnings
        assert f"{count} of 400 points lie over 5 times as far away as the others, such as " in warning
        assert warning.endswith("; they are left out")
    assert plain.warnings == []


def load_ply(folder: Path, xyz: np.ndarray, rgb: np.ndarray) -> Scene:
    write_transforms(folder, ply_file_path="sparse_pc.ply")
    write_cloud(folder / "sparse_pc.ply", xyz, rgb)
    return load_scene(folder)


def test_those_of_a_cloud_do_not_make_its_voxels_large(tmp_path: Path) -> None:
    """Of which there are a million along the longest side."""
    xyz, rgb = points(2000)
    xyz[0] = [1e9, 0, 0]
    write_cloud(tmp_path / "cloud.ply", xyz, rgb)
    scene = load_scene(write_colmap(tmp_path))
    with pytest.warns(UserWarning, match="1 of 2,000 points lie over 5 times as far away"):
        chosen = with_points(scene, StartPoints(str(tmp_path / "cloud.ply"), "replace", 500))
    assert 300 < len(chosen.points) <= 500


def test_a_sparse_tail_is_no_stray(tmp_path: Path) -> None:
    """Points of a background, each a bit further than the one before."""
    xyz, rgb = points()
    tail = np.geomspace(2, 1e3, 12)[:, None] * [1.0, 0, 0]
    scene = load_scene(write_colmap(tmp_path, cloud=(np.concatenate([xyz, tail]), np.resize(rgb, (412, 3)))))
    assert len(scene.points) == 412
    assert scene.warnings == []


# Wherever else cameras give a size or a start


def test_paths_of_cameras_go_without_strays(tmp_path: Path) -> None:
    plain = choose_shot(write_colmap(tmp_path / "plain", NAMES[1:], posed=poses()[1:]), path="turntable", count=8)
    shot = choose_shot(write_colmap(tmp_path, posed=spoilt({0: 100.0})), path="turntable", count=8)
    for ours, theirs in zip(shot.cameras, plain.cameras, strict=True):
        np.testing.assert_allclose(ours.position, theirs.position, rtol=1e-12)  # as above
    (warning,) = shot.warnings
    assert warning.startswith(f"{tmp_path}: the cameras of view00.png are over 5 times as far from the middle as")
    for path in ("spiral", "through"):
        reach = [np.linalg.norm(camera.position) for camera in choose_shot(tmp_path, path=path, count=8).cameras]
        assert max(reach) < 6


def test_the_viewer_starts_at_a_camera_among_the_others() -> None:
    cameras = [Camera(8, 8, 8, 8, 4, 4, *pose) for pose in spoilt({0: 100.0})]
    assert np.linalg.norm(start_of(cameras, np.empty((0, 3))).position) < 6


def test_a_sky_is_about_the_other_cameras(tmp_path: Path) -> None:
    scene = load_scene(write_colmap(tmp_path, posed=spoilt({3: 1000.0})))
    sky, _ = sky_points(scene, 100)
    middle = scene.spread[0]
    np.testing.assert_allclose(np.linalg.norm(sky - middle, axis=1), 10 * scene.extent, rtol=0.1)  # SKY_RADIUS


def test_poses_are_held_by_two_of_the_others(tmp_path: Path) -> None:
    scene = load_scene(write_colmap(tmp_path, posed=spoilt({1: 100.0, 5: 50.0})))
    held = Poses(replace(TrainConfig(), refine_poses=True), scene.train_views, scene.extent).held
    assert not {scene.train_views[index].name for index in held} & scene.stray_cameras
    ordinary = load_scene(write_colmap(tmp_path / "plain"))
    views = ordinary.train_views
    places = np.array([view.camera.position for view in views])
    farthest = int(np.linalg.norm(places - places[0], axis=1).argmax())
    assert Poses(replace(TrainConfig(), refine_poses=True), views, ordinary.extent).held == (0, farthest)

# SPDX-License-Identifier: Apache-2.0
"""Cameras that mean something else than the layout says: read right where that can be known, else named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import printed, warned, warnings_of
from ring import FOCAL, HEIGHT, WIDTH, matrix_of, points, poses, write_cloud, write_colmap, write_transforms
from scipy.spatial.transform import Rotation
from tiny import write_scene

from clsplat.cli.main import main
from clsplat.errors import InputError
from clsplat.scenes.dataset import Lens
from clsplat.scenes.loading import load_scene
from clsplat.scenes.readers.colmap import read_cameras
from clsplat.scenes.readers.transforms import read_poses

NO_POINTS = (np.empty((0, 3)), np.empty((0, 3), np.uint8))


# Intrinsics


@pytest.mark.brings("pixelSplat's data sets, exporters of parts", "`cx cy` (and `fl_x fl_y`) as parts of the picture",
                    "in pixels, with a warning")  # fmt: skip
@pytest.mark.parametrize(
    "keys",
    [
        {"cx": 0.5, "cy": 0.5},
        {"cx": 0.5, "cy": 0.5, "fl_x": FOCAL / WIDTH, "fl_y": FOCAL / HEIGHT},
        {"cx": 0.5, "cy": 0.5, "fl_x": None, "fl_y": None, "camera_angle_x": 2 * np.arctan(WIDTH / 2 / FOCAL)},
        {"cx": 0.5, "cy": 0.5, "fl_x": FOCAL / WIDTH, "fl_y": FOCAL / WIDTH},  # both by the width
        {"cx": 0.5, "cy": 0.5, "k1": 0.0, "camera_model": "OPENCV"},
    ],
)
def test_parts_of_the_picture_are_read_as_such(keys: dict[str, Any], tmp_path: Path) -> None:
    scene = load_scene(write_transforms(tmp_path, **keys))
    camera = scene.views[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
    (warning,) = scene.warnings
    assert "the principal point (cx cy) of images/view00.png, images/view01.png, " in warning
    assert "as fractions of the picture's width and height" in warning


def test_those_of_a_colmap_model_too(tmp_path: Path) -> None:
    write_colmap(tmp_path, camera=f"PINHOLE {WIDTH} {HEIGHT} {FOCAL / WIDTH} {FOCAL / HEIGHT} 0.5 0.5")
    camera = next(iter(warned("of camera 1 is given as fractions of the picture", read_cameras, tmp_path).values()))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"fl_x": 2.0, "fl_y": 2.0}, "and 17 more is 2 pixels for a picture of 48x32"),  # in millimetres
        ({"fl_x": 0.83, "fl_y": 0.83, "cx": None, "cy": None}, "is 0.83 pixels for a picture of 48x32"),
        ({"cx": 0.0, "cy": 0.0}, "is 0 0 in a picture of 48x32"),  # from the middle
        ({"cx": -0.4, "cy": 1.2}, "is -0.4 1.2 in"),
        ({"cx": 0.5}, "is 0.5 16 in a picture of 48x32"),  # a part, of one alone
        ({"fl_x": 10.0, "fl_y": 10.0, "cx": 6.0, "cy": 4.0}, "6 4, is the middle of a picture of 12x8 pixels"),
    ],
)  # fmt: skip
def test_intrinsics_that_no_lens_has_are_told(keys: dict[str, Any], words: str, tmp_path: Path) -> None:
    folder = write_transforms(tmp_path, **keys)
    assert any(words in text for text in load_scene(folder).warnings)
    assert any(words in text for text in warnings_of(lambda: read_poses(folder / "transforms.json")))


@pytest.mark.parametrize(
    "camera",
    [
        f"PINHOLE {WIDTH} {HEIGHT} 40 40 5 4",  # a part of a larger picture
        f"PINHOLE {WIDTH} {HEIGHT} 40 40 -20 16",
        f"OPENCV_FISHEYE {WIDTH} {HEIGHT} 12 12 24 16 0 0 0 0",  # 220 degrees
        f"PINHOLE {WIDTH} {HEIGHT} 4000 4000 24 16",
    ],
)
def test_odd_lenses_that_may_be_are_not_told(camera: str, tmp_path: Path) -> None:
    assert not [text for text in load_scene(write_colmap(tmp_path, camera=camera)).warnings if "pixels" in text]


@pytest.mark.brings("Metashape, nerfstudio", "fisheyes with `p1 p2`", "COLMAP's THIN_PRISM_FISHEYE")
@pytest.mark.parametrize(("p1", "p2"), [(0.01, 0.0), (0.0, -0.02), (0.003, 0.004)])
def test_tangential_terms_of_fisheyes_are_read(p1: float, p2: float, tmp_path: Path) -> None:
    keys = {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": -0.001}
    lens = load_scene(write_transforms(tmp_path, **keys, p1=p1, p2=p2)).views[0].lens
    plain = load_scene(write_transforms(tmp_path / "plain", **keys)).views[0].lens
    assert (lens.model, plain.model) == ("THIN_PRISM_FISHEYE", "OPENCV_FISHEYE")
    ray = np.array([[0.4, -0.3, 1.0]])
    # OpenCV's tangential terms, at the point that the angle moves the ray to
    radius = np.hypot(0.4, 0.3)
    u, v = np.arctan(radius) / radius * ray[0, :2]
    square = u * u + v * v
    shift = [2 * p1 * u * v + p2 * (square + 2 * u * u), p1 * (square + 2 * v * v) + 2 * p2 * u * v]
    np.testing.assert_allclose(lens.img_from_cam(ray) - plain.img_from_cam(ray), [FOCAL * np.array(shift)], atol=1e-9)


def test_the_same_lens_without_them(tmp_path: Path) -> None:
    """So that a fisheye whose terms are 0 is still trained natively."""
    keys = {"camera_model": "FISHEYE", "k1": 0.05, "p1": 0.0, "p2": 0}
    assert load_scene(write_transforms(tmp_path, **keys)).views[0].lens.model == "OPENCV_FISHEYE"
    twin = Lens("THIN_PRISM_FISHEYE", WIDTH, HEIGHT, (40, 40, 24, 16, 0.05, 0, 0, 0, 0, 0, 0, 0))
    ray = np.array([[0.4, -0.3, 1.0]])
    here = load_scene(tmp_path).views[0].lens.img_from_cam(ray)
    np.testing.assert_allclose(twin.img_from_cam(ray), here, atol=1e-12)


def test_terms_that_are_not_known_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'k5' or 'k6' for a fisheye, expected k1 to k4"):
        load_scene(write_transforms(tmp_path, is_fisheye=True, k5=0.1))


# Poses


def inverted(matrix: list[list[float]]) -> list[list[float]]:
    return np.linalg.inv(np.array(matrix)).tolist()


def opencv(matrix: list[list[float]]) -> list[list[float]]:
    return (np.array(matrix) * [1, -1, -1, 1]).tolist()


WORLDS = [Rotation.from_rotvec(turn).as_matrix() for turn in ([0.3, -0.5, 0.9], [2.0, 0.4, -1.1], [-0.7, 1.8, 0.2])]
"""Rotations of the world, so that the ring lies in no plane of its axes."""
ORIGIN = np.array([3.0, -2.0, 4.0])
"""Of the world: with it in the middle of the ring, a pose that maps it to where it was shows the points however it is
turned."""


def elsewhere(world: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The ring in another world."""
    turned = [(rotation @ WORLDS[world].T, translation) for rotation, translation in poses()]
    return [(rotation, translation - rotation @ ORIGIN) for rotation, translation in turned]


def cloud_there(world: int) -> tuple[np.ndarray, np.ndarray]:
    return points()[0] @ WORLDS[world].T + ORIGIN, points()[1]


def transposed(matrix: list[list[float]]) -> list[list[float]]:
    turned = np.array(matrix)
    turned[:3, :3] = turned[:3, :3].T
    return turned.tolist()


WRONG = {
    "inverted": ([inverted(matrix_of(pose)) for pose in poses()], "inverted matrices (camera from world"),
    "inverted, in OpenCV's axes": (
        [inverted(opencv(matrix_of(pose))) for pose in poses()],
        "inverted matrices (camera from",
    ),
    "in OpenCV's axes": ([opencv(matrix_of(pose)) for pose in poses()], "the other camera axes"),
}


@pytest.mark.brings("exporters of view matrices", "inverted poses, or OpenCV's axes, in `transform_matrix`", "named")
@pytest.mark.parametrize("kind", WRONG)
def test_poses_that_are_taken_the_wrong_way_are_told(kind: str, tmp_path: Path) -> None:
    matrices, words = WRONG[kind]
    write_transforms(tmp_path, matrices=matrices, ply_file_path="a.ply")
    write_cloud(tmp_path / "a.ply", *points())
    (warning,) = [text for text in load_scene(tmp_path).warnings if "the poses have" in text]
    assert words in warning
    assert "% of the points" in warning


@pytest.mark.parametrize("world", range(len(WORLDS)))
def test_transposed_rotations_are_told(world: int, tmp_path: Path) -> None:
    matrices = [transposed(matrix_of(pose)) for pose in elsewhere(world)]
    write_transforms(tmp_path, matrices=matrices, ply_file_path="a.ply")
    write_cloud(tmp_path / "a.ply", *cloud_there(world))
    assert [text for text in load_scene(tmp_path).warnings if "if the poses have transposed rotations" in text]


@pytest.mark.parametrize("kind", ["inverted", "inverted, in OpenCV's axes"])
def test_without_points_by_the_cameras_alone(kind: str, tmp_path: Path) -> None:
    write_transforms(tmp_path, matrices=WRONG[kind][0])
    found = [text for text in load_scene(tmp_path).warnings if "the poses have inverted" in text]
    assert len(found) == 1
    assert "face no common point, but 100 % of them face a common point if" in found[0]
    warned("the poses have inverted", read_poses, tmp_path / "transforms.json")


@pytest.mark.parametrize("cloud", [points(), NO_POINTS])
def test_inverted_poses_of_a_colmap_model_are_told(cloud: Any, tmp_path: Path) -> None:
    turned = [(rotation.T, -rotation.T @ translation) for rotation, translation in poses()]
    scene = load_scene(write_colmap(tmp_path, posed=turned, cloud=cloud))
    assert [text for text in scene.warnings if "if the poses have inverted" in text]


@pytest.mark.brings("editors of transforms.json", "some poses wrong, the others right", "named")
@pytest.mark.parametrize("rows", [[3], [0, 7, 12], list(range(0, 20, 2))])
def test_pictures_that_show_none_of_the_points_are_named(rows: list[int], tmp_path: Path) -> None:
    matrices = [matrix_of(pose) for pose in poses()]
    for row in rows:
        matrices[row] = opencv(matrices[row])  # looks the other way
    write_transforms(tmp_path, matrices=matrices, ply_file_path="a.ply")
    write_cloud(tmp_path / "a.ply", *points())
    (warning,) = [text for text in load_scene(tmp_path).warnings if "poses" in text]
    blind, _, rest = warning.partition(") show almost none of the points, while the others show about 100 %")
    assert rest.startswith(": the poses of the former are doubtful")
    assert blind.endswith((f"{rows[-1]:02}.png", " and 7 more"))
    assert f"{len(rows)} of 20 pictures (images/view{rows[0]:02}.png" in blind


WRONG_COLMAP = {
    "camera positions in place of": lambda rotation, translation: (rotation, -rotation.T @ translation),
    "quaternions in the order x y z w": lambda rotation, translation: (
        Rotation.from_quat(np.roll(Rotation.from_matrix(rotation).as_quat(), -1)).as_matrix(),
        translation,
    ),
    "transposed rotations": lambda rotation, translation: (rotation.T, translation),
}


@pytest.mark.brings("hand-written exporters of COLMAP text", "places for translations, x y z w, transposed rotations",
                    "named, where the origin is not what the cameras look at")  # fmt: skip
@pytest.mark.parametrize("world", range(len(WORLDS)))
@pytest.mark.parametrize("kind", WRONG_COLMAP)
def test_poses_of_a_colmap_model_that_mean_something_else_are_told(kind: str, world: int, tmp_path: Path) -> None:
    how, cloud, right = WRONG_COLMAP[kind], cloud_there(world), elsewhere(world)
    scene = load_scene(write_colmap(tmp_path, posed=[how(*pose) for pose in right], cloud=cloud))
    assert [text for text in scene.warnings if f"if the poses have {kind}" in text]
    plain = load_scene(write_colmap(tmp_path / "right", posed=right, cloud=cloud))
    assert not [text for text in plain.warnings if "poses" in text]


def away(count: int = 20) -> list[tuple[np.ndarray, np.ndarray]]:
    """Cameras that turn on the spot and look outward, moved a little as a hand does."""
    rng = np.random.default_rng(0)
    turned = [rotation @ np.diag([-1.0, 1.0, -1.0]) for rotation, _ in poses(count)]
    return [(rotation, -rotation @ rng.normal(0, 0.1, 3)) for rotation in turned]


def along(count: int = 20) -> list[tuple[np.ndarray, np.ndarray]]:
    """Cameras that walk ahead, swaying."""
    rng = np.random.default_rng(0)
    found = []
    for index in range(count):
        sway = 0.1 * rng.normal(size=2)
        rotation = np.array([[1, 0, sway[0]], [0, 1, sway[1]], [-sway[0], -sway[1], 1]])
        u, _, v = np.linalg.svd(rotation)
        found.append((u @ v, -(u @ v) @ np.array([0.0, 0, index])))
    return found


def around(count: int = 20) -> list[tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(5)
    return [(rotation, translation + rng.normal(0, 0.5, 3)) for rotation, translation in poses(count)]


def facade(seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Cameras before a wall or above a field, that look one way but for what hands and wind do."""
    rng = np.random.default_rng(seed)
    turned = [Rotation.from_rotvec(rng.normal(0, 0.12, 3)).as_matrix() for _ in range(20)]
    places = rng.uniform(-3, 3, (20, 3)) * [1, 1, 0.1]
    return [(rotation, -rotation @ place) for rotation, place in zip(turned, places, strict=True)]


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("up", ["y", "z"])
def test_cameras_that_look_one_way_are_not_told(seed: int, up: str, tmp_path: Path) -> None:
    """Whatever way they are turned round: those of a drone in a world with z up."""
    posed = facade(seed)
    if up == "z":
        turn = Rotation.from_euler("x", 180, degrees=True).as_matrix()
        posed = [(rotation @ turn.T, translation) for rotation, translation in posed]
    scene = load_scene(write_colmap(tmp_path, posed=posed, cloud=NO_POINTS))
    assert not [text for text in scene.warnings if "poses" in text]


@pytest.mark.parametrize("posed", [poses(), around(), away(), along()], ids=["ring", "by hand", "outward", "ahead"])
@pytest.mark.parametrize("cloud", [points(), NO_POINTS], ids=["points", "none"])
def test_captures_are_not_told(posed: Any, cloud: Any, tmp_path: Path) -> None:
    if posed[0][1][2] != pytest.approx(poses()[0][1][2], abs=2) and len(cloud[0]):  # points where those look
        cloud = (np.concatenate([p @ r for p, r in ((np.array([[0, 0, 3.0]] * 20) - t, r) for r, t in posed)]),
                 np.resize(points()[1], (400, 3)))  # fmt: skip
    scene = load_scene(write_colmap(tmp_path, posed=posed, cloud=cloud))
    assert not [text for text in scene.warnings if "poses" in text]


def test_the_verbs_tell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """train, eval and render."""
    scene, run = write_scene(tmp_path / "scene"), tmp_path / "run"
    assert main(["train", str(scene), "-o", str(run), "--iterations", "2", "--warmup", "", "--no-report"]) == 0
    write_transforms(tmp_path / "wrong", matrices=WRONG["inverted"][0], cx=0.0, cy=0.0)
    wrong = tmp_path / "wrong"
    for words in (
        f"train {wrong} -o {tmp_path}/other --iterations 1 --random-points 50 --no-report".split(),
        f"eval {run}/model.ply --scene {wrong}".split(),
        f"render {run}/model.ply --cameras {wrong} -o {tmp_path}/out/{{name}}.png".split(),
    ):
        capsys.readouterr()
        told = printed(capsys, words).err
        assert "is 0 0 in a picture" in told, words[0]
        assert "the poses have inverted" in told, words[0]
    assert json.loads((wrong / "transforms.json").read_text())["cx"] == 0

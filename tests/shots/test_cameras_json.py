# SPDX-License-Identifier: Apache-2.0
"""cameras.json of the 3DGS authors' trainings, as cameras to render from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import complaint
from tiny import VIEWS, write_scene

from clsplat.errors import InputError
from clsplat.scenes.loading import load_scene
from clsplat.shots import choose_shot, read_shot

# world_from_camera: columns right, down, ahead of a camera that looks along the world's +x, +z up
ROTATION = [[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]


def camera(index: int = 0, **changes: Any) -> dict[str, Any]:
    entry = {
        "id": index,
        "img_name": f"IMG_{index}",
        "width": 640,
        "height": 480,
        "position": [1.0, 2.0, 3.0 + index],
        "rotation": ROTATION,
        "fy": 510.0,
        "fx": 500.0,
        **changes,
    }
    return {key: value for key, value in entry.items() if value is not None}


def write(path: Path, document: Any) -> Path:
    path.write_text(json.dumps(document))
    return path


def test_what_the_values_mean(tmp_path: Path) -> None:
    shot = read_shot(write(tmp_path / "cameras.json", [camera(0), camera(1)]))
    assert [(frame.number, frame.name) for frame in shot.frames] == [(1, "IMG_0"), (2, "IMG_1")]
    first, second = shot.cameras
    np.testing.assert_allclose(first.position, [1, 2, 3], atol=1e-12)
    np.testing.assert_allclose(second.position, [1, 2, 4], atol=1e-12)
    np.testing.assert_allclose(first.rotation, np.array(ROTATION).T, atol=1e-12)
    assert (first.width, first.height, first.fx, first.fy, first.cx, first.cy) == (640, 480, 500, 510, 320, 240)
    # a point 4 ahead, 1 to the right and 2 down of (1, 2, 3)
    ahead = first.rotation @ (np.array([5, 1, 1]) - first.position)
    np.testing.assert_allclose(ahead, [1, 2, 4], atol=1e-12)


def inria(scene: Path) -> list[dict[str, Any]]:
    """The list that the authors' code writes of a scene of pinholes."""
    return [
        {
            "id": index,
            "img_name": view.name,
            "width": view.camera.width,
            "height": view.camera.height,
            "position": view.camera.position.tolist(),
            "rotation": view.camera.rotation.T.tolist(),
            "fy": view.camera.fy,
            "fx": view.camera.fx,
        }
        for index, view in enumerate(load_scene(scene).views)
    ]


@pytest.mark.brings("3DGS", "`cameras.json`, and its folder", "cameras to render from")
def test_the_cameras_of_a_scene_come_back(tmp_path: Path) -> None:
    """From the file, and from the folder of the training."""
    scene = write_scene(tmp_path / "scene")
    run = tmp_path / "run"
    run.mkdir()
    write(run / "cameras.json", inria(scene))
    wanted = [(view.name, view.camera) for view in load_scene(scene).views]
    for given in (run / "cameras.json", run):
        frames = read_shot(given).frames
        assert [frame.name for frame in frames] == [name for name, _ in wanted]
        for frame, (_, view) in zip(frames, wanted, strict=True):
            np.testing.assert_allclose(frame.camera.rotation, view.rotation, atol=1e-12)
            np.testing.assert_allclose(frame.camera.position, view.position, atol=1e-12)
            assert (frame.camera.fx, frame.camera.cx) == (view.fx, frame.camera.width / 2)


def test_paths_are_made_of_them(tmp_path: Path) -> None:
    path = write(tmp_path / "cameras.json", inria(write_scene(tmp_path / "scene")))
    shot = choose_shot(path, path="spiral", count=7)
    assert len(shot.frames) == 7
    assert len(read_shot(path).frames) == VIEWS


def test_a_colmap_model_beside_it_goes_first(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene")
    write(scene / "cameras.json", [camera()])
    assert len(read_shot(scene).frames) == VIEWS


@pytest.mark.brings("SuperSplat", "the same list without size, focal length or names", "cameras; sizes from the flags")
@pytest.mark.parametrize(
    ("changes", "size", "wanted"),
    [
        ({"fy": None}, (None, None), (640, 480, 500, 500)),
        ({"fx": None}, (None, None), (640, 480, 510, 510)),
        ({"width": None, "height": None}, (320, 200), (320, 200, 500, 510)),
        ({"width": 640.0}, (320, 200), (640, 480, 500, 510)),
    ],
)
def test_entries_with_less(changes: dict[str, Any], size: Any, wanted: Any, tmp_path: Path) -> None:
    first = read_shot(write(tmp_path / "poses.json", [camera(**changes)]), size=size).cameras[0]
    assert (first.width, first.height, first.fx, first.fy) == wanted


def test_names_that_are_missing_or_there_twice(tmp_path: Path) -> None:
    """Pictures of both splits of a Blender scene have one name."""
    entries = [camera(img_name="r_0"), camera(img_name="r_0"), camera(img_name=None), camera(img_name="a\\b.jpg")]
    shot = read_shot(write(tmp_path / "cameras.json", entries))
    assert [frame.name for frame in shot.frames] == ["r_0", "r_0", "0003", "a/b.jpg"]


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ([], "is an empty list, expected the cameras of a 3DGS training"),
        ([1, 2], "is a list that begins with 1, expected"),
        ([[1.0, 0.0]], "is a list that begins with [1.0, 0.0], expected"),
        ([{"id": 0, "name": "front door"}], "is a list that begins with {'id': 0"),
        ([None], "is a list that begins with null, expected the cameras"),
        ([camera(rotation=None)], "is a list that begins with {'id': 0"),
        ([camera(), 7], "camera 1 is 7, expected an object with 'position', 'rotation'"),
        ([camera(), camera(1), None], "camera 2 is null, expected an object"),
        ([camera(), {"x": 1}, camera(2)], "camera 1: has no 'position' and no 'rotation', expected an object with"),
        ([camera(), camera(1, rotation=None)], "camera 1 (IMG_1): has no 'rotation', expected an object"),
        ([{**camera(), "position": None}, camera(1)], "camera 0 (IMG_0): has no 'position', expected an object"),
        ([camera(cx="middle")], "camera 0 (IMG_0): 'cx' is 'middle', expected a number"),
        ([camera(rotation=[1, 0, 0, 0])], "camera 0 (IMG_0): 'rotation' is [1, 0, 0, 0], expected three rows"),
        ([camera(rotation=np.diag([1.0, 1, -1]).tolist())], "'rotation' is not a rotation (determinant -1)"),
        ([camera(rotation=np.diag([2.0, 2, 2]).tolist())], "'rotation' is not a rotation (determinant 8)"),
        ([camera(rotation=[["a", 0, 0], [0, 1, 0], [0, 0, 1]])], "expected three rows of three numbers"),
        (
            [camera(), camera(1, position=[0, 1])],
            "camera 1 (IMG_1): 'position' is [0, 1], expected a list of 3 numbers",
        ),
        ([camera(fx=0)], "'fx' is 0, expected pixels above 0"),
        ([camera(fx=None, fy=None)], "has no 'fx', expected a number"),
        ([camera(width=None)], "has no 'width', expected a whole number"),
        ([camera(height=1.5)], "'height' is 1.5, expected a whole number"),
    ],
)
def test_lists_that_cannot_be(document: Any, message: str, tmp_path: Path) -> None:
    path = write(tmp_path / "cameras.json", document)
    assert message in complaint(path, read_shot, path)


def test_they_have_no_lenses_to_bend_by(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"lens distortion, expected .*, a COLMAP model's folder or a transforms"):
        choose_shot(write(tmp_path / "cameras.json", [camera()]), distort=True)


@pytest.mark.brings("exporters of cameras.json", "`cx cy` in its entries", "the principal point")
@pytest.mark.parametrize(
    ("changes", "wanted"),
    [({"cx": 300.5, "cy": 260.0}, (300.5, 260)), ({"cx": 310}, (310, 240)), ({"cy": 0.0}, (320, 0))],
)
def test_a_principal_point_beside_the_middle(
    changes: dict[str, Any], wanted: tuple[float, float], tmp_path: Path
) -> None:
    first = read_shot(write(tmp_path / "cameras.json", [camera(**changes)])).cameras[0]
    assert (first.cx, first.cy) == wanted

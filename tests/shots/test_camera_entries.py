# SPDX-License-Identifier: Apache-2.0
"""Checks that the readers of camera files share: the same values are refused in the same words, whatever the format."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from calls import complaint, refuses

from clsplat.camera import focal_length
from clsplat.scenes.camera_json import Keys, objects
from clsplat.shots import read_shot
from clsplat.shots.shot import whole_frames

POSE = [float(row == column) for row in range(4) for column in range(4)]


def own(path: Path, width: Any, degrees: Any) -> Path:
    key = {"frame": 1, "position": [0, 0, 0], "world_from_cam": [1, 0, 0, 0], "fov_y": degrees}
    document = {"clsplat_cameras": 1, "width": width, "height": 480, "keys": [key]}
    path.write_text(json.dumps(document))
    return path


def nerfstudio(path: Path, width: Any, degrees: Any) -> Path:
    entry = {"camera_to_world": POSE, "fov": degrees}
    document = {"render_width": width, "render_height": 480, "camera_path": [entry]}
    path.write_text(json.dumps(document))
    return path


@pytest.mark.parametrize("write", [own, nerfstudio])
def test_one_angle_of_view_is_one_focal_length(write: Any, tmp_path: Path) -> None:
    (camera,) = read_shot(write(tmp_path / "a.json", 640, 50)).cameras
    assert camera.fx == camera.fy == focal_length(0.8726646259971648, 480)
    assert (camera.width, camera.height, camera.cx, camera.cy) == (640, 480, 320, 240)


@pytest.mark.parametrize("write", [own, nerfstudio])
@pytest.mark.parametrize(("width", "problem"), [(None, "has no '"), (0, "' is 0"), (6.5, "' is 6.5")])
def test_sizes_that_cannot_be(write: Any, width: Any, problem: str, tmp_path: Path) -> None:
    path = write(tmp_path / "a.json", width, 50)
    said = complaint(path, read_shot, path)
    assert problem in said and "expected a whole number of pixels from 1 to " in said


@pytest.mark.parametrize("write", [own, nerfstudio])
def test_angles_that_cannot_be(write: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "a.json", 640, 1e-320)
    refuses(r"key 0: 'fov(_y)?': angle of view is .* focal length over 1e\+12", read_shot, path)


def test_an_entry_begins_every_error_with_its_place() -> None:
    entry = Keys(Path("a.json"), "key 3", {"p": [1, 2, "x"], "n": 10**5000}, {"q": [1, 2, 3]})
    assert entry.vector("q", 3).tolist() == [1, 2, 3]
    refuses(r"^a\.json: key 3: 'p' is \[1, 2, 'x'\], expected a list of 3 numbers$", entry.vector, "p", 3)
    message = r"^a\.json: key 3: 'n' is a number of thousands of digits, expected a list of 2 numbers$"
    refuses(message, entry.vector, "n", 2)


@pytest.mark.parametrize("given", [None, {}, "x", [], [1], [{}, None]])
def test_no_list_of_objects(given: Any) -> None:
    assert not objects({"keys": given}, "keys")


def test_whole_frames() -> None:
    assert whole_frames("a", "frame", 1.5, 4.0) == [2, 3, 4]
    refuses(r"^a: has no whole frame from 1\.2 to 1\.8, expected at least one$", whole_frames, "a", "frame", 1.2, 1.8)
    for begin, end in ((0.0, 1e5), (0.0, float("inf")), (float("inf"), 0.0), (float("nan"), 1.0)):
        refuses(r"^a: has the frames .* expected at most 100,000 frames$", whole_frames, "a", "frame", begin, end)

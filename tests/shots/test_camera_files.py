# SPDX-License-Identifier: Apache-2.0
"""Files of cameras: what each format means, and what is wrong with those that cannot be read."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import complaint, refuses

from clsplat.errors import InputError
from clsplat.images.writing import write_image
from clsplat.reference.cameras import cam_from_pixel
from clsplat.shots import choose_shot, read_shot
from clsplat.shots.readers.clsplat_json import CAMERA_FILE_PROPERTIES, KEY_FRAME_PROPERTIES
from clsplat.shots.shot import Shot
from clsplat.stages.device_camera import pack_camera

# A camera at (1, 2, 3) that looks along the world's +x, the world's +z up, in OpenGL's axes: columns right, up, back.
POSE = [[0.0, 0, -1, 1], [-1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
AHEAD, RIGHT, DOWN = [1.0, 0, 0], [0.0, -1, 0], [0.0, 0, -1]
# the same as a quaternion of our axes (x right, y down, z ahead)
QUATERNION = [0.5, -0.5, 0.5, -0.5]


def write(path: Path, document: Any) -> Path:
    path.write_text(json.dumps(document))
    return path


def assert_pose(camera: Any) -> None:
    np.testing.assert_allclose(camera.position, [1, 2, 3], atol=1e-12)
    np.testing.assert_allclose(camera.rotation, [RIGHT, DOWN, AHEAD], atol=1e-12)


def camera_path(count: int = 3, **changes: Any) -> dict[str, Any]:
    flat = [float(value) for row in POSE for value in row]
    document = {
        "camera_type": "perspective",
        "render_width": 640,
        "render_height": 480,
        "fps": 24,
        "seconds": 1,
        "camera_path": [{"camera_to_world": flat, "fov": 50.0 + i, "aspect": 640 / 480} for i in range(count)],
        **changes,
    }
    return {key: value for key, value in document.items() if value is not None}


def test_camera_path(tmp_path: Path) -> None:
    shot = read_shot(write(tmp_path / "camera_path.json", camera_path()))
    assert [(frame.number, frame.name) for frame in shot.frames] == [(1, "0001"), (2, "0002"), (3, "0003")]
    assert [frame.time for frame in shot.frames] == pytest.approx([0, 1 / 24, 2 / 24])
    for index, camera in enumerate(shot.cameras):
        assert_pose(camera)
        assert (camera.width, camera.height, camera.projection) == (640, 480, "perspective")
        focal = 240 / math.tan(math.radians(50 + index) / 2)  # the vertical angle of view
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((focal, focal, 320, 240))


def test_camera_path_of_other_cameras(tmp_path: Path) -> None:
    fisheye = read_shot(write(tmp_path / "f.json", camera_path(camera_type="fisheye", fps=None))).frames[0]
    assert (fisheye.camera.projection, fisheye.time) == ("fisheye", None)
    assert fisheye.camera.fx == fisheye.camera.fy == pytest.approx(240 / math.tan(math.radians(25)))
    round_ = read_shot(write(tmp_path / "e.json", camera_path(camera_type="equirectangular"))).cameras[0]
    assert round_.projection == "equirectangular"
    # the middle looks ahead, the left and right edges straight back, the upper edge up
    _, rays = cam_from_pixel(round_, np.array([[320.0, 240], [0, 240], [640, 240], [480, 240], [320, 0]]))
    np.testing.assert_allclose(rays, [[0, 0, 1], [0, 0, -1], [0, 0, -1], [1, 0, 0], [0, -1, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_path": []}, "has no keys in 'camera_path'"),
        ({"camera_path": None, "keyframes": [{}, {}]}, "has 2 'keyframes', but no keys in 'camera_path'"),
        ({"camera_type": "vr180"}, "'camera_type' is 'vr180', expected one of perspective, fisheye, equirectangular"),
        ({"render_width": None}, "has no 'render_width', expected a whole number of pixels"),
        ({"render_height": 10.5}, "'render_height' is 10.5, expected a whole number of pixels"),
        ({"camera_path": [{"fov": 50}]}, "key 0: has no 'camera_to_world'"),
        ({"camera_path": [{"camera_to_world": [1, 2]}]}, "key 0: 'camera_to_world' is [1, 2], expected 3 x 4"),
        ({"camera_path": [{"camera_to_world": [0] * 16}]}, "key 0: 'camera_to_world' contains no rotation"),
        (
            {"camera_path": [{"camera_to_world": np.transpose(POSE).ravel().tolist(), "fov": 50}]},
            "row [1.0, 2.0, 3.0, 1.0], expected 0 0 0 1, with the position in the last column; it is written column by",
        ),
        (
            {"camera_path": [{"camera_to_world": [*POSE[:3], [0, 0, 0.5, 1]], "fov": 50}]},
            "has the last row [0.0, 0.0, 0.5, 1.0], expected 0 0 0 1, with the position in the last column; check how",
        ),
        (
            {"camera_path": [{"camera_to_world": [[0, 0, -1, True], *POSE[1:]], "fov": 50}]},
            "'camera_to_world' is [[0, 0, -1, True], ",
        ),
        ({"camera_path": [{"camera_to_world": POSE}]}, "key 0: has no 'fov'"),
        ({"camera_path": [{"camera_to_world": POSE, "fov": 180}]}, "key 0: 'fov' is 180, expected the vertical angle"),
        ({"camera_path": [{"camera_to_world": POSE, "fov": 10**400}]}, "'fov' is 1000"),
        (
            {"camera_path": [{"camera_to_world": POSE, "fov": 1e-320}]},
            "key 0: 'fov': angle of view is 9.90602e-321 degrees",
        ),
    ],
)
def test_camera_paths_that_cannot_be(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = write(tmp_path / "camera_path.json", camera_path(**changes))
    assert message in complaint(path, read_shot, path)


def test_a_key_that_is_there_twice(tmp_path: Path) -> None:
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps(camera_path()).replace('"fov": 51.0', '"fov": 51.0, "fov": 20'))
    refuses(r"camera_path\.json: is not JSON: the key 'fov' occurs twice; expected", read_shot, path)


def transforms(**keys: Any) -> dict[str, Any]:
    frames = [{"file_path": f"./images/{name}", "transform_matrix": POSE} for name in ("b", "a")]
    return {"camera_angle_x": math.pi / 2, "frames": frames, **keys}


def test_transforms_without_their_pictures(tmp_path: Path) -> None:
    shot = read_shot(write(tmp_path / "transforms.json", transforms(w=40, h=20)))
    assert [(frame.number, frame.name) for frame in shot.frames] == [(1, "images/b"), (2, "images/a")]
    for camera in shot.cameras:
        assert_pose(camera)
        assert (camera.width, camera.height) == (40, 20)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((20, 20, 20, 10))
    sizeless = write(tmp_path / "transforms_test.json", transforms())
    assert read_shot(sizeless, size=(80, 30)).cameras[0].fx == pytest.approx(40)
    with pytest.raises(
        InputError, match=r"frame 0: has no 'w' and 'h', and its picture .*images/b does not exist; give"
    ):
        read_shot(sizeless, size=(80, None))
    (tmp_path / "images").mkdir()
    write_image(tmp_path / "images" / "b.png", np.zeros((6, 12, 3), np.float32))
    write_image(tmp_path / "images" / "a.png", np.zeros((6, 12, 3), np.float32))
    shot = read_shot(sizeless)
    assert shot.frames[0].name == "images/b.png"
    assert (shot.cameras[0].width, shot.cameras[0].height, shot.cameras[0].fx) == (12, 6, pytest.approx(6))


def test_a_folder_with_transforms(tmp_path: Path) -> None:
    path = write(tmp_path / "transforms.json", transforms(w=40, h=20))
    assert [frame.name for frame in read_shot(tmp_path).frames] == [frame.name for frame in read_shot(path).frames]
    write(tmp_path / "transforms_test.json", transforms(w=40, h=20))
    refuses(r"holds transforms.json, transforms_test.json, expected --cameras", read_shot, tmp_path)


def own(**changes: Any) -> dict[str, Any]:
    key = {"position": [1, 2, 3], "world_from_cam": QUATERNION}
    document = {
        "clsplat_cameras": 1,
        "width": 400,
        "height": 200,
        "fov_x": 90,
        "keys": [{"frame": 1, **key}, {"frame": 5, **key}],
        **changes,
    }
    return {name: value for name, value in document.items() if value is not None}


def key(**values: Any) -> dict[str, Any]:
    return {"frame": 1, "position": [1, 2, 3], "world_from_cam": QUATERNION, **values}


def test_own_format(tmp_path: Path) -> None:
    shot = read_shot(write(tmp_path / "shot.json", own(fps=25, first_frame=1001, near=0.5, far=20)))
    assert [frame.number for frame in shot.frames] == [1, 2, 3, 4, 5]
    assert [frame.time for frame in shot.frames] == pytest.approx([0, 0.04, 0.08, 0.12, 0.16])
    for camera in shot.cameras:
        assert_pose(camera)
        assert (camera.width, camera.height, camera.near, camera.far) == (400, 200, 0.5, 20)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((200, 200, 200, 100))


def test_keys_in_seconds_in_any_order_and_loops(tmp_path: Path) -> None:
    keys = [key(seconds=0.1, position=[3, 0, 0]), key(seconds=0, position=[0, 0, 0])]
    for each in keys:
        del each["frame"]
    shot = read_shot(write(tmp_path / "a.json", own(fps=30, first_frame=1001, keys=keys)))
    assert [frame.number for frame in shot.frames] == [1001, 1002, 1003, 1004]
    np.testing.assert_allclose([camera.position[0] for camera in shot.cameras], [0, 1, 2, 3], atol=1e-12)
    keys = [key(frame=10, position=[0, 0, 0]), key(frame=15, position=[1, 0, 0])]
    loop = read_shot(write(tmp_path / "b.json", own(keys=keys, loop_frames=10)))
    assert [frame.number for frame in loop.frames] == list(range(10, 20))
    along = [camera.position[0] for camera in loop.cameras]
    np.testing.assert_allclose(along[1:5], along[:5:-1], atol=1e-12)
    assert [frame.number for frame in read_shot(write(tmp_path / "c.json", own(keys=[key(frame=7)]))).frames] == [7]


def first(path: Path, **changes: Any) -> Any:
    return read_shot(write(path / "one.json", own(**changes))).cameras[0]


def test_lenses_of_own_format(tmp_path: Path) -> None:
    def focal(**changes: Any) -> tuple[float, float]:
        camera = first(tmp_path, **changes)
        return camera.fx, camera.fy

    assert focal() == pytest.approx((200, 200))
    assert focal(fov_x=None, fov_y=90) == pytest.approx((100, 100))
    assert focal(fov_x=None, fx=70) == (pytest.approx(70), pytest.approx(70))
    assert focal(fov_x=None, fx=70, fy=60) == (pytest.approx(70), pytest.approx(60))
    assert focal(keys=[key(fov_y=90)]) == pytest.approx((100, 100))  # the key's own, not the file's fov_x
    assert focal(projection="fisheye", fov_x=220) == pytest.approx([400 / math.radians(220)] * 2)
    assert focal(projection="orthographic", fov_x=None, pixel_size=0.02) == pytest.approx((50, 50))
    assert focal(projection="equirectangular", fov_x=None) == pytest.approx((400 / (2 * math.pi), 200 / math.pi))
    assert focal(projection="equirectangular", fov_x=180) == pytest.approx((400 / math.pi, 200 / math.pi))
    assert first(tmp_path, projection="orthographic", fov_x=None, fx=9).projection == "orthographic"

    shifted = first(tmp_path, shift=[0.1, 0.25])  # a tenth of the width to the right, a quarter of the height up
    assert (shifted.cx, shifted.cy) == pytest.approx((160, 150))
    assert first(tmp_path, keys=[key(cx=3)]).cx == pytest.approx(3)
    rolled = first(tmp_path, keys=[key(roll=90)])
    # clockwise, seen from behind the camera: its right is where its lower side was
    np.testing.assert_allclose(rolled.rotation, [DOWN, [-x for x in RIGHT], AHEAD], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"clsplat_cameras": 2}, "'clsplat_cameras' is 2, expected 1; newer files need a newer clsplat"),
        ({"keys": []}, "has no keys"),
        ({"keys": None}, "has no keys"),
        ({"keys": [7]}, "has no keys"),
        ({"wdith": 3}, "'wdith' is not known here, expected one of"),
        ({"keys": [key(fovx=3)]}, "key 0: 'fovx' is not known here"),
        ({"width": 0}, "'width' is 0, expected a whole number of pixels"),
        ({"height": None}, "has no 'height'"),
        ({"projection": "cylinder"}, "'projection' is 'cylinder', expected one of perspective, orthographic, equirect"),
        ({"projection": ["fisheye"]}, "'projection' is ['fisheye'], expected one of"),
        ({"near": 0}, "'near' is 0 and 'far' inf, expected 0 < near < far"),
        ({"near": 2, "far": 1}, "'near' is 2 and 'far' 1"),
        ({"fps": 0}, "'fps' is 0, expected more than 0"),
        ({"keys": [key(frame=None)]}, "key 0: has neither, expected either 'frame' or"),
        ({"keys": [key(seconds=1)]}, "key 0: has both, expected either 'frame' or 'seconds'"),
        ({"keys": [key(frame=None, seconds=1)]}, "key 0: has 'seconds', but the file has no 'fps'"),
        ({"keys": [key(frame="1")]}, "key 0: 'frame' is '1', expected a number"),
        ({"keys": [key(), key(), key(frame=3)]}, "has two keys at frame 1, expected one"),
        ({"keys": [key(frame=1.25), key(frame=1.75)]}, "has no whole frame from 1.25 to 1.75"),
        ({"keys": [key(), key(frame=1e9)]}, "has the frames 1 to 1,000,000,000, expected at most 100,000 frames"),
        ({"loop_frames": 4}, "'loop_frames' is 4, expected more than the 4 that the keys span"),
        ({"keys": [key(position=None)]}, "key 0: has no 'position', expected a list of 3 numbers"),
        ({"keys": [key(position=[1, 2, True])]}, "key 0: 'position' is [1, 2, True], expected a list of 3 numbers"),
        ({"keys": [key(position=[1, 2, float("nan")])]}, "key 0: 'position' is [1, 2, nan]"),
        ({"keys": [key(world_from_cam=[1, 2])]}, "key 0: 'world_from_cam' is [1, 2], expected a list of 4 numbers"),
        ({"keys": [key(world_from_cam=[0, 0, 0, 0])]}, "expected a unit quaternion [w, x, y, z]"),
        ({"fov_x": None}, "key 0: has no focal length, expected one of 'fx' (with 'fy' if that differs), 'fov_x' or"),
        ({"fov_y": 50}, "key 0: has 'fov_x' 90, 'fov_y' 50, expected one of 'fx'"),
        ({"fov_x": 180}, "key 0: 'fov_x': angle of view is 180 degrees, expected more than 0 and less than 180"),
        ({"fov_x": 361, "projection": "fisheye"}, "'fov_x': angle of view is 361 degrees, expected more than 0 and at"),
        ({"fov_x": -5}, "key 0: has 'fov_x' -5, expected more than 0"),
        (
            {"fov_x": 1e-320},
            "key 0: 'fov_x': angle of view is 9.90602e-321 degrees, which gives a focal length over 1e+12",
        ),
        ({"fov_x": None, "fx": 1e13}, "key 0: has a focal length of 1e+13, expected at most 1e+12"),
        ({"projection": "equirectangular", "fov_x": 1e-320}, "key 0: has a focal length of inf, expected at most"),
        ({"projection": "orthographic"}, "key 0: has 'fov_x' 90, expected one of 'fx' (with 'fy' if that differs), 'p"),
        ({"projection": "equirectangular", "fov_x": 400}, "expected only 'fov_x' up to 360"),
        ({"projection": "equirectangular", "fov_x": 0}, "expected only 'fov_x' up to 360"),
        ({"projection": "equirectangular", "fov_x": None, "fx": 9}, "has 'fx' 9, expected only 'fov_x'"),
        ({"shift": [0.1]}, "key 0: 'shift' is [0.1], expected a list of 2 numbers"),
        ({"shift": [0, 0], "cx": 3}, "key 0: has 'shift' and 'cx' or 'cy', expected one or the other"),
    ],
)
def test_own_files_that_cannot_be(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = write(tmp_path / "shot.json", own(**changes))
    assert message in complaint(path, read_shot, path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "{", "is not JSON"),
        ("a.json", "1", "is not a JSON object, expected one with 'frames', 'camera_path' or 'clsplat_cameras'"),
        ("a.json", "{}", "has neither 'clsplat_cameras' (a clsplat camera file) nor 'camera_path'"),
        ("a.json", '{"frames": []}', "has no 'frames'"),
        ("a.abc", "", "has the extension '.abc', expected a COLMAP model's folder, a transforms.json"),
    ],
)
def test_files_of_no_known_kind(name: str, content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(content)
    assert message in complaint(tmp_path / name, read_shot, tmp_path / name)


def test_files_and_folders_that_are_missing(tmp_path: Path) -> None:
    refuses(r"none.json: no such folder or file, expected a COLMAP model's folder", read_shot, tmp_path / "none.json")
    refuses("no COLMAP model", read_shot, tmp_path)


def test_only_some_frames(tmp_path: Path) -> None:
    path = write(tmp_path / "camera_path.json", camera_path(10))
    assert [frame.number for frame in choose_shot(path).only("7,2-9:3").frames] == [2, 5, 7, 8]
    shot = choose_shot(path).only("9-12")
    assert [frame.number for frame in shot.frames] == [9, 10]
    assert shot.warnings == ("--frames 9-12: 2 of these frames do not exist; the shot has the frames 1-10",)
    refuses(r"--frames 11-20: holds none of the frames to render, .* the frames 1-10", choose_shot(path).only, "11-20")


def test_paths_made_of_cameras(tmp_path: Path) -> None:
    path = write(tmp_path / "camera_path.json", camera_path())
    for name in ("turntable", "spiral", "through"):
        assert [frame.number for frame in choose_shot(path, path=name, count=7).frames] == list(range(1, 8))
    assert len(choose_shot(path, path="turntable").frames) == 120
    refuses(r"--count 5: expected --path with it", choose_shot, path, count=5)
    for count in (0, -1, 10**7):
        refuses(f"--count {count}: expected 1 to 100,000 frames", choose_shot, path, path="turntable", count=count)
    fisheye = write(tmp_path / "f.json", camera_path(camera_type="fisheye"))
    refuses("its cameras are fisheye, --path needs perspective or orthographic", choose_shot, fisheye, path="turntable")
    ahead = key(position=[0, 0, -4], world_from_cam=[1, 0, 0, 0])
    aside = key(frame=9, position=[4, 0, 0], world_from_cam=[math.sqrt(0.5), 0, -math.sqrt(0.5), 0])
    flat = own(projection="orthographic", fov_x=None, pixel_size=0.02, keys=[ahead, aside])
    turned = choose_shot(write(tmp_path / "o.json", flat), path="turntable", count=7).cameras
    assert {(camera.projection, round(camera.fx, 9)) for camera in turned} == {("orthographic", 50.0)}


def test_motion_stays_in_a_projection(tmp_path: Path) -> None:
    for kind in ("fisheye", "equirectangular"):
        choose_shot(write(tmp_path / "f.json", camera_path(camera_type=kind))).check(["rgb", "motion"])
    shot = read_shot(write(tmp_path / "f.json", camera_path()))
    mixed = Shot((shot.frames[0], replace(shot.frames[1], camera=replace(shot.cameras[1], projection="orthographic"))))
    mixed.check(["rgb", "depth"])
    refuses("motion: frame 2 is orthographic, expected perspective like frame 1", mixed.check, ["rgb", "motion"])


def test_a_far_plane_is_the_cameras(tmp_path: Path) -> None:
    path = write(tmp_path / "shot.json", own(far=20))
    assert choose_shot(path).told(path) == ()
    assert {camera.far for camera in choose_shot(path).cameras} == {20}
    assert choose_shot(write(path, own())).cameras[0].far == float("inf")


def test_the_examples_of_the_documentation(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "cameras.md").read_text()
    blocks = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    shots = []
    for block in blocks:
        (tmp_path / "example.json").write_text(block)
        shots.append(read_shot(tmp_path / "example.json"))
    assert [[len(shot.frames), shot.frames[0].number] for shot in shots] == [[1, 1], [1, 1], [1, 1], [73, 1001]]
    for shot in shots:  # each looks from y = -4 along +y, the world's z up
        np.testing.assert_allclose(shot.cameras[0].position[:2], [0, -4])
        np.testing.assert_allclose(shot.cameras[0].rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-8)
    for name in (*CAMERA_FILE_PROPERTIES, *KEY_FRAME_PROPERTIES):
        assert f"`{name}`" in text, name


def test_the_kernels_refuse_what_they_do_not_have(tmp_path: Path) -> None:
    panorama = first(tmp_path, projection="equirectangular", fov_x=360)
    pack_camera(panorama)
    with pytest.raises(InputError, match=r"but a full turn has 60\.0 pixels: expected a width of at most"):
        pack_camera(replace(panorama, width=64, fx=60 / (2 * np.pi)))
    pack_camera(first(tmp_path))

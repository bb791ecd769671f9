# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calls import refuses, warned, warnings_of
from needs import SCENES

from clsplat.errors import InputError
from clsplat.images.writing import write_image
from clsplat.scenes.point_files import read_point_cloud
from clsplat.scenes.readers.transforms import read_blender, read_poses, read_transforms

POSE = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]


def make(folder: Path, count: int = 2, name: str = "transforms.json", **keys: Any) -> Path:
    """A data set of pictures of 12 x 8; `keys` replace those of the file, None leaves one out."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    listed = []
    for index in range(count):
        write_image(folder / "images" / f"{index}.png", np.full((8, 12, 3), 0.5, np.float32))
        listed.append({"file_path": f"images/{index}.png", "transform_matrix": POSE})
    document: dict[str, Any] = {"fl_x": 10.0, "frames": listed, **keys}
    path = folder / name
    path.write_text(json.dumps({key: value for key, value in document.items() if value is not None}))
    return path


def change_frame(path: Path, **keys: Any) -> None:
    document = json.loads(path.read_text())
    document["frames"][1].update(keys)
    document["frames"][1] = {key: value for key, value in document["frames"][1].items() if value is not None}
    path.write_text(json.dumps(document))


def test_opengl_axes_become_colmaps(tmp_path: Path) -> None:
    frame = read_transforms(make(tmp_path)).images[0]
    # The camera stands at (1, 2, 3) and looks along the world's -z, the world's y up.
    np.testing.assert_allclose(-frame.rotation.T @ frame.translation, [1, 2, 3])
    np.testing.assert_allclose(frame.rotation @ [1, 2, 2] + frame.translation, [0, 0, 1])  # ahead: depth 1
    np.testing.assert_allclose(frame.rotation @ [1, 3, 3] + frame.translation, [0, -1, 0])  # above: y down
    np.testing.assert_allclose(frame.rotation @ [2, 2, 3] + frame.translation, [1, 0, 0])  # right
    assert np.linalg.det(frame.rotation) == pytest.approx(1)


def test_a_scaled_pose_gives_the_same_rotation(tmp_path: Path) -> None:
    scaled = (np.array(POSE) * [[2.0, 2, 2, 1]]).tolist()
    path = make(tmp_path)
    change_frame(path, transform_matrix=scaled[:3])  # without its last row, too
    frames = read_transforms(path).images
    np.testing.assert_allclose(frames[1].rotation, frames[0].rotation, atol=1e-12)
    np.testing.assert_allclose(frames[1].translation, frames[0].translation, atol=1e-12)


@pytest.mark.parametrize(
    ("keys", "model", "params"),
    [
        ({}, "PINHOLE", (10, 10, 6, 4)),
        ({"fl_y": 11, "cx": 5, "cy": 3}, "PINHOLE", (10, 11, 5, 3)),
        ({"fl_x": None, "camera_angle_x": math.pi / 2}, "PINHOLE", (6, 6, 6, 4)),
        ({"fl_x": None, "camera_angle_x": math.pi / 2, "camera_angle_y": math.pi / 2}, "PINHOLE", (6, 4, 6, 4)),
        ({"fl_x": None, "camera_angle_x": math.pi / 2, "w": 24, "h": 16}, "PINHOLE", (12, 12, 12, 8)),
        ({"k1": 0.1, "p2": 0.2}, "OPENCV", (10, 10, 6, 4, 0.1, 0, 0, 0.2)),
        ({"k1": 0.0, "k2": 0, "camera_model": "OPENCV"}, "PINHOLE", (10, 10, 6, 4)),
        ({"k1": 0.1, "k3": 0.3}, "FULL_OPENCV", (10, 10, 6, 4, 0.1, 0, 0, 0, 0.3, 0, 0, 0)),
        ({"k1": 0.1, "k4": 0.4, "camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE", (10, 10, 6, 4, 0.1, 0, 0, 0.4)),
        ({"is_fisheye": True}, "OPENCV_FISHEYE", (10, 10, 6, 4, 0, 0, 0, 0)),
    ],
)
def test_intrinsics(tmp_path: Path, keys: dict[str, Any], model: str, params: tuple[float, ...]) -> None:
    lens = read_transforms(make(tmp_path, **keys)).images[0].lens
    assert lens.model == model
    assert lens.params == pytest.approx(params)
    assert (lens.width, lens.height) == (keys.get("w", 12), keys.get("h", 8))


def test_a_frame_may_have_its_own_intrinsics(tmp_path: Path) -> None:
    path = make(tmp_path, k1=0.1)
    change_frame(path, fl_x=20.0, k1=0.0)
    first, second = (frame.lens for frame in read_transforms(path).images)
    assert (first.model, first.params[0]) == ("OPENCV", 10)
    assert (second.model, second.params[0]) == ("PINHOLE", 20)


@pytest.mark.parametrize(
    ("listed", "name"),
    [
        ("./images/1", "images/1.png"),
        ("images\\1.png", "images/1.png"),
        ("images/sub/../1", "images/1.png"),
        ("../set/images/1.png", "set/images/1.png"),
        ("images/v1.2", "images/v1.2.png"),
        ("images/upper", "images/upper.PNG"),
    ],
)
def test_habits_of_file_path(tmp_path: Path, listed: str, name: str) -> None:
    folder = tmp_path / "set"
    path = make(folder)
    for extra in ("v1.2.png", "upper.PNG"):
        write_image(folder / "images" / extra, np.zeros((8, 12, 3), np.float32))
    change_frame(path, file_path=listed)
    frame = read_transforms(path).images[1]
    assert frame.name == name
    assert frame.path.is_file()


@pytest.mark.parametrize(
    ("keys", "of_frame", "found"),
    [
        ({"frames": None}, {}, "has no 'frames'"),
        ({"frames": []}, {}, "has no 'frames'"),
        ({"fl_x": None}, {}, "frame 0: has neither 'fl_x' nor 'camera_angle_x'"),
        ({"fl_x": "wide"}, {}, "'fl_x' is 'wide', expected a number"),
        ({"fl_x": -3}, {}, "focal lengths above 0"),
        ({"fl_x": None, "camera_angle_x": 30.0}, {}, "'camera_angle_x' is 30, expected an angle between 0 and pi"),
        ({"k1": 0.1, "k4": 0.1}, {}, "'k4' is 0.1 in a perspective camera"),
        ({"camera_model": "KALEIDOSCOPE"}, {}, "unknown 'camera_model' 'KALEIDOSCOPE', expected one of"),
        ({"aabb_scale": 4, "scale": "x"}, {}, "'scale' is 'x', 'offset' is None"),
        ({}, {"file_path": None}, "frame 1: has no 'file_path'"),
        ({}, {"file_path": 7}, "frame 1: 'file_path' is 7, expected text"),
        ({}, {"transform_matrix": None}, "frame 1: has no 'transform_matrix'"),
        ({}, {"transform_matrix": [[1], 2]}, r"frame 1: 'transform_matrix' is \[\[1\], 2\], expected 3 x 4"),
        ({}, {"transform_matrix": np.diag([1, 1, -1, 1]).tolist()}, "contains no rotation"),
        ({}, {"transform_matrix": np.transpose(POSE).tolist()}, "frame 1: .* has the last row .*, so transpose it"),
        ({}, {"file_path": "images/0.png"}, "lists images/0.png twice"),
        ({}, {"file_path": "images/gone"}, "lists 1 image.* missing: .*images/gone"),
    ],
)
def test_keys_that_are_missing_or_wrong_are_named(
    tmp_path: Path, keys: dict[str, Any], of_frame: dict[str, Any], found: str
) -> None:
    path = make(tmp_path, **keys)
    if of_frame:
        change_frame(path, **of_frame)
    assert str(path) in refuses(found, read_transforms, path)


def test_not_json(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    for text, found in (("{", "is not JSON"), ("[1]", "is not a JSON object"), ("\xff", "is not text in UTF-8")):
        path.write_bytes(text.encode("latin-1"))
        refuses(found, read_transforms, path)
    refuses("no such file", read_transforms, tmp_path / "none.json")


def test_blender_has_its_own_split(tmp_path: Path) -> None:
    make(tmp_path, name="transforms_train.json")
    with pytest.raises(InputError, match=r"test\.json: lists images/0\.png, which is a training picture too"):
        make(tmp_path, name="transforms_test.json")
        read_blender(tmp_path)
    (tmp_path / "images").rename(tmp_path / "held_out")
    make(tmp_path, name="transforms_train.json")
    frame = {"file_path": "./held_out/1", "transform_matrix": POSE}
    (tmp_path / "transforms_test.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": [frame]}))
    frames = read_blender(tmp_path).images
    splits = {"images/0.png": "train", "images/1.png": "train", "held_out/1.png": "test"}
    assert {frame.name: frame.split for frame in frames} == splits


def test_nerfstudios_split_points_and_masks(tmp_path: Path) -> None:
    path = make(tmp_path, 3, test_filenames=["./images/1.png"], ply_file_path="sparse.ply", mask_path="m.png")
    change_frame(path, mask_path="m.png")
    header = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {name}\n" for name in "xyz")
    header += "".join(f"property uchar {name}\n" for name in ("red", "green", "blue")) + "end_header\n"
    (tmp_path / "sparse.ply").write_text(header + "1 2 3 255 0 51\n4 5 6 0 255 0\n")
    result = warned("'mask_path' is not used", read_transforms, path)
    assert [image.split for image in result.images] == ["train", "test", "train"]
    np.testing.assert_array_equal(result.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(result.colors, [[1, 0, 0.2], [0, 1, 0]])
    (tmp_path / "sparse.ply").unlink()
    assert any("sparse.ply" in warning for warning in warnings_of(lambda: read_transforms(path)))


@pytest.mark.parametrize(
    ("keys", "split"),
    [
        ({"train_filenames": ["images/0.png"]}, "train test test"),
        ({"val_filenames": ["images/0.png"], "test_filenames": ["images/2.png"]}, "test train test"),
        ({"train_filenames": ["images/0.png"], "val_filenames": ["./images/1.png"]}, "train test test"),
        (
            {"train_filenames": [f"images/{n}.png" for n in range(3)], "val_filenames": ["images/1.png"]},
            "train test train",
        ),
        ({"train_filenames": [], "val_filenames": None}, "None None None"),
    ],
)
def test_what_nerfstudio_does_not_train_on_is_held_out(tmp_path: Path, keys: dict[str, Any], split: str) -> None:
    path = make(tmp_path, 3, **keys)
    assert [str(image.split) for image in read_transforms(path).images] == split.split()
    assert warnings_of(lambda: read_transforms(path)) == []


def test_a_split_that_makes_no_sense(tmp_path: Path) -> None:
    every = ["images/0.png", "images/1.png"]
    with pytest.raises(InputError, match="hold out all 2 pictures, expected some to train on; remove these keys"):
        read_transforms(make(tmp_path, val_filenames=every[:1], test_filenames=every[1:]))
    with pytest.raises(InputError, match="'val_filenames' is 'images', expected a list of file names"):
        read_transforms(make(tmp_path, val_filenames="images"))
    path = make(tmp_path, test_filenames=["images/1.png", "a.png", "b.png", "c.png", "d.png"])
    lost = "lists a.png, b.png, c.png and 1 more, but no frame has such a 'file_path'; these are ignored"
    assert warnings_of(lambda: read_transforms(path)) == [f"{path}: 'test_filenames' {lost}"]


@pytest.mark.parametrize(("keys", "size"), [({"w": 24}, (24, 16)), ({"h": 4}, (6, 4))])
def test_one_side_alone_has_the_other_in_proportion(
    tmp_path: Path, keys: dict[str, Any], size: tuple[int, int]
) -> None:
    lens = read_transforms(make(tmp_path, **keys)).images[0].lens
    assert (lens.width, lens.height) == size
    assert lens.params == (10, 10, size[0] / 2, size[1] / 2)


def test_an_angle_that_contradicts_the_focal_length_is_told(tmp_path: Path) -> None:
    path = make(tmp_path, 5, camera_angle_x=2 * math.atan(6 / 10.1))  # 1 % off, as rounding may be
    assert warnings_of(lambda: read_transforms(path)) == []
    path = make(tmp_path, 5, camera_angle_x=math.pi / 2)
    change_frame(path, fl_x=20.0)  # of this frame alone, and the angle of the others
    pictures = ", ".join(f"images/{n}.png (10, not 6)" for n in (0, 2, 3))
    told = f"{path}: 'fl_x' is used; it contradicts 'camera_angle_x' for {pictures} and 1 more"
    assert warnings_of(lambda: read_transforms(path)) == [told]
    warned("it contradicts 'camera_angle_x'", read_poses, path)


def test_a_rolling_shutter_is_told(tmp_path: Path) -> None:
    assert warnings_of(lambda: read_transforms(make(tmp_path, rolling_shutter=[0, 0, 0, 0]))) == []
    path = make(tmp_path, rolling_shutter=[0, 0, 0.03, 0])
    assert ["'rolling_shutter' is ignored" in text for text in warnings_of(lambda: read_transforms(path))] == [True]


def test_an_absurd_lens_is_told_where_cameras_alone_are_read(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=r"images/0\.png, images/1\.png distorts the picture implausibly \(OPENCV"):
        read_poses(make(tmp_path, k1=5.0))


def test_point_clouds(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    names = "".join(f"property double {name}\n" for name in "xyz")
    head = f"ply\nformat binary_big_endian 1.0\nelement vertex 3\n{names}end_header\n".encode()
    points = np.arange(9.0).reshape(3, 3)
    path.write_bytes(head + points.astype(">f8").tobytes())
    found, colors = read_point_cloud(path)
    np.testing.assert_array_equal(found, points)
    assert (colors == 0.5).all()
    path.write_bytes(head + points.astype(">f8").tobytes()[:-1])
    refuses(r"a\.ply: truncated", read_point_cloud, path)
    path.write_bytes(head + np.full((3, 3), np.nan, ">f8").tobytes())
    refuses("3 of 3 points have values that are not finite", read_point_cloud, path)


def test_ngps_volume(tmp_path: Path) -> None:
    assert read_transforms(make(tmp_path)).box is None
    box = read_transforms(make(tmp_path, aabb_scale=4)).box
    np.testing.assert_allclose(box, [[-2 / 0.33] * 3, [2 / 0.33] * 3])
    box = read_transforms(make(tmp_path, aabb_scale=1, scale=1, offset=[0, 0, 0.5])).box
    np.testing.assert_allclose(box, [[0, 0, -0.5], [1, 1, 0.5]])


@pytest.mark.needs("scenes")
def test_lego() -> None:
    frames = read_blender(SCENES / "lego_blender_400").images
    assert sum(frame.split == "train" for frame in frames) == 87
    assert sum(frame.split == "test" for frame in frames) == 13
    for frame in frames:
        # every camera of the synthetic scenes looks at the origin from 4.03 away
        x, y, depth = frame.translation
        assert (x, y, depth) == pytest.approx((0, 0, 4.031), abs=2e-3)
        assert frame.lens.params[0] == pytest.approx(0.5 * 400 / math.tan(0.5 * 0.6911112070083618))

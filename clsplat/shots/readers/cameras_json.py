# SPDX-License-Identifier: Apache-2.0
"""cameras.json, which the 3DGS authors' train.py writes with its models: a list with one object per photograph.

The values follow `camera_to_JSON` in utils/camera_utils.py of graphdeco-inria/gaussian-splatting. `position` is the
camera's centre, and `rotation` the rows of world_from_camera in COLMAP's axes. `fx` and `fy` are in pixels of a picture
of `width` by `height`. The principal point is the picture's centre, unless another program has written `cx` and `cy` in
pixels. SuperSplat imports the same format (src/json-types.ts), where only position and rotation are required.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float64, numbers
from clsplat.camera import MAX_FOCAL_PX, Camera
from clsplat.errors import InputError
from clsplat.scenes.camera_json import Keys, short
from clsplat.shots.shot import MAX_SHOT_FRAMES, Frame, Shot

CAMERAS_JSON_NAME = "cameras.json"
"""Name of the cameras' file in the output folder of a 3DGS training."""
CAMERAS_JSON_ROTATION_TOLERANCE = 1e-2
"""Largest accepted difference between R^T R and the identity matrix, where R is the rotation of an entry."""


def read_cameras_json(path: Path, entries: list[Any], size: tuple[int | None, int | None]) -> Shot:
    """Read a cameras.json: a frame for each entry, numbered from 1 and named by `img_name`.

    entries: the file's parsed list.
    size: width and height for entries that have none.
    In a Blender scene two frames may share a name, as training and test pictures do. Raises InputError, naming the file
    and the entry, for a list of other values, and for missing or invalid values.
    """
    expected = "an object with 'position', 'rotation', 'width', 'height', 'fx' and 'fy'"
    if not any(map(_is_camera, entries)):
        what = f"a list that begins with {_json(entries[0])}" if entries else "an empty list"
        raise InputError(f"{path}: is {what}, expected the cameras of a 3DGS training, each {expected}")
    for number, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise InputError(f"{path}: camera {number} is {_json(entry)}, expected {expected}")
        if lacks := [f"'{key}'" for key in ("position", "rotation") if entry.get(key) is None]:
            raise InputError(
                f"{path}: camera {number}{_called(entry)}: has no {' and no '.join(lacks)}, expected {expected}"
            )
    if len(entries) > MAX_SHOT_FRAMES:
        raise InputError(f"{path}: has {len(entries):,} cameras, expected at most {MAX_SHOT_FRAMES:,}")
    frames = []
    for number, entry in enumerate(entries, 1):
        name = entry.get("img_name")
        keys = Keys(path, f"camera {number - 1}{_called(entry)}", entry, {})
        if not isinstance(name, str) or not name.strip():
            name = f"{number:04d}"
        frames.append(Frame(number, _camera(keys, size), name.replace("\\", "/")))
    return Shot(tuple(frames))


def _is_camera(entry: object) -> bool:
    return isinstance(entry, dict) and {"position", "rotation"} <= entry.keys()


def _called(entry: dict[str, Any]) -> str:
    """Return an entry's name as " (NAME)", to put after its number in an error message; "" if it has no name."""
    name = entry.get("img_name")
    return f" ({name[:80]})" if isinstance(name, str) and name.strip() else ""


def _json(value: object) -> str:
    """Write a value as in the JSON file, possibly shortened, for an error message."""
    return json.dumps(value) if value is None or isinstance(value, bool) else short(value)


def _camera(keys: Keys, size: tuple[int | None, int | None]) -> Camera:
    for key, side in zip(("width", "height"), size, strict=True):
        if keys.frame.get(key) is None and side is not None:
            keys.frame = {**keys.frame, key: side}
    width, height = keys.side("width"), keys.side("height")
    fx = keys.require("fx", keys.number("fy"))
    fy = keys.require("fy", fx)
    for key, focal in (("fx", fx), ("fy", fy)):
        if not 0 < focal <= MAX_FOCAL_PX:
            raise keys.wrong(key, f"pixels above 0, at most {MAX_FOCAL_PX:g}")
    rotation = _rotation(keys)
    translation = -rotation @ keys.vector("position", 3)
    cx, cy = keys.require("cx", width / 2), keys.require("cy", height / 2)
    return Camera(width, height, fx, fy, cx, cy, rotation, translation)


def _rotation(keys: Keys) -> Float64:
    """Return the rotation (3, 3) of `cam_from_world` of an entry, made exactly orthogonal.

    Raises InputError if the entry's 'rotation' is not a rotation within CAMERAS_JSON_ROTATION_TOLERANCE.
    """
    rows = numbers(keys.frame["rotation"])
    if rows.shape != (3, 3) or not np.isfinite(rows).all():
        raise keys.wrong("rotation", "three rows of three numbers")
    if np.abs(rows.T @ rows - np.eye(3)).max() > CAMERAS_JSON_ROTATION_TOLERANCE or np.linalg.det(rows) < 0:
        raise InputError(
            f"{keys.where}: 'rotation' is not a rotation (determinant {np.linalg.det(rows):.3g}), expected the rows of "
            "world_from_camera; check how it was exported"
        )
    u, _, v = np.linalg.svd(rows)
    cam_from_world: Float64 = (u @ v).T
    return cam_from_world

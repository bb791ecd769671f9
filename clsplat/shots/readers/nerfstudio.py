# SPDX-License-Identifier: Apache-2.0
"""Reader of nerfstudio's camera_path.json, as its viewer and its Blender add-on write it: one camera per frame.

Formulas follow nerfstudio's `get_path_from_json`. Pixels are square, the principal point is the picture's centre, and
`fov` is the vertical field of view in degrees. A fisheye's focal length is computed from `fov` by the formula for
perspective cameras.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from clsplat.camera import Camera, model_with, names_of
from clsplat.cameras.model import CameraModel
from clsplat.errors import InputError
from clsplat.scenes.camera_json import Keys, objects, short
from clsplat.scenes.readers.transforms import opengl_pose
from clsplat.shots.shot import Shot, numbered

NERFSTUDIO_CAMERA_TYPES = names_of("nerfstudio")


def read_camera_path(path: Path, document: dict[str, Any]) -> Shot:
    """Read frames numbered from 1, one for each entry of `camera_path`, with times if the file has `fps`.

    Raises InputError, naming the file and the entry, for no keys, no size, an unknown camera type, an invalid pose or
    an invalid field of view.
    """
    if not (entries := objects(document, "camera_path")):
        keys = document.get("keyframes")
        but = f"{len(keys)} 'keyframes', but " if isinstance(keys, list) and keys else ""
        raise InputError(
            f"{path}: has {but}no keys in 'camera_path' (a camera for each frame); export the path again from the "
            "viewer"
        )
    kind = document.get("camera_type") or Camera.projection
    if not isinstance(kind, str) or kind.lower() not in NERFSTUDIO_CAMERA_TYPES:
        raise InputError(
            f"{path}: 'camera_type' is {short(kind)}, expected one of {', '.join(NERFSTUDIO_CAMERA_TYPES)}"
        )
    whole = Keys(path, None, {}, document)
    width, height, fps = whole.side("render_width"), whole.side("render_height"), whole.number("fps")
    readers = [Keys(path, f"key {index}", entry, {}) for index, entry in enumerate(entries)]
    model = model_with("nerfstudio", kind.lower())
    assert model is not None
    cameras = [_camera(reader, model, width, height) for reader in readers]
    fps = fps if fps and fps > 0 else None
    return Shot(numbered(cameras, fps=fps), fps=fps)


def _camera(keys: Keys, model: CameraModel, width: int, height: int) -> Camera:
    given = keys.frame.get("camera_to_world")
    if isinstance(given, list) and len(given) == 16:
        given = [given[row : row + 4] for row in range(0, 16, 4)]
    rotation, translation, _ = opengl_pose(given, keys.where, "'camera_to_world'")
    if model.wraps:
        lens = model.whole(width, height)
    else:
        degrees = keys.number("fov")
        if degrees is None or not 0 < degrees < 180:
            raise keys.wrong("fov", "the vertical angle of view, 0 to 180 degrees")
        focal = keys.focal("fov", height)
        lens = focal, focal, width / 2, height / 2
    return Camera(width, height, *lens, rotation, translation).through(model)

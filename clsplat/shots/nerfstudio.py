# SPDX-License-Identifier: Apache-2.0
"""nerfstudio's camera_path.json, as its viewer and its Blender add-on write it: one camera a frame.

Its formulas are those of nerfstudio's `get_path_from_json`. Pixels are square, the principal point is in the middle,
and `fov` is the vertical angle of view in degrees. A fisheye takes its focal length from it as a perspective
camera does.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

from clsplat.camera import Camera, Projection
from clsplat.errors import InputError
from clsplat.scenes.camera_json import Keys, objects, short
from clsplat.scenes.transforms import opengl_pose
from clsplat.shots.shot import Shot, numbered

TYPES = ("perspective", "fisheye", "equirectangular")


def read_camera_path(path: Path, document: dict[str, Any]) -> Shot:
    """Frames from 1 on, one for each entry of `camera_path`; times where the file has `fps`.

    Raises InputError, with the file and the entry, for one without keys, without a size, of another camera type, with
    a pose that is none or an angle of view that cannot be.
    """
    if not (entries := objects(document, "camera_path")):
        keys = document.get("keyframes")
        but = f"{len(keys)} 'keyframes', but " if isinstance(keys, list) and keys else ""
        raise InputError(
            f"{path}: has {but}no keys in 'camera_path' (a camera for each frame); export the path again from the "
            "viewer"
        )
    kind = document.get("camera_type") or "perspective"
    if not isinstance(kind, str) or kind.lower() not in TYPES:
        raise InputError(f"{path}: 'camera_type' is {short(kind)}, expected one of {', '.join(TYPES)}")
    whole = Keys(path, None, {}, document)
    width, height, fps = whole.side("render_width"), whole.side("render_height"), whole.number("fps")
    readers = [Keys(path, f"key {index}", entry, {}) for index, entry in enumerate(entries)]
    cameras = [_camera(reader, cast("Projection", kind.lower()), width, height) for reader in readers]
    fps = fps if fps and fps > 0 else None
    return Shot(numbered(cameras, fps=fps), fps=fps)


def _camera(keys: Keys, projection: Projection, width: int, height: int) -> Camera:
    given = keys.frame.get("camera_to_world")
    if isinstance(given, list) and len(given) == 16:
        given = [given[row : row + 4] for row in range(0, 16, 4)]
    rotation, translation, _ = opengl_pose(given, keys.where, "'camera_to_world'")
    if projection == "equirectangular":
        fx, fy = width / (2 * math.pi), height / math.pi
    else:
        degrees = keys.number("fov")
        if degrees is None or not 0 < degrees < 180:
            raise keys.wrong("fov", "the vertical angle of view, 0 to 180 degrees")
        fx = fy = keys.focal("fov", height)
    return Camera(width, height, fx, fy, width / 2, height / 2, rotation, translation, projection=projection)

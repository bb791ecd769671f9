# SPDX-License-Identifier: Apache-2.0
"""nerfstudio's camera_path.json, as its viewer and its Blender add-on write it: one camera a frame.

Its formulas are those of nerfstudio's `get_path_from_json`: square pixels, the principal point in the middle, `fov`
the vertical angle of view in degrees, from which a fisheye takes its focal length as a perspective camera does.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, cast

from clsplat.camera import Camera, Projection, focal_length
from clsplat.errors import InputError
from clsplat.scenes.lens import MAX_SIZE
from clsplat.scenes.transforms import Keys, opengl_pose, short
from clsplat.shots.shot import Shot, numbered

TYPES = ("perspective", "fisheye", "equirectangular")


def read_camera_path(path: Path, document: dict[str, Any]) -> Shot:
    """Frames from 1 on, one for each entry of `camera_path`; times where the file has `fps`.

    Raises InputError, with the file and the entry, for one without keys, without a size, of another camera type, with
    a pose that is none or an angle of view that cannot be.
    """
    entries = document.get("camera_path")
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        keys = document.get("keyframes")
        found = f"has {len(keys)} 'keyframes', but " if isinstance(keys, list) and keys else "has "
        raise InputError(
            f"{path}: {found}no keys in 'camera_path' (a camera for each frame); export the path again from the viewer"
        )
    kind = document.get("camera_type") or "perspective"
    if not isinstance(kind, str) or kind.lower() not in TYPES:
        raise InputError(f"{path}: 'camera_type' is {short(kind)}, expected one of {', '.join(TYPES)}")
    whole = Keys(path, None, {}, document)
    width, height = image_side(whole, "render_width"), image_side(whole, "render_height")
    fps = whole.number("fps")
    projection = cast("Projection", kind.lower())
    cameras = [
        _camera(Keys(path, f"key {index}", entry, {}), projection, width, height) for index, entry in enumerate(entries)
    ]
    fps = fps if fps and fps > 0 else None
    return Shot(numbered(cameras, fps=fps), fps=fps)


def image_side(keys: Keys, key: str) -> int:
    """Width or height in pixels. Raises InputError."""
    side = keys.number(key)
    if side is None or not 1 <= side <= MAX_SIZE or side != round(side):
        found = f"has no '{key}'" if side is None else f"'{key}' is {side:g}"
        raise InputError(f"{keys.where}: {found}, expected a whole number of pixels from 1 to {MAX_SIZE}")
    return round(side)


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
            found = "has no 'fov'" if degrees is None else f"'fov' is {degrees:g}"
            raise InputError(f"{keys.where}: {found}, expected the vertical angle of view, 0 to 180 degrees")
        try:
            fx = fy = focal_length(math.radians(degrees), height)
        except ValueError as error:
            raise InputError(f"{keys.where}: 'fov': {error}") from None
    return Camera(width, height, fx, fy, width / 2, height / 2, rotation, translation, projection=projection)

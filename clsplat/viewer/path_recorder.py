# SPDX-License-Identifier: Apache-2.0
"""Recording of key frames in the viewer, and their camera file for `clsplat render` (docs/cameras.md)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

from typing_extensions import NotRequired, TypedDict

from clsplat.config.pictures import DEFAULT_VIDEO_FPS
from clsplat.errors import InputError
from clsplat.files.atomic import atomic_write
from clsplat.rotations import quaternion_of
from clsplat.viewer.pose import Pose

MAX_KEY_FRAMES = 10_000
MAX_PATH_FILES = 10_000


class KeyFrame(TypedDict):
    """A key frame in a camera file. world_from_cam: quaternion. fov_y: vertical field of view in degrees."""

    frame: int
    position: list[float]
    world_from_cam: list[float]
    fov_y: float


class CameraFileHead(TypedDict):
    """Head of a camera file. loop_frames: number of frames after which a closed path is back at its first key."""

    clsplat_cameras: int
    width: int
    height: int
    fps: float
    loop_frames: NotRequired[int]


class CameraFile(CameraFileHead):
    """A camera file of key frames."""

    keys: list[KeyFrame]


def add_key(keys: list[Pose], pose: Pose) -> None:
    """Append a key frame. Raises InputError if the path has MAX_KEY_FRAMES already."""
    if len(keys) >= MAX_KEY_FRAMES:
        raise InputError(f"there are {MAX_KEY_FRAMES:,} key frames already, expected fewer")
    keys.append(pose)


def path_document(
    keys: Sequence[Pose],
    size: tuple[int, int],
    *,
    apart: float = 2.0,
    fps: float = DEFAULT_VIDEO_FPS,
    loop: bool = False,
) -> str:
    """Return the camera file of the key frames, as JSON text.

    size: width and height of the frames in pixels.
    apart: seconds between keys, rounded to whole frames.
    loop: True to return to the first key frame after the last one.
    Raises InputError if there are no keys, and for numbers out of range.
    """
    width, height = size
    if not keys:
        raise InputError("no key frames are recorded yet, expected at least one")
    if not (1 <= width <= 1 << 15 and 1 <= height <= 1 << 15):
        raise InputError(f"the size is {width}x{height}, expected 1 to {1 << 15} pixels per side")
    if not (math.isfinite(apart) and math.isfinite(fps) and 0 < fps <= 1000 and 0 < apart <= 3600):
        raise InputError(
            f"{apart} seconds between keys, {fps} frames per second: expected more than 0, at most 3600 seconds and "
            "1000 frames per second"
        )
    step = max(round(apart * fps), 1)
    head: CameraFileHead = {"clsplat_cameras": 1, "width": width, "height": height, "fps": fps}
    if loop and len(keys) > 1:
        head["loop_frames"] = step * len(keys)
    frames: list[KeyFrame] = [
        {
            "frame": 1 + step * index,
            "position": [float(value) for value in pose.position],
            "world_from_cam": [float(value) for value in quaternion_of(pose.rotation)],
            "fov_y": math.degrees(pose.angle(width, height)),
        }
        for index, pose in enumerate(keys)
    ]
    contents: CameraFile = {**head, "keys": frames}
    return json.dumps(contents, indent=2) + "\n"


def save_path(folder: Path, document: str) -> Path:
    """Write a camera file to path-001.json, or with the next unused number. Returns the path.

    A page cannot choose the name, for safety. Raises OSError, and InputError if no number is unused.
    """
    for number in range(1, MAX_PATH_FILES):
        path = folder / f"path-{number:03d}.json"
        if not path.exists() and not path.is_symlink():
            atomic_write(path, document.encode())
            return path
    raise InputError(f"{folder}: has {MAX_PATH_FILES - 1:,} camera paths already, expected fewer; remove some")

# SPDX-License-Identifier: Apache-2.0
"""Key frames that are recorded in the viewer, as a file of cameras for `clsplat render` (docs/cameras.md)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from clsplat.errors import InputError
from clsplat.files import atomic_write
from clsplat.rotations import quaternion_of
from clsplat.viewer.pose import Pose

MOST_KEYS = 10_000
MOST_FILES = 10_000
FPS = 24.0


def add_key(keys: list[Pose], pose: Pose) -> None:
    """One more key frame at the end. Raises InputError when there are too many."""
    if len(keys) >= MOST_KEYS:
        raise InputError(f"there are {MOST_KEYS:,} key frames already")
    keys.append(pose)


def path_document(
    keys: Sequence[Pose], size: tuple[int, int], *, apart: float = 2.0, fps: float = FPS, loop: bool = False
) -> str:
    """The file. size: width, height of its pictures; apart: seconds from key to key, brought to whole frames; loop:
    after the last the first comes again. Raises InputError for no keys, and for numbers that make no path."""
    width, height = size
    if not keys:
        raise InputError("no key frames are recorded yet")
    if not (1 <= width <= 1 << 15 and 1 <= height <= 1 << 15):
        raise InputError(f"size {width} x {height}: expected 1 to {1 << 15} pixels a side")
    if not (math.isfinite(apart) and math.isfinite(fps) and 0 < fps <= 1000 and 0 < apart <= 3600):
        raise InputError(f"{apart} seconds at {fps} frames a second: expected up to 3600 and up to 1000")
    step = max(round(apart * fps), 1)
    contents: dict[str, Any] = {"clsplat_cameras": 1, "width": width, "height": height, "fps": fps}
    if loop and len(keys) > 1:
        contents["loop_frames"] = step * len(keys)
    contents["keys"] = [
        {
            "frame": 1 + step * index,
            "position": [float(value) for value in pose.position],
            "world_from_cam": [float(value) for value in quaternion_of(pose.rotation)],
            "fov_y": math.degrees(pose.angle(width, height)),
        }
        for index, pose in enumerate(keys)
    ]
    return json.dumps(contents, indent=2) + "\n"


def save_path(folder: Path, document: str) -> Path:
    """Write it as the first of path-001.json, path-002.json, ... that is free: a page has no say in the name. Raises
    OSError, and InputError where none is free."""
    for number in range(1, MOST_FILES):
        path = folder / f"path-{number:03d}.json"
        if not path.exists() and not path.is_symlink():
            atomic_write(path, document.encode())
            return path
    raise InputError(f"{folder}: has {MOST_FILES - 1:,} paths already")

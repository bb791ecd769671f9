# SPDX-License-Identifier: Apache-2.0
"""Camera files for tests of `clsplat render`, and what it has written."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from tiny import HEIGHT, WIDTH

from clsplat.arrays import Float32


def camera_file(
    path: Path, places: Mapping[float, float], *, size: tuple[int, int] = (WIDTH, HEIGHT), fov_x: float = 60
) -> Path:
    """A clsplat camera file: at these frames the camera is at these x, 4 before the origin."""
    lens = {"world_from_cam": [1, 0, 0, 0], "fov_x": fov_x}
    keys = [{"frame": frame, "position": [x, 0, -4], **lens} for frame, x in places.items()]
    path.write_text(json.dumps({"clsplat_cameras": 1, "width": size[0], "height": size[1], "keys": keys}))
    return path


def pixels_of(path: Path, part: int = 0) -> Float32:
    """(H, W, C) of a part of a file."""
    return np.asarray(oiio.ImageBuf(str(path), part, 0).get_pixels(oiio.FLOAT))


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a folder by their names."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}

# SPDX-License-Identifier: Apache-2.0
"""Camera files for tests of `clsplat render`, and reading of its frames."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from tiny import HEIGHT, WIDTH, hidden_model

from clsplat.arrays import Float32
from clsplat.cli.main import main

SHOT_FRAMES = 4
"""Number of frames of `shot_of_a_model`."""


def camera_file(
    path: Path,
    places: Mapping[float, float | Sequence[float]],
    *,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    fov_x: float = 60,
    lens: Mapping[str, Any] | None = None,
    **settings: Any,
) -> Path:
    """Write a clsplat camera file of cameras that look along +z. Returns its path.

    places: position by frame; a number x means (x, 0, -4).
    lens: properties of the lens, in place of `fov_x`.
    settings: further properties of the file.
    """
    own = {"world_from_cam": [1, 0, 0, 0], **(lens or {"fov_x": fov_x})}
    positions = {frame: [at, 0, -4] if isinstance(at, int | float) else [*at] for frame, at in places.items()}
    keys = [{"frame": frame, "position": position, **own} for frame, position in positions.items()]
    document = {"clsplat_cameras": 1, "width": size[0], "height": size[1], **settings, "keys": keys}
    path.write_text(json.dumps(document))
    return path


def pixels_of(path: Path, part: int = 0) -> Float32:
    """Pixels (H, W, C) of a part of a file."""
    return np.asarray(oiio.ImageBuf(str(path), part, 0).get_pixels(oiio.FLOAT))


def contents(folder: Path) -> dict[str, bytes]:
    """Contents of a folder's files, by name."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def shot_of_a_model(folder: Path) -> list[str]:
    """Write a model and a camera that goes to the right. Returns them as arguments of `clsplat render`."""
    hidden_model().save(folder / "model.ply")
    cameras = camera_file(folder / "cameras.json", {1: -0.5, SHOT_FRAMES: 0.5})
    return [str(folder / "model.ply"), "--cameras", str(cameras)]


def render_shot(shot: list[str], folder: Path, flags: str = "", pattern: str = "a.####.exr") -> int:
    """The exit status of `clsplat render` for a shot."""
    return main(["render", *shot, "-o", str(folder / pattern), "--progress", "none", *flags.split()])

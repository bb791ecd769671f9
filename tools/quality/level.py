# SPDX-License-Identifier: Apache-2.0
"""Measures how level scenes are after `--orient up`, by the cameras, the floor and walls.

    python tools/quality/level.py SCENE...

A row for each scene, with angles in degrees, "-" for none. "cameras": between -y and the cameras' own up direction.
"floor": between -y and a level plane of every second point, where up was found with the other points. "wall": between
the vertical and the largest plane within 10 degrees of it.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.arrays import Float64
from clsplat.config.orientation import FrameUse
from clsplat.scenes.dataset import SOURCE_FRAME
from clsplat.scenes.orientation.level import COLMAP_UP, up_axis
from clsplat.scenes.orientation.new_frame import in_frame, new_frame
from clsplat.scenes.orientation.plane import in_reach, level_plane
from clsplat.scenes.orientation.upright import PLANE_REACH, middle_of
from clsplat.scenes.readers.colmap import find_model, read_model

UP = np.array(COLMAP_UP)
MAX_TILT_RADIANS = np.deg2rad(10.0)
"""Largest angle of a floor from level, and of a wall from upright, that counts."""
WALL_HEADINGS = 36
"""Number of directions in half a turn in which a wall is searched."""


def row(scene: Path) -> tuple[str, str, str, str, str]:
    """Return the cells of a scene's row: name, angles of cameras, floor and wall, and what decided up."""
    model = find_model(scene)
    if model is None:
        raise SystemExit(f"{scene}: has no COLMAP model, expected a scene with sparse/0")
    data = read_model(model)
    half = replace(data, points=data.points[::2], colors=data.colors[::2])
    frame = new_frame(scene, half, {}, FrameUse("up"), SOURCE_FRAME, turned=False)
    turned = in_frame(data, frame.world_from_source)
    cameras = [image.lens.camera(image.rotation, image.translation, "undistort") for image in turned.images]
    middle, radius = middle_of(cameras, turned.points)
    others = turned.points[1::2]
    others = others[in_reach(others, middle, PLANE_REACH * radius)]
    floor = level_plane(others, UP, MAX_TILT_RADIANS, radius)
    return (
        scene.name,
        angle(up_axis(cameras), UP),
        "-" if floor is None else angle(floor.normal, UP),
        wall(others, radius),
        frame.up_note,
    )


def wall(points: Float64, radius: float) -> str:
    """Return the angle of the largest wall from the vertical in degrees, as text; "-" if there is no wall.

    radius: radius of the scene, as for `level_plane`.
    """
    best, found = 0.0, "-"
    for heading in np.pi * np.arange(WALL_HEADINGS) / WALL_HEADINGS:
        ahead = np.array([np.cos(heading), 0.0, np.sin(heading)])
        plane = level_plane(points, ahead, MAX_TILT_RADIANS, radius)
        if plane is not None and plane.share > best:
            best, found = plane.share, f"{np.rad2deg(np.arcsin(abs(plane.normal @ UP))):.1f}"
    return found


def angle(a: Float64, b: Float64) -> str:
    """Return the angle between two unit vectors in degrees, as text."""
    return f"{np.rad2deg(np.arccos(np.clip(a @ b, -1, 1))):.1f}"


if __name__ == "__main__":
    cells = [("scene", "cameras", "floor", "wall", "up"), *(row(Path(text)) for text in sys.argv[1:])]
    for name, *numbers, note in cells:
        print(f"{name:16}" + "".join(f"{number:>9}" for number in numbers) + f"  {note}")

# SPDX-License-Identifier: Apache-2.0
"""Ground of a scene: its up direction, and two horizontal axes that give each point its coordinates on the ground."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, sqrt

import numpy as np

from clsplat.arrays import Float64
from clsplat.blocks.plan import Axes, Point
from clsplat.errors import InputError
from clsplat.scenes.orientation.level import COLMAP_UP
from clsplat.scenes.orientation.upright import MIN_UPRIGHT_CAMERAS, upright
from clsplat.scenes.scene import Scene

UP_DECIMALS = 6
"""Decimals to which an estimated up direction is rounded.

Eigenvalue solvers differ in the last bits between machines. The rounding gives all machines the same axes, and tilts
the direction by at most a millionth of a radian.
"""


@dataclass(frozen=True)
class Ground:
    """Up direction of a scene, and its horizontal axes.

    up: unit vector in the world.
    axes: two unit vectors in the world, at right angles to `up` and to each other. Seen from above, the second is a
        quarter turn anticlockwise from the first.
    note: source of the up direction, for the user.
    """

    up: Point
    axes: Axes
    note: str


def ground_of(scene: Scene, given: Point | None) -> Ground:
    """Find the ground of a scene.

    given: the value of --up, of any length; None to take up from the scene's frame, else from its points and cameras.
    Raises InputError if up is not given and the scene has too few cameras to estimate it.
    """
    if given is not None:
        up, note = given, "up is from --up"
    elif scene.frame.upright:
        up, note = COLMAP_UP, "up is -y, as the scene is upright"
    else:
        cameras = [view.camera for view in scene.views if view.name not in scene.stray_cameras]
        if len(cameras) < MIN_UPRIGHT_CAMERAS:
            raise InputError(
                f"{scene.source or scene.name}: {len(cameras)} camera(s) do not tell which way is up, expected at "
                f"least {MIN_UPRIGHT_CAMERAS}, or --up X,Y,Z"
            )
        found = upright(cameras, scene.points)
        x, y, z = (round(float(value), UP_DECIMALS) for value in found.up)
        up, note = (x, y, z), found.note
    return Ground(_unit(up), axes_of_ground(up), note)


def axes_of_ground(up: Point) -> Axes:
    """Return two unit vectors at right angles to `up` and to each other, always with the same bits for the same `up`.

    up: of any length except 0.
    The first axis is the horizontal part of the world's x axis. It is the part of the y axis instead if x is the axis
    nearest to `up`. Only elementary operations are used, because linear algebra libraries round differently.
    """
    up = _unit(up)
    steepest = max(range(3), key=lambda index: (abs(up[index]), -index))
    world = 1 if steepest == 0 else 0
    slope = up[world]
    first = _unit((float(world == 0) - slope * up[0], float(world == 1) - slope * up[1], -slope * up[2]))
    second = (
        up[1] * first[2] - up[2] * first[1],
        up[2] * first[0] - up[0] * first[2],
        up[0] * first[1] - up[1] * first[0],
    )
    return first, _unit(second)


def on_ground(points: Float64, axes: Axes) -> Float64:
    """Return the coordinates (N, 2) on the ground of points (N, 3) in the world."""
    columns = [points[:, 0] * axis[0] + points[:, 1] * axis[1] + points[:, 2] * axis[2] for axis in axes]
    return np.stack(columns, axis=1)


def parse_up(text: str) -> Point:
    """Parse the value of --up, such as "0,-1,0". Raises InputError."""
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        x = y = z = 0.0
    if not (isfinite(x) and isfinite(y) and isfinite(z)) or x == y == z == 0:
        raise InputError(f"--up {text}: expected three numbers X,Y,Z that are not all zero, such as 0,-1,0")
    return x, y, z


def _unit(vector: Point) -> Point:
    largest = max(abs(value) for value in vector)  # the squares of a long or short vector would not be finite, or zero
    x, y, z = (value / largest for value in vector)
    length = sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length

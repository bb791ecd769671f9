# SPDX-License-Identifier: Apache-2.0
"""Pose of a page's camera, and the pose that it starts with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial.transform import Rotation

from clsplat.arrays import Float64
from clsplat.camera import Camera, focal_length
from clsplat.rotations import quaternion_of, rotation_from_quaternion
from clsplat.scenes.strays import stray_cameras
from clsplat.shots.viewpoints import COLMAP_UP, extent_of, focus_point, look_at, up_axis

MOST_PIXELS = 4096 * 2304
"""Most pixels of a picture on a page, whatever size the browser asks for."""
LARGEST_SIDE = 16384
FIELD = math.radians(60)
"""Vertical angle of view where no camera of a scene says another."""
WIDEST = math.radians(120)
"""Largest vertical angle that a narrow page begins with: beyond it little but what is above and below is added."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of a browser's camera. rotation (3, 3): world from camera (x right, y down, z forward); position (3,) in the
    world; fov: vertical, radians; width, height of the page in pixels."""

    rotation: Float64
    position: Float64
    fov: float
    width: int
    height: int

    def camera(self, width: int | None = None, height: int | None = None) -> Camera:
        """The camera, of the page's size or another, with the `angle` of that. It is to the last bit the one that a
        file of cameras holds (`path_document`), as a quaternion and degrees."""
        across, down = width or self.width, height or self.height
        focal = focal_length(math.radians(math.degrees(self.angle(across, down))), down)
        quaternion = quaternion_of(self.rotation)
        turn = rotation_from_quaternion(quaternion / float(np.linalg.norm(quaternion))).T
        return Camera(across, down, focal, focal, across / 2, down / 2, turn, -turn @ self.position)

    def angle(self, width: int, height: int) -> float:
        """The vertical angle of a picture of this size: the page's. Of an upright page, which is higher than anything
        that it shows, a wider picture keeps the angle across, and one wider than high has that angle down."""
        page, picture = self.width / self.height, min(width / height, 1.0)
        return self.fov if page >= picture else 2 * math.atan(math.tan(0.5 * self.fov) * page / picture)

    def same(self, other: Pose | None) -> bool:
        """True if the other shows the same."""
        names = [item.name for item in fields(self)]
        return other is not None and all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)


def read_pose(
    wxyz: Sequence[float] | Float64,
    position: Sequence[float] | Float64,
    fov: float,
    size: tuple[int, int],
    origin: Float64,
) -> Pose | None:
    """The pose that a browser sends: the rotation from its axes (COLMAP's) to the world's as a quaternion w x y z, the
    position counted from `origin` (3,), the vertical angle in radians, width and height. None for values that no camera
    has: a browser may send anything."""
    try:
        turn, place = np.asarray(wxyz, np.float64), np.asarray(position, np.float64)
        angle, (width, height) = float(fov), (int(side) for side in size)
    except (TypeError, ValueError, OverflowError):
        return None
    if turn.shape != (4,) or place.shape != (3,) or not (np.isfinite(turn).all() and np.isfinite(place).all()):
        return None
    length = float(np.linalg.norm(turn))
    if not (0 < angle < math.pi and 1e-3 < length < 1e3 and np.abs(place).max() < 1e12):
        return None
    if not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE):
        return None
    return Pose(rotation_from_quaternion(turn / length), place + origin, angle, width, height)


@dataclass(frozen=True, eq=False)
class Start:
    """Start of a page: a camera in the world, the point that it turns about, and the direction that is up there.
    aspect: width by height of what is to be seen at the vertical angle `fov`."""

    position: Float64
    target: Float64
    up: Float64
    fov: float
    aspect: float = 1.0

    def fov_on(self, width: int, height: int) -> float:
        """The vertical angle on a page of this size: the start's, or as much more as a narrow page, such as a phone's
        that is held upright, takes to show it from side to side."""
        return wide_enough(self.fov, self.aspect, width, height)


def wide_enough(fov: float, aspect: float, width: int, height: int) -> float:
    """The vertical angle, radians, on a page of this size at which all of a picture is seen whose vertical angle is
    `fov` and whose width by height is `aspect`; `WIDEST` at most, and not less than `fov`."""
    more = aspect * height / max(width, 1)
    return max(fov, min(2 * math.atan(math.tan(0.5 * fov) * more), WIDEST)) if more > 1 else fov


def start_of(cameras: Sequence[Camera], points: Float64) -> Start:
    """The start at the first of the cameras that is no stray, about the point that the others look at. Without cameras:
    before the points (N, 3) as a COLMAP scene would be seen, y down, looking along z. All vectors are in the world."""
    if cameras:
        cameras = [camera for camera, far in zip(cameras, stray_cameras(cameras), strict=True) if not far]
        first, focus, up = cameras[0], focus_point(cameras), up_axis(cameras)
        ahead = first.rotation[2]
        distance = float((focus - first.position) @ ahead)
        away = float(np.linalg.norm(focus - first.position))
        if not distance > 1e-6 * away:
            distance = away or 1.0
        if first.projection != "perspective":
            return Start(first.position, first.position + distance * ahead, up, FIELD)
        fov, aspect = 2 * math.atan2(0.5 * first.height, first.fy), (first.width / first.fx) / (first.height / first.fy)
        return Start(first.position, first.position + distance * ahead, up, fov, aspect)
    low, high = extent_of(points)
    middle = 0.5 * (low + high)
    distance = 0.6 * float(np.linalg.norm(high - low)) / math.tan(FIELD / 2) or 1.0
    return Start(middle - [0.0, 0.0, distance], middle, np.array(COLMAP_UP), FIELD)


def leaning(up: Float64, ahead: Float64, degrees: float) -> Float64 | None:
    """The direction that is up for a camera that looks `ahead` and is rolled, clockwise as seen from behind it: `up`
    turned about that axis, a unit vector (3,). None for a camera that looks along `up`."""
    length = float(np.linalg.norm(ahead) * np.linalg.norm(up))
    if not float(np.linalg.norm(np.cross(ahead, up))) > 1e-3 * length:
        return None
    turn = Rotation.from_rotvec(math.radians(degrees) * ahead / np.linalg.norm(ahead))
    return np.asarray(turn.apply(up / np.linalg.norm(up)))


def looking(start: Start, size: tuple[int, int]) -> Pose:
    """The pose of the start on a page of this size."""
    rotation, _ = look_at(start.position, start.target, start.up)
    return Pose(rotation.T, start.position, start.fov_on(*size), *size)


def fitted(width: int, height: int, scale: float, most: float = MOST_PIXELS) -> tuple[int, int]:
    """Width and height of a picture at this scale of the page, and of `most` pixels at most."""
    scale = min(scale, math.sqrt(most / (width * height)))
    return max(1, round(width * scale)), max(1, round(height * scale))

# SPDX-License-Identifier: Apache-2.0
"""What each who watches gets to see next: cameras, coarse pictures in motion, exact ones at rest, shares of a training.

No OpenCL and no viser. Times are seconds of any clock that does not go back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera, focal_length
from clsplat.scenes.colmap import rotation_from_quaternion
from clsplat.shots.viewpoints import focus_point, look_at, up_axis

Float64 = NDArray[np.float64]

SETTLE = (0.2, 1.0)
"""Seconds without a change after which a picture is refined: at least; at most, where a slow browser's camera jumps."""
START = 0.5
"""The same for the first picture of all, which the browser has to get ready to show."""
JUMPS = 3.0
"""A camera that has not changed for so many times as long as it usually takes is at rest."""
TARGET = 0.04
"""Seconds that a picture in motion may take, with its encoding: what the browser needs comes on top."""
PATIENCE = 0.6
"""An exact picture that takes longer is led up to by pictures of growing size."""
SMALLEST = 1 / 8
"""Of the page's size: a coarser picture would not be told apart from another."""
QUALITIES = (60, 95)
"""Of JPEG, in motion and at rest."""
MOST_PIXELS = 4096 * 2304
"""Of a picture on a page, whatever the browser says of its size."""
LARGEST_SIDE = 16384
SHARES = (0.2, 0.05)
"""Of the time of a training: for one who moves, and for those who just watch."""
FIELD = math.radians(60)
"""Vertical angle of view where no camera of a scene says another."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Where the browser looks from. rotation (3, 3): world from camera (x right, y down, z forward); position (3,) in
    the world; fov: vertical, radians; width, height of the page in pixels."""

    rotation: Float64
    position: Float64
    fov: float
    width: int
    height: int

    def camera(self, width: int | None = None, height: int | None = None) -> Camera:
        """Of the page's size or another; where that has another shape, the vertical angle is kept. To the last bit as a
        file of cameras has it (`Recorder.document`), which holds a quaternion and degrees."""
        across, down = width or self.width, height or self.height
        focal = focal_length(math.radians(math.degrees(self.fov)), down)
        quaternion = quaternion_of(self.rotation)
        turn = rotation_from_quaternion(quaternion / float(np.linalg.norm(quaternion))).T
        return Camera(across, down, focal, focal, across / 2, down / 2, turn, -turn @ self.position)

    def same(self, other: Pose | None) -> bool:
        """Whether the other shows the same."""
        return (
            other is not None
            and (self.fov, self.width, self.height) == (other.fov, other.width, other.height)
            and np.array_equal(self.position, other.position)
            and np.array_equal(self.rotation, other.rotation)
        )


def read_pose(
    wxyz: Sequence[float] | Float64,
    position: Sequence[float] | Float64,
    fov: float,
    size: tuple[int, int],
    origin: Float64,
) -> Pose | None:
    """What a browser says of its camera: the rotation from its axes (COLMAP's) to the world's as a quaternion w x y z,
    the position counted from `origin` (3,), the vertical angle in radians, width and height. None for what no camera
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


def quaternion_of(rotation: Float64) -> Float64:
    """w x y z, w at least 0, of a rotation (3, 3)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    found = np.array([w, x, y, z])
    return found if w >= 0 else -found


@dataclass(frozen=True, eq=False)
class Start:
    """How a page begins: a camera in the world, what it turns about, and what is up for that alone."""

    position: Float64
    target: Float64
    up: Float64
    fov: float


def start_of(cameras: Sequence[Camera], points: Float64) -> Start:
    """Where the first of the cameras stands, about the point that all of them look at. Without cameras: before the
    points (N, 3) as a COLMAP scene would be seen: y down, looking along z. All of it in the world."""
    if cameras:
        first, focus, up = cameras[0], focus_point(cameras), up_axis(cameras)
        ahead = first.rotation[2]
        distance = float((focus - first.position) @ ahead)
        away = float(np.linalg.norm(focus - first.position))
        if not distance > 1e-6 * away:
            distance = away or 1.0
        fov = 2 * math.atan2(0.5 * first.height, first.fy) if first.projection == "perspective" else FIELD
        return Start(first.position, first.position + distance * ahead, up, fov)
    low, high = extent_of(points)
    middle = 0.5 * (low + high)
    distance = 0.6 * float(np.linalg.norm(high - low)) / math.tan(FIELD / 2) or 1.0
    return Start(middle - [0.0, 0.0, distance], middle, np.array([0.0, -1.0, 0.0]), FIELD)


def looking(start: Start, size: tuple[int, int]) -> Pose:
    """The pose of the start on a page of this size."""
    rotation, _ = look_at(start.position, start.target, start.up)
    return Pose(rotation.T, start.position, start.fov, *size)


def extent_of(points: NDArray[Any], inside: float = 0.96) -> tuple[Float64, Float64]:
    """Two corners (3,) of the box that holds this part of the points along each axis: strays are many in models."""
    if not len(points):
        return -np.ones(3), np.ones(3)
    some = points[:: max(1, len(points) // 100_000)]
    low, high = np.quantile(some.astype(np.float64), [0.5 - inside / 2, 0.5 + inside / 2], axis=0)
    return low, high


def fitted(width: int, height: int, scale: float, most: float = MOST_PIXELS) -> tuple[int, int]:
    """Width and height of a picture at this scale of the page, and of `most` pixels at most."""
    scale = min(scale, math.sqrt(most / (width * height)))
    return max(1, round(width * scale)), max(1, round(height * scale))


@dataclass(frozen=True)
class Level:
    """A picture that is due: its size in relation to the page's, and whether it is the last, which is exact."""

    scale: float
    exact: bool

    @property
    def quality(self) -> int:
        """Of JPEG."""
        return QUALITIES[self.exact]


class Pace:
    """Finds the size at which pictures in motion take the time that they may take."""

    def __init__(self, target: float = TARGET) -> None:
        self.target = target
        self.scale = 0.25
        self._exact = 0.0

    def moved(self, scale: float, seconds: float) -> None:
        """A picture in motion of this scale took so long. Part of that does not shrink with the pixels, so that the
        next size is found step by step."""
        factor = math.sqrt(self.target / max(seconds, 1e-4))
        self.scale = min(max(scale * min(max(factor, 0.6), 1.2), SMALLEST), 1.0)
        self._exact = max(self._exact, seconds)

    def rested(self, seconds: float) -> None:
        """An exact picture took so long."""
        self._exact = seconds

    @property
    def patient(self) -> bool:
        """Whether an exact picture may be begun at once, by the latest one."""
        return self._exact <= PATIENCE


class Refinement:
    """What one who watches sees, and what comes next: coarse in motion, finer at rest, exact in the end."""

    def __init__(self, now: float, pace: Pace | None = None) -> None:
        self.pace = pace or Pace()
        self.served = -math.inf
        self._changed, self._at = 1, now
        self._settle = START
        self._shown = 0
        self._model = 0
        self._level = Level(0.0, exact=False)

    @property
    def moving(self) -> bool:
        """Whether what is seen is not what is asked for."""
        return self._shown != self._changed

    def changed(self, now: float) -> None:
        """The camera, or how the model is looked at."""
        apart = now - self._at
        usual = JUMPS * apart if self._changed > 1 and apart < SETTLE[1] else 0.0
        before = self._settle if self._changed > 1 else 0.0
        self._settle = min(max(0.7 * before + 0.3 * usual, SETTLE[0]), SETTLE[1])
        self._changed += 1
        self._at = now

    def due(self, now: float, model: int = 0) -> Level | None:
        """The next picture, if its time has come; model: counts its changes, while it is trained."""
        if self.moving:
            return Level(self.pace.scale, exact=False)
        if now < self._at + self._settle or (self._level.exact and self._model == model):
            return None
        if self._level.exact or self.pace.patient or self._level.scale >= 0.5:
            return Level(1.0, exact=True)
        return Level(2 * self._level.scale, exact=False)

    def wait(self, now: float, model: int = 0) -> float | None:
        """Seconds until something is due, None if nothing will be by itself."""
        if self.due(now, model) is not None:
            return 0.0
        if self._level.exact and self._model == model:
            return None
        return max(0.0, self._at + self._settle - now)

    def begun(self) -> int:
        """Before a picture is made: what `shown` wants to know of it."""
        return self._changed

    def shown(self, begun: int, level: Level, seconds: float, now: float, model: int = 0) -> None:
        """A picture has been sent that took so long."""
        if level.exact:
            self.pace.rested(seconds)
        elif self._shown != begun:
            self.pace.moved(level.scale, seconds)
        self._shown, self._level, self._model, self.served = begun, level, model, now


class Share:
    """Keeps pictures to a share of a training's time."""

    def __init__(self, shares: tuple[float, float] = SHARES) -> None:
        self._moving, self._still = shares
        self._end, self._seconds = -math.inf, 0.0

    def ready(self, now: float, *, moving: bool) -> bool:
        """Whether another picture may be made."""
        share = self._moving if moving else self._still
        return now - self._end >= self._seconds * (1 - share) / share

    def spent(self, now: float, seconds: float) -> None:
        """A picture took so long, and is done now."""
        self._end, self._seconds = now, seconds

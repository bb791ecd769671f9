# SPDX-License-Identifier: Apache-2.0
"""Camera pose of a viewer's page: checks of a browser's data, field of view, and the start position."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial.transform import Rotation

from clsplat.arrays import Float64
from clsplat.camera import Camera, focal_length
from clsplat.images.video import MAX_VIDEO_SIDE_PX
from clsplat.rotations import quaternion_of, rotation_from_quaternion
from clsplat.scenes.orientation.level import COLMAP_UP, focus_point, up_axis
from clsplat.scenes.outliers import stray_cameras
from clsplat.shots.viewpoints import extent_of, look_at

MAX_PAGE_PICTURE_PIXELS = 4096 * 2304
"""Maximum number of pixels of a picture on a page, for any size that a browser requests."""
MAX_PAGE_SIDE_PX = MAX_VIDEO_SIDE_PX
"""Maximum side in pixels of a page and its pictures: the limit of videos, as a recorded path may become one."""
DEFAULT_FOV_Y_RADIANS = math.radians(60)
"""Vertical field of view in radians if no camera of the scene defines it."""
SAME_FOV = 1e-6
"""Relative difference up to which fields of view count as equal: browsers convert them between degrees and radians."""
MAX_START_FOV_Y_RADIANS = math.radians(120)
"""Maximum vertical field of view in radians at the start of a narrow page. More would mainly add space above and below
the model."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Pose of a browser's camera.

    rotation: (3, 3), world from camera (x right, y down, z forward).
    position: (3,), in the world.
    fov: vertical field of view in radians.
    width, height: size of the page in pixels.
    """

    rotation: Float64
    position: Float64
    fov: float
    width: int
    height: int

    def camera(self, width: int | None = None, height: int | None = None) -> Camera:
        """Return the camera for the size of the page, or for another size. The method `angle` gives its field of view.

        The camera's numbers have the same bits as if written to a camera file (`path_document`) and read again.
        """
        across, down = width or self.width, height or self.height
        focal = focal_length(math.radians(math.degrees(self.angle(across, down))), down)
        quaternion = quaternion_of(self.rotation)
        turn = rotation_from_quaternion(quaternion / float(np.linalg.norm(quaternion))).T
        return Camera(across, down, focal, focal, across / 2, down / 2, turn, -turn @ self.position)

    def angle(self, width: int, height: int) -> float:
        """Return the vertical field of view, in radians, of a picture of this size.

        It is the page's field of view if the page's aspect ratio is at least the picture's, or at least 1. Otherwise
        the picture has the page's horizontal field of view; a picture wider than high is treated as a square.
        """
        page, picture = self.width / self.height, min(width / height, 1.0)
        return self.fov if page >= picture else 2 * math.atan(math.tan(0.5 * self.fov) * page / picture)

    def same(self, other: Pose | None) -> bool:
        """True if all values of the other pose are the same, so that both show the same picture."""
        names = [item.name for item in fields(self)]
        return other is not None and all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)


def read_pose(
    wxyz: Sequence[float] | Float64,
    position: Sequence[float] | Float64,
    fov: float,
    size: tuple[int, int],
    origin: Float64,
) -> Pose | None:
    """Make a pose of the values that a browser sent. Returns None if no camera can have these values.

    wxyz: quaternion of the rotation from the camera's axes (COLMAP's) to the world's.
    position: camera position relative to `origin` (3,).
    fov: vertical field of view in radians.
    size: width and height of the page in pixels.
    """
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
    if not (0 < width <= MAX_PAGE_SIDE_PX and 0 < height <= MAX_PAGE_SIDE_PX):
        return None
    return Pose(rotation_from_quaternion(turn / length), place + origin, angle, width, height)


@dataclass(frozen=True, eq=False)
class OpeningView:
    """Camera of a newly opened page: position, orbit centre (`target`) and up direction in the world.

    fov, aspect: vertical field of view in radians, and width / height, of a picture that must be visible as a whole.
    """

    position: Float64
    target: Float64
    up: Float64
    fov: float
    aspect: float = 1.0

    def fov_on(self, width: int, height: int) -> float:
        """Return the vertical field of view, in radians, on a page of this size.

        It is `fov`, or more on a narrow page, such as on an upright phone, to show the whole width.
        """
        return wide_enough(self.fov, self.aspect, width, height)

    def misfits(self, fov: float, fitted: float, width: int, height: int) -> bool:
        """Return True if a page of this size should get the field of view of `fov_on`.

        fov: the page's vertical field of view in radians.
        fitted: the one that it was given last.
        A page with another field of view than `fitted` and the start's own shows a camera that was clicked, and keeps
        it. A busy browser may apply the start's own after the fitted one.
        """
        own = any(math.isclose(fov, known, rel_tol=SAME_FOV) for known in (self.fov, fitted))
        return own and min(width, height) > 0 and not math.isclose(fov, self.fov_on(width, height), rel_tol=SAME_FOV)


def wide_enough(fov: float, aspect: float, width: int, height: int) -> float:
    """Return the vertical field of view, in radians, with which a page of this size shows a whole picture.

    fov: vertical field of view of the picture in radians.
    aspect: width / height of the picture.
    The result is at least `fov`. If it is larger than `fov`, it is at most MAX_START_FOV_Y_RADIANS.
    """
    more = aspect * height / max(width, 1)
    return max(fov, min(2 * math.atan(math.tan(0.5 * fov) * more), MAX_START_FOV_Y_RADIANS)) if more > 1 else fov


def start_of(cameras: Sequence[Camera], points: Float64, *, level: bool = False) -> OpeningView:
    """Choose the viewer's start: the pose of the first camera that is not an outlier.

    The orbit centre is in front of this camera, at the depth of the point that all cameras look at.

    Without cameras, the start is in front of the points (N, 3), with y down and z forward as in a COLMAP scene.
    level: True if up is -y; otherwise it is estimated from the cameras.
    All vectors are in world coordinates.
    """
    if cameras:
        cameras = [camera for camera, far in zip(cameras, stray_cameras(cameras), strict=True) if not far]
        first, focus = cameras[0], focus_point(cameras)
        up = np.array(COLMAP_UP) if level else up_axis(cameras)
        ahead = first.rotation[2]
        distance = float((focus - first.position) @ ahead)
        away = float(np.linalg.norm(focus - first.position))
        if not distance > 1e-6 * away:
            distance = away or 1.0
        if not first.is_pinhole:
            return OpeningView(first.position, first.position + distance * ahead, up, DEFAULT_FOV_Y_RADIANS)
        fov, aspect = 2 * math.atan2(0.5 * first.height, first.fy), (first.width / first.fx) / (first.height / first.fy)
        return OpeningView(first.position, first.position + distance * ahead, up, fov, aspect)
    low, high = extent_of(points)
    middle = 0.5 * (low + high)
    distance = 0.6 * float(np.linalg.norm(high - low)) / math.tan(DEFAULT_FOV_Y_RADIANS / 2) or 1.0
    return OpeningView(middle - [0.0, 0.0, distance], middle, np.array(COLMAP_UP), DEFAULT_FOV_Y_RADIANS)


def leaning(up: Float64, ahead: Float64, degrees: float) -> Float64 | None:
    """Return the up direction (3,), of unit length, of a camera that looks `ahead` and is rolled by `degrees`.

    The result is `up`, rotated about the viewing direction, clockwise as seen from behind the camera. It is None if the
    camera looks along `up`.
    """
    length = float(np.linalg.norm(ahead) * np.linalg.norm(up))
    if not float(np.linalg.norm(np.cross(ahead, up))) > 1e-3 * length:
        return None
    turn = Rotation.from_rotvec(math.radians(degrees) * ahead / np.linalg.norm(ahead))
    return np.asarray(turn.apply(up / np.linalg.norm(up)))


def looking(start: OpeningView, size: tuple[int, int]) -> Pose:
    """Return the camera's pose in a newly opened page. start: the first view; size: width and height in pixels."""
    rotation, _ = look_at(start.position, start.target, start.up)
    return Pose(rotation.T, start.position, start.fov_on(*size), *size)


def fitted(width: int, height: int, scale: float, most: float = MAX_PAGE_PICTURE_PIXELS) -> tuple[int, int]:
    """Return width and height of a picture: the page's size times `scale`, reduced to at most `most` pixels in all."""
    scale = min(scale, math.sqrt(most / (width * height)))
    return max(1, round(width * scale)), max(1, round(height * scale))

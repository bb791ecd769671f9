# SPDX-License-Identifier: Apache-2.0
"""Upright frame of a scene: up along -y, the ground at y = 0, and the middle of the scene at x = z = 0.

Up comes from the first of these that is known: gravity in the metadata, GPS positions of a wide capture, a level plane
of points near the cameras' up. Otherwise it comes from the cameras alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.scenes.orientation.level import focus_point, median_roll, up_axis
from clsplat.scenes.orientation.plane import LevelPlane, ground_height, in_reach, level_plane

MIN_UPRIGHT_CAMERAS = 3
"""Minimum number of cameras for an upright frame."""
MAX_PLANE_TILT_RADIANS = np.deg2rad(15.0)
"""Largest angle between a level plane and the cameras' up direction. People hold cameras level to a few degrees."""
MIN_PLANE_TILT_RADIANS, PLANE_TILT_ROLLS = np.deg2rad(3.0), 2.0
"""Smaller limit of the same angle for cameras that are held level: PLANE_TILT_ROLLS times their median roll, but at
least MIN_PLANE_TILT_RADIANS. A plane that is farther from the up direction on which the cameras agree is not level."""
MAX_PLANE_TILT_BELOW_RADIANS = np.deg2rad(30.0)
"""The same limit if all cameras look down. Their up direction is less exact, as only their view directions give it."""
MIN_SAME_VIEW = 0.9
"""Minimum length of the mean view direction of cameras that look the same way. It is 1 if all directions are equal."""
MAX_TURNED_VIEW = 0.5
"""Maximum length of the mean y axis of cameras that look down. A drone flies with several headings, so it is short."""
PLANE_REACH = 2.0
"""Radius within which points are searched for a plane, relative to the scene's radius."""
MIN_GRAVITY_PHOTOS = 3
"""Minimum number of photographs with gravity in their metadata, for an up direction from it."""
MAX_GRAVITY_SPREAD_RADIANS = np.deg2rad(5.0)
"""Largest median angle between the photographs' gravity directions and their mean."""
MIN_LEVEL_PART = 0.3
"""Minimum length of a view direction's horizontal part that gives the heading. In a steeper view, the camera's y axis
gives it."""


@dataclass(frozen=True, eq=False)
class MeasuredUp:
    """An up direction that does not come from the shape of the scene.

    up: (3,), unit vector in the world.
    note: source of the direction, for the user.
    """

    up: Float64
    note: str


@dataclass(frozen=True, eq=False)
class Upright:
    """Up, ground and middle of a scene, in its world.

    up: (3,), unit vector.
    origin: (3,), the point on the ground below or above the middle of the scene.
    ahead: (3,), the first camera's heading. Its horizontal part becomes the z axis.
    note: source of the up direction, for the user.
    plane: the level plane; None if none was found.
    """

    up: Float64
    origin: Float64
    ahead: Float64
    note: str
    plane: LevelPlane | None

    def motion(self, ahead: Float64 | None = None) -> Float64:
        """Return the rigid motion (4, 4) to the upright frame. ahead: (3,), such as north; None for `self.ahead`."""
        rotation = axes_of(self.up, self.ahead if ahead is None else ahead)
        change = np.eye(4)
        change[:3, :3], change[:3, 3] = rotation, -rotation @ self.origin
        return change


def upright(cameras: Sequence[Camera], points: Float64, measured: MeasuredUp | None = None) -> Upright:
    """Find up, ground and middle of a scene.

    cameras: in the order of names; the first one gives the heading.
    points: (N, 3), world coordinates.
    measured: up direction from gravity or GPS; None to estimate it from the points and the cameras.
    Raises InputError for fewer than MIN_UPRIGHT_CAMERAS cameras.
    """
    if len(cameras) < MIN_UPRIGHT_CAMERAS:
        raise InputError(
            f"{len(cameras)} camera(s) do not tell which way is up, expected at least {MIN_UPRIGHT_CAMERAS}"
        )
    middle, radius = middle_of(cameras, points)
    near = points[in_reach(points, middle, PLANE_REACH * radius)]
    up, limit, source = _prior(cameras) if measured is None else (measured.up, MAX_PLANE_TILT_RADIANS, measured.note)
    plane = level_plane(near, up, limit, radius)
    if measured is not None:
        note = f"up is from {source}" + (f"; a level plane of points is {_apart(plane, up)} from it" if plane else "")
    elif plane is None:
        note = f"up is from {source}, as no plane within {np.rad2deg(limit):.0f} degrees of it has many points"
    else:
        share = f"{100 * plane.share:.0f} % of the points"
        note = f"up is from a level plane with {share}, {_apart(plane, up)} from {source}"
        up = plane.normal
    centres = np.stack([camera.position for camera in cameras])
    ground = float(middle @ up)
    if len(near):
        ground = ground_height(near @ up, float(np.median(centres @ up)), radius)
    origin = np.asarray(middle + (ground - middle @ up) * up)
    return Upright(up, origin, _heading(cameras[0], up), note, plane)


def _apart(plane: LevelPlane, up: Float64) -> str:
    return f"{np.rad2deg(np.arccos(np.clip(plane.normal @ up, -1, 1))):.1f} degrees"


def axes_of(up: Float64, ahead: Float64) -> Float64:
    """Return the rotation (3, 3) to a world whose -y axis is `up`, and whose z axis is `ahead` made horizontal."""
    level = ahead - (ahead @ up) * up
    level = level / np.linalg.norm(level)
    return np.stack([np.cross(-up, level), -up, level])


def _heading(camera: Camera, up: Float64) -> Float64:
    """Return a camera's heading (3,): the horizontal part of its view direction.

    If the view is steep, the heading is along the camera's y axis. In a view straight down, the top of the picture is
    ahead.
    """
    ahead = camera.rotation[2]
    level = ahead - (ahead @ up) * up
    if np.linalg.norm(level) >= MIN_LEVEL_PART:
        return np.asarray(level)
    return np.asarray(np.sign(-ahead @ up) * -camera.rotation[1])


def _prior(cameras: Sequence[Camera]) -> tuple[Float64, float, str]:
    """Return the cameras' up direction (3,), the largest tilt of a plane from it in radians, and its name for notes."""
    if looks_down(cameras):
        forward = np.mean([camera.rotation[2] for camera in cameras], axis=0)
        return -forward / np.linalg.norm(forward), MAX_PLANE_TILT_BELOW_RADIANS, "the cameras, which all look down"
    up, roll = up_axis(cameras), median_roll(cameras)
    limit = MAX_PLANE_TILT_RADIANS
    if roll is not None:
        limit = float(np.clip(PLANE_TILT_ROLLS * roll, MIN_PLANE_TILT_RADIANS, MAX_PLANE_TILT_RADIANS))
    return up, limit, "the cameras' up direction"


def looks_down(cameras: Sequence[Camera]) -> bool:
    """Return True if the cameras look down, like a drone's in a survey: all alike, but turned about the view direction.

    A survey with one heading cannot be told from photographs of a wall. Panoramas look in no direction.
    """
    if any(camera.model.wraps for camera in cameras):
        return False
    forward = np.linalg.norm(np.mean([camera.rotation[2] for camera in cameras], axis=0))
    down = np.linalg.norm(np.mean([camera.rotation[1] for camera in cameras], axis=0))
    return bool(forward > MIN_SAME_VIEW and down < MAX_TURNED_VIEW)


def middle_of(cameras: Sequence[Camera], points: Float64) -> tuple[Float64, float]:
    """Return the middle (3,) and the radius of a scene.

    The middle is the point that the cameras look at, and the radius their median distance from it. If they do not look
    at one point, as in a panorama, the middle is the median of their positions. The radius is then the median distance
    of the points from it.
    """
    centres = np.stack([camera.position for camera in cameras])
    if not any(camera.model.wraps for camera in cameras):
        forward = np.stack([camera.rotation[2] for camera in cameras])
        if np.linalg.norm(forward.mean(axis=0)) > 1e-3:  # otherwise no point is ahead of all cameras
            focus = focus_point(cameras)
            offsets = focus - centres
            distances = np.linalg.norm(offsets, axis=1)
            ahead = np.einsum("nk,nk->n", forward, offsets) > 0.5 * distances
            if ahead.mean() > 0.5 and np.median(distances) > 0:
                return focus, float(np.median(distances))
    middle = np.median(centres, axis=0)
    spread = float(np.linalg.norm(centres - middle, axis=1).max())
    away = float(np.median(np.linalg.norm(points - middle, axis=1))) if len(points) else 0.0
    return middle, away or spread or 1.0


def up_from_gravity(cameras: Mapping[str, Camera], gravity: Mapping[str, Float64]) -> MeasuredUp | None:
    """Return the up direction from the photographs' gravity, or None if too few have it or if they disagree.

    gravity: directions (3,) in the axes of the cameras, by the photographs' names.
    """
    names = [name for name in gravity if name in cameras]
    if len(names) < MIN_GRAVITY_PHOTOS:
        return None
    downs = np.stack([cameras[name].rotation.T @ gravity[name] for name in names])
    down = np.median(downs, axis=0)
    length = float(np.linalg.norm(down))
    if length == 0:
        return None
    down = down / length
    spread = float(np.median(np.arccos(np.clip(downs @ down, -1, 1))))
    if spread > MAX_GRAVITY_SPREAD_RADIANS:
        return None
    about = f"which agree within {np.rad2deg(spread):.1f} degrees"
    return MeasuredUp(-down, f"gravity in the metadata of {len(names):,} photographs, {about}")

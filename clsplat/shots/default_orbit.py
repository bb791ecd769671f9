# SPDX-License-Identifier: Apache-2.0
"""Default cameras for a model without camera files: rings around the model, from its Gaussians' positions and sizes.

If a run has recorded its photographs' cameras, a path can go among these cameras instead.
The up axis: `scenes/orientation/level.py`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.scenes.orientation.level import COLMAP_UP
from clsplat.scenes.outliers import stray_cameras
from clsplat.shots.viewpoints import extent_of, look_at

DEFAULT_ORBIT_SIZE_PX = (1280, 720)
"""Default width and height of pictures, in pixels."""
ORBIT_FOV_RADIANS = math.radians(40.0)
"""Field of view across a picture's shorter side, in radians."""
SUBJECT_SAMPLE_SIZE = 100_000
"""Number of Gaussians that are sampled to locate a model. A larger sample moves its centre by less than a pixel."""
MIN_GAUSSIANS_FOR_STRAYS = 100
"""In a model of at least this many Gaussians, the outermost ones count as outliers, which do not affect its size."""
BALL_SHRINK_FACTOR = 0.9
"""Ratio of successive ball radii in the search for the most detailed region."""
REGION_DETAIL_FRACTION = 0.35
"""Largest fraction of a model's detail (the sum of opacity over size) that is in its most detailed region."""
MAX_SCENE_REGION_RADIUS_RATIO = 0.2
"""A model is a scene around an object if the radius of its most detailed region is at most this fraction of the model's
radius. Measured fractions are 0.3 or more for a single object, and 0.05 for a room with a table in the middle."""
MIN_DETAIL_SIZE_QUANTILE, MIN_DETAIL_SIZE_RATIO = 0.02, 1e-4
"""Lower limit of Gaussians' sizes in the measure of detail: this quantile of all sizes, but at least this fraction of
the model's radius. Some files have Gaussians of size 0."""
SCENE_RADIUS_MARGIN = 1.3
"""Radius that an orbit shows, relative to the radius of the scene's most detailed region."""
ORBIT_FRAMING_MARGIN = 1.1
"""Radius that a picture shows, relative to the subject's radius, which does not include outliers."""
RING_ELEVATIONS_RADIANS = (math.radians(20.0), math.radians(5.0), math.radians(40.0))
"""Elevations of the camera rings, in radians. A turntable follows the first ring; a spiral rises and sinks between the
other two."""
CAMERAS_PER_RING = 24
"""Number of cameras in a ring."""


def parse_up(text: str) -> tuple[float, float, float]:
    """Parse --up, an axis such as `x` or `-y` or three numbers with commas. Return a unit vector. Raises InputError."""
    expected = InputError(f"--up {text[:80]}: expected x, y, z, -x, -y, -z or three numbers with commas, not all 0")
    name, sign = text.strip().removeprefix("-"), -1.0 if text.strip().startswith("-") else 1.0
    if name in ("x", "y", "z"):
        return tuple(sign * (axis == name) for axis in "xyz")  # type: ignore[return-value]  # three entries
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        raise expected from None
    most = max(abs(x), abs(y), abs(z))
    if not (0 < most < math.inf and math.isfinite(x + y + z)):
        raise expected
    x, y, z = x / most, y / most, z / most  # scaled, so that the squares neither overflow nor underflow
    length = math.hypot(x, y, z)
    return x / length, y / length, z / length


def cameras_around(
    gaussians: Gaussians,
    up: tuple[float, float, float] = COLMAP_UP,
    size: tuple[int | None, int | None] = (None, None),
) -> list[Camera]:
    """Level pinhole cameras in three rings around a model, or around the most detailed region of a scene.

    The cameras face the centre of the model or region.

    up: up direction (3,), of any length but 0. If it is along y, the first camera looks along z.
    size: width and height in pixels; a side that is None follows from the other at the default aspect ratio.
    Raises InputError for a model without Gaussians.
    """
    if not len(gaussians):
        raise InputError("the model has no Gaussians, expected some to look at")
    centre, radius = _subject(gaussians)
    axis = np.asarray(up, np.float64) / np.linalg.norm(up)
    ahead = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    ahead -= (ahead @ axis) * axis
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, axis)
    width, height = _size(size)
    focal = 0.5 * min(width, height) / math.tan(0.5 * ORBIT_FOV_RADIANS)
    distance = ORBIT_FRAMING_MARGIN * radius / math.sin(0.5 * ORBIT_FOV_RADIANS)
    cameras = []
    for elevation in RING_ELEVATIONS_RADIANS:
        for azimuth in 2 * np.pi * np.arange(CAMERAS_PER_RING) / CAMERAS_PER_RING:
            level = np.sin(azimuth) * right - np.cos(azimuth) * ahead
            position = centre + distance * (np.cos(elevation) * level + np.sin(elevation) * axis)
            rotation, translation = look_at(position, centre, axis)
            cameras.append(Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, rotation, translation))
    return cameras


def among(own: Sequence[Camera], size: tuple[int | None, int | None] = (None, None)) -> list[Camera]:
    """Return pinhole cameras with the poses of the photographs' cameras `own`, for a path among them.

    Cameras far from the others are left out. Cameras that are not perspective get the default field of view.

    size: width and height in pixels. If both are given, the field of view is the largest that the photographs cover.
      Otherwise the pictures keep the photographs' aspect ratio.
    """
    far = stray_cameras(own)
    return [_pinhole(camera, size) for camera, stray in zip(own, far, strict=True) if not stray]


def _pinhole(camera: Camera, size: tuple[int | None, int | None]) -> Camera:
    width, height = size
    if not camera.is_pinhole:
        width, height = _size(size)
        focal = 0.5 * min(width, height) / math.tan(0.5 * ORBIT_FOV_RADIANS)
        return Camera(
            width,
            height,
            focal,
            focal,
            0.5 * width,
            0.5 * height,
            camera.rotation,
            camera.translation,
            near=camera.near,
        )
    if width is None or height is None:
        return camera
    scale = max(width / camera.width, height / camera.height)
    across, down = (scale * value for value in (camera.cx - 0.5 * camera.width, camera.cy - 0.5 * camera.height))
    fx, fy, cx, cy = scale * camera.fx, scale * camera.fy, 0.5 * width + across, 0.5 * height + down
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def _size(size: tuple[int | None, int | None]) -> tuple[int, int]:
    width, height = size
    if width is None and height is None:
        return DEFAULT_ORBIT_SIZE_PX
    if width is None:
        assert height is not None
        return max(1, round(height * DEFAULT_ORBIT_SIZE_PX[0] / DEFAULT_ORBIT_SIZE_PX[1])), height
    return width, max(
        1, round(width * DEFAULT_ORBIT_SIZE_PX[1] / DEFAULT_ORBIT_SIZE_PX[0])
    ) if height is None else height


def _subject(gaussians: Gaussians) -> tuple[Float64, float]:
    """Return the centre (3,) in the world and the radius of the part that an orbit shows: the most detailed
    region of a scene, or an object without its outliers.

    A ball shrinks towards the greatest detail, measured as opacity over size (mean shift, Fukunaga and Hostetler 1975),
    until it holds at most REGION_DETAIL_FRACTION of the detail.
    """
    rows = slice(None, None, max(1, len(gaussians) // SUBJECT_SAMPLE_SIZE))
    means = gaussians.means[rows].astype(np.float64)
    largest = gaussians.log_scales[rows].max(axis=1).astype(np.float64)
    low, high = extent_of(means) if len(means) >= MIN_GAUSSIANS_FOR_STRAYS else extent_of(means, 1.0)
    middle, whole = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    if whole == 0:
        return middle + gaussians.origin, 3 * float(np.exp(largest.max()))
    least = max(float(np.quantile(largest, MIN_DETAIL_SIZE_QUANTILE)), math.log(MIN_DETAIL_SIZE_RATIO * whole))
    detail = np.exp(least - np.maximum(largest, least)) / (
        1 + np.exp(-gaussians.opacity_logits[rows].astype(np.float64))
    )
    kept = ((means >= low) & (means <= high)).all(axis=1)
    means, detail = means[kept], detail[kept]
    centre, radius = middle, whole
    wanted = REGION_DETAIL_FRACTION * detail.sum()
    while (inside := np.linalg.norm(means - centre, axis=1) <= radius).any() and detail[inside].sum() > wanted:
        centre, radius = np.average(means[inside], axis=0, weights=detail[inside]), BALL_SHRINK_FACTOR * radius
        if radius <= MAX_SCENE_REGION_RADIUS_RATIO * whole / 100:  # all detail is in one place
            break
    if radius > MAX_SCENE_REGION_RADIUS_RATIO * whole:
        return middle + gaussians.origin, whole
    return centre + gaussians.origin, SCENE_RADIUS_MARGIN * radius

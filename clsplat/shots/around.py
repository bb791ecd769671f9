# SPDX-License-Identifier: Apache-2.0
"""Cameras around a model of which nothing else is known: by where its Gaussians are, and how much detail they show; and
those among the photographs' own cameras, where a run knows them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.scenes.strays import stray_cameras
from clsplat.shots.viewpoints import COLMAP_UP, extent_of, look_at

SIZE = (1280, 720)
"""Width and height of pictures where none are asked for."""
FIELD = math.radians(40.0)
"""Angle of view of the shorter side, in radians."""
SAMPLED = 100_000
"""Gaussians that tell where a model is; more move its middle by less than a pixel."""
FEW = 100
"""Gaussians under which none is a stray."""
SHRINK = 0.9
"""Factor of a ball's radius from one to the next, on the way to the most detailed region."""
DETAILED = 0.35
"""Part of a model's detail that the most detailed region has at most."""
SCENE = 0.2
"""Radius of that region, in the model's, under which the model is a scene with a thing in it; 0.3 and more in models of
a thing alone, 0.05 in one of a room with a table in the middle."""
TINY, SMALLEST = 0.02, 1e-4
"""Sizes below which a Gaussian shows no more detail: of this part of the Gaussians, and in the model's radius. Files
have some of no size at all."""
MARGIN = 1.3
"""Radius to be seen of a scene, in that of its most detailed region."""
ROOM = 1.1
"""Radius of what a picture has room for, in that of what is to be seen: strays end beyond it."""
ELEVATIONS = (math.radians(20.0), math.radians(5.0), math.radians(40.0))
"""Rings of cameras: a turntable goes by the first, a spiral rises and sinks between the others."""
RING = 24
"""Cameras of a ring."""


def parse_up(text: str) -> tuple[float, float, float]:
    """The direction in `x`, `-y` and so on, or in three numbers with commas, of length 1. Raises InputError."""
    expected = InputError(f"--up {text[:80]}: expected x, y, z, -x, -y, -z or three numbers with commas, not all 0")
    name, sign = text.strip().removeprefix("-"), -1.0 if text.strip().startswith("-") else 1.0
    if name in ("x", "y", "z"):
        return tuple(sign * (axis == name) for axis in "xyz")  # type: ignore[return-value]  # three
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        raise expected from None
    most = max(abs(x), abs(y), abs(z))
    if not (0 < most < math.inf and math.isfinite(x + y + z)):
        raise expected
    x, y, z = x / most, y / most, z / most  # before squares are out of range
    length = math.hypot(x, y, z)
    return x / length, y / length, z / length


def cameras_around(
    gaussians: Gaussians,
    up: tuple[float, float, float] = COLMAP_UP,
    size: tuple[int | None, int | None] = (None, None),
) -> list[Camera]:
    """Level pinhole cameras in three rings around a model, or around what a scene has most detail of, facing its
    middle.

    up: any length but 0. The first camera is where a COLMAP scene is looked at from, along z, for up along y. size:
    width and height in pixels; one that is None follows from the other in the shape of SIZE. Raises InputError for a
    model without Gaussians.
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
    focal = 0.5 * min(width, height) / math.tan(0.5 * FIELD)
    distance = ROOM * radius / math.sin(0.5 * FIELD)
    cameras = []
    for elevation in ELEVATIONS:
        for azimuth in 2 * np.pi * np.arange(RING) / RING:
            level = np.sin(azimuth) * right - np.cos(azimuth) * ahead
            position = centre + distance * (np.cos(elevation) * level + np.sin(elevation) * axis)
            rotation, translation = look_at(position, centre, axis)
            cameras.append(Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, rotation, translation))
    return cameras


def among(own: Sequence[Camera], size: tuple[int | None, int | None] = (None, None)) -> list[Camera]:
    """The photographs' own cameras without strays, as pinholes, for a path among them: it shows what they have shown.

    size: width and height in pixels. Where both are given, the field of view is what fits into the photographs', else
    the pictures have their shape. Photographs that are no perspective pictures stand for pinholes of FIELD.
    """
    far = stray_cameras(own)
    return [_pinhole(camera, size) for camera, stray in zip(own, far, strict=True) if not stray]


def _pinhole(camera: Camera, size: tuple[int | None, int | None]) -> Camera:
    width, height = size
    if camera.projection != "perspective":
        width, height = _size(size)
        focal = 0.5 * min(width, height) / math.tan(0.5 * FIELD)
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
        return SIZE
    if width is None:
        assert height is not None
        return max(1, round(height * SIZE[0] / SIZE[1])), height
    return width, max(1, round(width * SIZE[1] / SIZE[0])) if height is None else height


def _subject(gaussians: Gaussians) -> tuple[Float64, float]:
    """Middle (3,) in the world and radius of what is to be seen: of all that is no stray, or of a scene's most detailed
    region.

    Balls shrink towards where most detail is, opacity over size (mean shift, Fukunaga and Hostetler 1975), until one
    has no more than DETAILED of it.
    """
    rows = slice(None, None, max(1, len(gaussians) // SAMPLED))
    means = gaussians.means[rows].astype(np.float64)
    largest = gaussians.log_scales[rows].max(axis=1).astype(np.float64)
    low, high = extent_of(means) if len(means) >= FEW else extent_of(means, 1.0)
    middle, whole = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    if whole == 0:
        return middle + gaussians.origin, 3 * float(np.exp(largest.max()))
    least = max(float(np.quantile(largest, TINY)), math.log(SMALLEST * whole))
    detail = np.exp(least - np.maximum(largest, least)) / (
        1 + np.exp(-gaussians.opacity_logits[rows].astype(np.float64))
    )
    kept = ((means >= low) & (means <= high)).all(axis=1)
    means, detail = means[kept], detail[kept]
    centre, radius = middle, whole
    wanted = DETAILED * detail.sum()
    while (inside := np.linalg.norm(means - centre, axis=1) <= radius).any() and detail[inside].sum() > wanted:
        centre, radius = np.average(means[inside], axis=0, weights=detail[inside]), SHRINK * radius
        if radius <= SCENE * whole / 100:  # all in one place
            break
    if radius > SCENE * whole:
        return middle + gaussians.origin, whole
    return centre + gaussians.origin, MARGIN * radius

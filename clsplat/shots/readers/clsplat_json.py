# SPDX-License-Identifier: Apache-2.0
"""Reader of clsplat's own camera files: key frames of a camera in JSON, described in docs/cameras.md."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import MAX_FOCAL_PX, PROJECTIONS, Camera, Projection
from clsplat.errors import InputError
from clsplat.rotations import rotation_from_quaternion
from clsplat.scenes.camera_json import Keys, objects, short
from clsplat.shots.keyframes import Key, interpolate
from clsplat.shots.shot import Shot, numbered, whole_frames

CAMERAS_VERSION_KEY, CAMERAS_VERSION = "clsplat_cameras", 1
FOCAL_PROPERTIES = ("fx", "fy", "fov_x", "fov_y", "pixel_size")
"""Properties of a camera file or of a key that set the focal length."""
LENS_PROPERTIES = (*FOCAL_PROPERTIES, "cx", "cy", "shift", "roll")
CAMERA_FILE_PROPERTIES = (
    CAMERAS_VERSION_KEY,
    "width",
    "height",
    "projection",
    "fps",
    "first_frame",
    "loop_frames",
    "near",
    "far",
    "keys",
    *LENS_PROPERTIES,
)
KEY_FRAME_PROPERTIES = ("frame", "seconds", "position", "world_from_cam", *LENS_PROPERTIES)


def read_keyed(path: Path, document: dict[str, Any]) -> Shot:
    """Read the frames of a camera file. Cameras are interpolated smoothly between the keys (`interpolate`).

    Frames have whole numbers from the first key to the last, or, with 'loop_frames', for one period from the first key.

    document: the file's parsed JSON object.

    Raises InputError, naming the file and the key, for another version, no keys, an unknown name, and missing or
    invalid values.
    """
    if document.get(CAMERAS_VERSION_KEY) != CAMERAS_VERSION:
        raise InputError(
            f"{path}: '{CAMERAS_VERSION_KEY}' is {short(document.get(CAMERAS_VERSION_KEY))}, expected "
            f"{CAMERAS_VERSION}; newer files need a "
            "newer clsplat"
        )
    _known(str(path), document, CAMERA_FILE_PROPERTIES)
    if not (entries := objects(document, "keys")):
        raise InputError(f"{path}: has no keys, expected 'keys' to be a list of at least one object")
    whole = Keys(path, None, {}, document)
    fps, first, loop = whole.number("fps"), whole.require("first_frame", 1.0), whole.number("loop_frames")
    if fps is not None and fps <= 0:
        raise InputError(f"{path}: 'fps' is {fps:g}, expected more than 0")
    keys = []
    for index, entry in enumerate(entries):
        reader = Keys(path, f"key {index}", entry, document)
        _known(reader.where, entry, KEY_FRAME_PROPERTIES)
        camera = _camera(reader, whole)
        keys.append(Key(_frame(reader, fps, first), camera, math.radians(reader.number("roll") or 0.0)))
    keys.sort(key=lambda key: key.frame)
    frames = _frames(path, [key.frame for key in keys], loop)
    return Shot(numbered(interpolate(keys, frames, loop=loop), frames[0], fps), fps=fps)


def _known(where: str, values: dict[str, Any], names: tuple[str, ...]) -> None:
    for name in values:
        if name not in names:
            raise InputError(f"{where}: '{name}' is not known here, expected one of {', '.join(names)}")


def _frame(keys: Keys, fps: float | None, first: float) -> float:
    frame, seconds = keys.frame.get("frame"), keys.frame.get("seconds")
    if (frame is None) == (seconds is None):
        found = "neither" if frame is None else "both"
        raise InputError(f"{keys.where}: has {found}, expected either 'frame' or 'seconds'")
    if frame is not None:
        return keys.require("frame")
    if fps is None:
        raise InputError(f"{keys.where}: has 'seconds', but the file has no 'fps', expected frames per second")
    # rounded, because 2.2 s at 25 fps would be 55.00000000000001 frames
    return round(first + keys.require("seconds") * fps, 6)


def _frames(path: Path, frames: list[float], loop: float | None) -> list[int]:
    """Return the numbers of the frames to render, in increasing order. Raises InputError.

    frames: frame numbers of the keys, in increasing order. loop: the period in frames, or None.
    """
    for before, after in pairwise(frames):
        if before == after:
            raise InputError(f"{path}: has two keys at frame {after:g}, expected one")
    begin, end = frames[0], frames[-1]
    if loop is not None:
        if not end - begin < loop:
            raise InputError(
                f"{path}: 'loop_frames' is {loop:g}, expected more than the {end - begin:g} that the keys span: "
                "the first key repeats after that many frames"
            )
        end = math.ceil(begin + loop) - 1
    return whole_frames(str(path), "frame", begin, end)


def _camera(keys: Keys, whole: Keys) -> Camera:
    projection = whole.document.get("projection", Camera.projection)
    if projection not in tuple(PROJECTIONS):
        raise InputError(f"{keys.path}: 'projection' is {short(projection)}, expected one of {', '.join(PROJECTIONS)}")
    width, height = whole.side("width"), whole.side("height")
    near, far = whole.require("near", 0.01), whole.require("far", math.inf)
    if not 0 < near < far:
        raise InputError(f"{keys.path}: 'near' is {near:g} and 'far' {far:g}, expected 0 < near < far")
    fx, fy = _focal(keys, projection, width, height)
    if not max(fx, fy) <= MAX_FOCAL_PX:
        raise InputError(f"{keys.where}: has a focal length of {max(fx, fy):g}, expected at most {MAX_FOCAL_PX:g}")
    cx, cy = _principal(keys, width, height)
    rotation = _rotation(keys).T
    position = keys.vector("position", 3)
    return Camera(width, height, fx, fy, cx, cy, rotation, -rotation @ position, near, far, projection)


def _rotation(keys: Keys) -> Float64:
    quaternion = keys.vector("world_from_cam", 4)
    norm = float(np.linalg.norm(quaternion))
    if not 0.5 < norm < 2:
        raise InputError(
            f"{keys.where}: 'world_from_cam' is {quaternion.tolist()}, expected a unit quaternion [w, x, y, z]"
        )
    return rotation_from_quaternion(quaternion / norm)


def _focal(keys: Keys, projection: Projection, width: int, height: int) -> tuple[float, float]:
    """Return the focal lengths fx and fy of a key, or of the whole file if the key gives no focal length.

    Their unit is pixels per world unit for an orthographic camera, pixels per radian for a panorama, otherwise pixels.
    """
    source = keys.frame if any(name in keys.frame for name in FOCAL_PROPERTIES) else keys.document
    given = [name for name in FOCAL_PROPERTIES if name in source]
    values = Keys(keys.path, None, source, {})
    values.where = keys.where
    model = PROJECTIONS[projection]
    if model.wraps:
        across, down = model.whole_angles
        degrees = values.require("fov_x", across), values.require("fov_y", down)
        if not set(given) <= {"fov_x", "fov_y"} or not (0 < degrees[0] <= across and 0 < degrees[1] <= down):
            raise InputError(
                f"{keys.where}: has {_listed(source, given)}, expected only 'fov_x' up to {across:g} degrees and "
                f"'fov_y' up to {down:g} for {model.named} camera"
            )
        return width / math.radians(degrees[0]), height / math.radians(degrees[1])
    if set(given) not in ({"fx"}, {"fx", "fy"}, *({key} for key in model.focal_keys)):
        raise InputError(
            f"{keys.where}: has {_listed(source, given)}, expected one of 'fx' (with 'fy' if that differs), "
            + " or ".join(f"'{key}'" for key in model.focal_keys)
        )
    lengths = [values.require(name) for name in given]
    if min(lengths) <= 0:
        raise InputError(f"{keys.where}: has {_listed(source, given)}, expected more than 0")
    if given[0] == "fx":
        return lengths[0], lengths[-1]
    if model.parallel:
        return 1 / lengths[0], 1 / lengths[0]
    focal = values.focal(given[0], width if given[0] == "fov_x" else height, projection)
    return focal, focal


def _listed(source: dict[str, Any], given: list[str]) -> str:
    return ", ".join(f"'{name}' {short(source[name])}" for name in given) or "no focal length"


def _principal(keys: Keys, width: int, height: int) -> tuple[float, float]:
    cx, cy = keys.number("cx"), keys.number("cy")
    if keys.get("shift") is None:
        return width / 2 if cx is None else cx, height / 2 if cy is None else cy
    if cx is not None or cy is not None:
        raise InputError(f"{keys.where}: has 'shift' and 'cx' or 'cy', expected one or the other")
    right, up = keys.vector("shift", 2)
    return width * (0.5 - float(right)), height * (0.5 + float(up))

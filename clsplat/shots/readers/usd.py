# SPDX-License-Identifier: Apache-2.0
"""Cameras of USD stages, read with usd-core (an optional extra), one frame per time code.

The stage's metersPerUnit and upAxis are not applied: the numbers in the stage are the model's world. Only the camera's
own axes (x right, y up, looking along -z) are converted to ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.arrays import Float64
from clsplat.camera import Camera, model_with, names_of
from clsplat.errors import InputError, examples
from clsplat.models.formats.usd import open_stage, readable, survive
from clsplat.scenes.camera_json import short
from clsplat.scenes.readers.transforms import opengl_pose
from clsplat.shots.optics import Optics
from clsplat.shots.readers.usd_settings import Settings, camera_of_settings, read_settings
from clsplat.shots.shot import Shot, numbered, whole_frames

WORLD_UNITS_PER_APERTURE_UNIT = 0.1
"""World units per unit of apertures and focal lengths, in USD."""

SUPPORTED_PROJECTIONS = names_of("usd")
"""Values that are accepted in a camera's attributes of projection. Other values mean lenses with distortion."""


def read_usd(path: Path, size: tuple[int | None, int | None] = (None, None), prim: str | None = None) -> Shot:
    """Read the frames of a stage's camera, one for each whole time code from startTimeCode to endTimeCode. If the stage
    has neither, the frames go from the camera's first time sample to the last.

    The frame rate is the stage's timeCodesPerSecond; USD uses framesPerSecond if only that is authored. Each
    frame has the shutter and the lens of its time code. `Shot.moment` gives the camera at any time, with USD's own
    interpolation between samples. `Shot.unapplied` names authored settings that are not applied. USD's warnings become
    the shot's warnings.

    size: width and height in pixels. A missing side follows from the resolution of the render settings, else from
      the first frame's aperture. If both sides are missing, the size is that resolution.
    prim: path or name of the camera, needed if the stage has several cameras and its render settings name none.
    The render settings also give the pixel aspect ratio and how the aperture is conformed to the size. Without them,
    the aperture's width fills the picture's width, and pixels are square. Raises InputError if the stage cannot be
    opened, has no such camera, no size or invalid values, or if usd-core is not installed.
    """
    survive(path, "clsplat.shots.readers.usd:read_here", size=size, prim=prim)
    return read_here(path, size, prim)


def read_here(path: Path, size: tuple[int | None, int | None] = (None, None), prim: str | None = None) -> Shot:
    """Read cameras like `read_usd`, from a file that is known not to crash USD's library."""
    from pxr import UsdGeom, UsdUtils

    # captures USD's messages, which become warnings: some, such as that of a missing layer, do not concern the camera
    diagnostics = UsdUtils.CoalescingDiagnosticDelegate()
    stage = open_stage(path, path)
    with readable(path):
        cameras = [UsdGeom.Camera(item) for item in stage.Traverse() if item.IsA(UsdGeom.Camera)]
        asked = camera_of_settings(stage)
        known = asked in [str(camera.GetPath()) for camera in cameras]
        camera = _find(path, cameras, prim or (asked if known else None))
        place = camera.GetPath()
        where = f"{path}: {place}"
        settings = read_settings(path, stage, camera)
        codes, authored = _time_codes(where, stage, camera)
        picture = _size(path, size, settings, _aperture(where, camera, codes[0]))
        per_second = float(stage.GetTimeCodesPerSecond())

        def moment(time: float) -> Camera:
            with readable(path):
                prim = UsdGeom.Camera(stage.GetPrimAtPath(place))  # this reference to `stage` keeps it open
                return _camera(f"{where} at {time:g}", prim, time, picture, settings)

        frames = numbered(map(moment, codes), codes[0], None if len(codes) == 1 or per_second <= 0 else per_second)
        rate = per_second if 0 < per_second < math.inf else 0.0
        metres = float(UsdGeom.GetStageMetersPerUnit(stage))
        frames = tuple(
            replace(frame, optics=_optics(f"{where} at {frame.number}", camera, frame.number, settings, metres, rate))
            for frame in frames
        )
    lost = () if known or not asked else (f"camera ({asked}, which does not exist)",)
    unapplied = (*_unapplied(camera, codes), *settings.unapplied, *lost)
    # cut off the end of each line, where USD prints the stage's address in memory
    lines = [message.commentary.split(" (instantiating")[0] for message in diagnostics.TakeUncoalescedDiagnostics()]
    warnings = tuple(f"{path}: USD says: {' '.join(line.split())}" for line in lines[:3])
    moved = [time for source in _moved(camera) for time in source.GetTimeSamples()]
    reach = (float(min(moved)), float(max(moved))) if moved else None
    return Shot(frames, warnings, rate or None, unapplied, moment, authored, reach, settings.window)


def _unapplied(camera: Any, codes: list[int]) -> tuple[str, ...]:
    """Return names and first values of the camera's authored attributes that would change a frame but are not applied.

    codes: time codes of the frames.
    """
    from pxr import UsdGeom

    usual: dict[str, object] = {"exposure": 0.0, "exposure:iso": 100.0}
    usual |= dict.fromkeys(("exposure:time", "exposure:fStop", "exposure:responsivity"), 1.0)
    usual |= {"clippingPlanes": (), "stereoRole": UsdGeom.Tokens.mono}
    return tuple(filter(None, (_authored(camera.GetPrim(), name, value, codes) for name, value in usual.items())))


def _optics(where: str, camera: Any, code: int, settings: Settings, metres: float, fps: float) -> Optics:
    """Return the camera's shutter and lens at the time code `code`. Raises InputError for invalid values.

    metres: length of a world unit in metres. fps: frames per second, 0 if unknown.
    """
    opens, closes = (
        _number(where, attribute, code) for attribute in (camera.GetShutterOpenAttr(), camera.GetShutterCloseAttr())
    )
    if closes < opens:
        raise InputError(
            f"{where}: shutter:open is {opens:g} and shutter:close {closes:g}, expected two times relative to "
            "the frame, the second not before the first"
        )
    if settings.instantaneous:
        closes = opens
    lens = {}
    for attribute in (camera.GetFStopAttr(), camera.GetFocusDistanceAttr()):
        lens[attribute.GetName()] = value = _number(where, attribute, code)
        if value < 0:
            raise InputError(f"{where}: {attribute.GetName()} is {value:g}, expected at least 0")
    if not 0 < metres < math.inf:
        raise InputError(f"{where.partition(': ')[0]}: metersPerUnit is {metres:g}, expected a number above 0")
    scale = _pose(where, camera, code)[2]
    focal = _number(where, camera.GetFocalLengthAttr(), code) * WORLD_UNITS_PER_APERTURE_UNIT * scale
    return Optics(
        (opens, closes) if settings.motion_blur else (0.0, 0.0),
        lens["fStop"] if settings.depth_of_field else 0.0,
        lens["focusDistance"] * scale,
        focal,
        metres,
        fps,
    )


def _authored(prim: Any, name: str, usual: Any, codes: list[int]) -> str:
    """Return the name and first unusual value of an authored attribute; '' if it has no unusual value.

    usual: the value that changes no picture. codes: time codes of the frames.
    """
    attribute = prim.GetAttribute(name)
    if not attribute or not attribute.HasAuthoredValue():
        return ""
    for code in (codes[0], codes[-1], *attribute.GetTimeSamples()):
        value = attribute.Get(code)
        if isinstance(usual, tuple) and value is not None and tuple(value) != usual:
            return name
        if not isinstance(usual, tuple) and value not in (None, usual):
            return f"{name} ({value:g})" if isinstance(value, float) else f"{name} ({value})"
    return ""


def _find(path: Path, cameras: list[Any], prim: str | None) -> Any:
    paths = [str(camera.GetPath()) for camera in cameras]
    if not cameras:
        raise InputError(f"{path}: has no camera in it, expected at least one")
    matching = [camera for camera in cameras if prim in (None, str(camera.GetPath()), camera.GetPrim().GetName())]
    if len(matching) != 1:
        problem = "has no such camera" if not matching else f"has {len(matching)} cameras"
        asked = "" if prim is None else f"--usd-camera {prim}: "
        raise InputError(f"{path}: {asked}{problem}, expected --usd-camera with one of {examples(paths)}")
    return matching[0]


def _moved(camera: Any) -> Iterator[Any]:
    """Yield the camera and each of its ancestors that can have a transform."""
    from pxr import UsdGeom

    prim = camera.GetPrim()
    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdGeom.Xformable):
            yield UsdGeom.Xformable(prim)
        prim = prim.GetParent()


def _time_codes(where: str, stage: Any, camera: Any) -> tuple[list[int], tuple[float, ...]]:
    """Return the whole time codes to render, and all times at which the camera or an ancestor's transform has a value.

    The time codes are the stage's range. Without a range, they go from the first time with a value to the last. Each
    value is read once, so that an error is raised now if USD cannot read it.
    """
    attributes = camera.GetPrim().GetAttributes()
    ops = [op for moved in _moved(camera) for op in moved.GetOrderedXformOps()]
    for source in (*attributes, *ops):
        for time in source.GetTimeSamples():
            source.Get(time)
    samples = sorted({float(time) for source in (*attributes, *_moved(camera)) for time in source.GetTimeSamples()})
    if stage.HasAuthoredTimeCodeRange():
        begin, end = float(stage.GetStartTimeCode()), float(stage.GetEndTimeCode())
    elif samples:
        begin, end = samples[0], samples[-1]
    else:
        begin = end = 1.0
    return whole_frames(where, "time code", begin, end), tuple(samples)


def _number(where: str, attribute: Any, code: float) -> float:
    value = attribute.Get(code)
    if value is None or not math.isfinite(value):
        raise InputError(f"{where}: {attribute.GetName()} is {value}, expected a number")
    return float(value)


def _aperture(where: str, camera: Any, code: float) -> tuple[float, float]:
    """Return the width and height of the camera's aperture at a time code, in USD's unit of apertures."""
    horizontal = _number(where, camera.GetHorizontalApertureAttr(), code)
    vertical = _number(where, camera.GetVerticalApertureAttr(), code)
    if not (horizontal > 0 and vertical > 0):
        raise InputError(f"{where}: has an aperture of {horizontal:g} x {vertical:g}, expected both above 0")
    return horizontal, vertical


def _size(
    path: Path, size: tuple[int | None, int | None], settings: Settings, aperture: tuple[float, float]
) -> tuple[int, int]:
    width, height = size
    aspect = settings.aspect(aperture)
    if width is None and height is None:
        if settings.resolution is None:
            raise InputError(f"{path}: a USD camera has no size in pixels, expected --width or --height")
        width, height = settings.resolution
    if width is None:
        width = max(1, round((height or 0) * aspect))
    if height is None:
        height = max(1, round(width / aspect))
    if not (width > 0 and height > 0):
        raise InputError(f"{path}: the size is {width} x {height} pixels, expected both above 0")
    return width, height


def _check_projection(where: str, camera: Any, code: float) -> None:
    """Raise InputError if USD's or Omniverse's attributes name a lens that is neither pinhole nor orthographic."""
    for name in ("projection", "cameraProjectionType", "omni:lensdistortion:model"):
        attribute = camera.GetPrim().GetAttribute(name)
        value = attribute.Get(code) if attribute else None
        if value is not None and str(value) not in SUPPORTED_PROJECTIONS:
            raise InputError(
                f"{where}: {name} is {short(str(value))}, expected perspective or orthographic; for other lenses "
                "write a clsplat camera file"
            )


def _check_turns(where: str, camera: Any, code: float) -> None:
    """Raise InputError for a quaternion of length 0 on the camera or an ancestor, which USD would treat as no
    rotation."""
    from pxr import UsdGeom

    for moved in _moved(camera):
        for op in moved.GetOrderedXformOps():
            turn = op.Get(code) if op.GetOpType() == UsdGeom.XformOp.TypeOrient else None
            if turn is not None and not 1e-6 < turn.GetLength() < math.inf:
                raise InputError(
                    f"{where}: {op.GetOpName()} of {moved.GetPath()} is {turn}, expected a unit quaternion"
                )


def _pose(where: str, camera: Any, code: float) -> tuple[Float64, Float64, float]:
    # USD multiplies row vectors: its matrices are transposes of clsplat's
    matrix = np.array(camera.ComputeLocalToWorldTransform(code), np.float64).T
    return opengl_pose(matrix, where, "transform")


def _camera(where: str, camera: Any, code: float, size: tuple[int, int], settings: Settings) -> Camera:

    _check_projection(where, camera, code)
    _check_turns(where, camera, code)
    rotation, translation, scale = _pose(where, camera, code)
    width, height = size
    across, down = settings.conformed(_aperture(where, camera, code), size)
    focal = _number(where, camera.GetFocalLengthAttr(), code)
    right = _number(where, camera.GetHorizontalApertureOffsetAttr(), code)
    up = _number(where, camera.GetVerticalApertureOffsetAttr(), code)
    to_x, to_y = width / across, height / down  # pixels per unit of the aperture
    near, far = 0.01, math.inf
    clipping = camera.GetClippingRangeAttr()
    if clipping.HasAuthoredValue():
        near, far = (scale * float(value) for value in clipping.Get(code))
    if not 0 < near < far:
        raise InputError(f"{where}: clippingRange is {near:g} to {far:g}, expected 0 < near < far")
    cx, cy = width / 2 - right * to_x, height / 2 + up * to_y
    model = model_with("usd", str(camera.GetProjectionAttr().Get(code)))
    if model is not None and model.parallel:
        # a unit of the camera's own space is `scale` world units
        unit = WORLD_UNITS_PER_APERTURE_UNIT * scale
        flat = Camera(width, height, to_x / unit, to_y / unit, cx, cy, rotation, translation, near, far)
        return flat.through(model)
    if not focal > 0:
        raise InputError(f"{where}: focalLength is {focal:g}, expected more than 0")
    return Camera(width, height, focal * to_x, focal * to_y, cx, cy, rotation, translation, near, far)

# SPDX-License-Identifier: Apache-2.0
"""Cameras of USD stages, through usd-core (an optional extra). One frame a time code.

The stage's metersPerUnit and upAxis are not applied: the numbers in the stage are the model's world. Only the camera's
own axes (x right, y up, looking along -z) become ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.camera import Camera
from clsplat.errors import InputError, examples
from clsplat.models.formats.usd import open_stage, readable, survive
from clsplat.scenes.transforms import opengl_pose, short
from clsplat.shots.shot import Shot, numbered, whole_frames

ORTHOGRAPHIC_UNIT = 0.1
"""USD measures apertures in tenths of a world unit; only of an orthographic camera that is more than a ratio."""

PINHOLES = ("", "perspective", "orthographic", "pinhole")
"""Projections that a camera may name; others bend, and are refused."""


def read_usd(path: Path, size: tuple[int | None, int | None] = (None, None), prim: str | None = None) -> Shot:
    """The frames of a stage's camera, from its start time code to its end, or the samples' where it has no range.

    Its rate is the stage's timeCodesPerSecond, for which USD takes framesPerSecond where that alone is authored. What
    is authored and not applied is in the shot's `unapplied`.

    size: width and height in pixels; one follows from the other by the first frame's aperture; if neither is given
    they are the stage's render settings'. The horizontal aperture fills the width, pixels are square. prim: path or
    name of the camera, if the stage has several. What USD warns of becomes the shot's warnings. Raises InputError for a
    stage that cannot be opened or has no such camera, no size, or values that cannot be; and where usd-core is not
    installed.
    """
    survive(path, "clsplat.shots.usd:read_here", size=size, prim=prim)
    return read_here(path, size, prim)


def read_here(path: Path, size: tuple[int | None, int | None] = (None, None), prim: str | None = None) -> Shot:
    """`read_usd` of a file that is known not to end the process."""
    from pxr import UsdGeom, UsdUtils

    # takes what USD would print: a layer that does not resolve may have nothing to do with the camera
    diagnostics = UsdUtils.CoalescingDiagnosticDelegate()
    stage = open_stage(path, path)
    with readable(path):
        camera = _find(path, [UsdGeom.Camera(item) for item in stage.Traverse() if item.IsA(UsdGeom.Camera)], prim)
        where = f"{path}: {camera.GetPath()}"
        codes = _time_codes(where, stage, camera)
        horizontal, vertical = _aperture(where, camera, codes[0])
        width, height = _size(path, stage, size, horizontal / vertical)
        per_second = float(stage.GetTimeCodesPerSecond())
        cameras = [_camera(f"{where} at {code}", camera, code, width, height) for code in codes]
        frames = numbered(cameras, codes[0], None if len(codes) == 1 or per_second <= 0 else per_second)
    # without the end of the line, where USD has the stage's address in memory
    unapplied = _unapplied(stage, camera, codes)
    lines = [message.commentary.split(" (instantiating")[0] for message in diagnostics.TakeUncoalescedDiagnostics()]
    warnings = tuple(f"{path}: USD says: {' '.join(line.split())}" for line in lines[:3])
    return Shot(frames, warnings, per_second if 0 < per_second < math.inf else None, unapplied)


def _unapplied(stage: Any, camera: Any, codes: list[int]) -> tuple[str, ...]:
    """Attributes of the camera and of the stage's render settings that are authored, would change a frame and are not
    applied: their names, with the first value."""
    from pxr import UsdGeom, UsdRender

    usual: dict[str, Any] = dict.fromkeys(("fStop", "focusDistance", "shutter:open", "shutter:close", "exposure"), 0.0)
    usual |= {"clippingPlanes": (), "stereoRole": UsdGeom.Tokens.mono}
    authored = [_authored(camera.GetPrim(), name, value, codes) for name, value in usual.items()]
    if settings := UsdRender.Settings.GetStageRenderSettings(stage):
        usual = {"pixelAspectRatio": 1.0, "aspectRatioConformPolicy": None, "dataWindowNDC": (0, 0, 1, 1)}
        authored += [_authored(settings.GetPrim(), name, value, codes) for name, value in usual.items()]
    return tuple(filter(None, authored))


def _authored(prim: Any, name: str, usual: Any, codes: list[int]) -> str:
    """Name and value of the attribute where another than the usual one is authored, else ''."""
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
    """The camera and what it is in, as far as they have a transform."""
    from pxr import UsdGeom

    prim = camera.GetPrim()
    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdGeom.Xformable):
            yield UsdGeom.Xformable(prim)
        prim = prim.GetParent()


def _time_codes(where: str, stage: Any, camera: Any) -> list[int]:
    """The whole time codes of the stage's range, or from the first to the last at which the camera, or something that
    moves it, has values."""
    timed = (*camera.GetPrim().GetAttributes(), *_moved(camera))
    samples = sorted({time for source in timed for time in source.GetTimeSamples()})
    if stage.HasAuthoredTimeCodeRange():
        begin, end = float(stage.GetStartTimeCode()), float(stage.GetEndTimeCode())
    elif samples:
        begin, end = samples[0], samples[-1]
    else:
        begin = end = 1.0
    return whole_frames(where, "time code", begin, end)


def _number(where: str, attribute: Any, code: int) -> float:
    value = attribute.Get(code)
    if value is None or not math.isfinite(value):
        raise InputError(f"{where}: {attribute.GetName()} is {value}, expected a number")
    return float(value)


def _aperture(where: str, camera: Any, code: int) -> tuple[float, float]:
    """Its width and height."""
    horizontal = _number(where, camera.GetHorizontalApertureAttr(), code)
    vertical = _number(where, camera.GetVerticalApertureAttr(), code)
    if not (horizontal > 0 and vertical > 0):
        raise InputError(f"{where}: aperture {horizontal:g} x {vertical:g}, expected both above 0")
    return horizontal, vertical


def _size(path: Path, stage: Any, size: tuple[int | None, int | None], aspect: float) -> tuple[int, int]:
    from pxr import UsdRender

    width, height = size
    if width is None and height is None:
        settings = UsdRender.Settings.GetStageRenderSettings(stage)
        attribute = settings.GetResolutionAttr() if settings else None
        if attribute is None or not attribute.HasAuthoredValue():
            raise InputError(f"{path}: a USD camera has no size in pixels, expected --width or --height")
        width, height = (int(side) for side in attribute.Get())
    if width is None:
        width = max(1, round((height or 0) * aspect))
    if height is None:
        height = max(1, round(width / aspect))
    if not (width > 0 and height > 0):
        raise InputError(f"{path}: size {width} x {height} pixels, expected both above 0")
    return width, height


def _check_projection(where: str, camera: Any, code: int) -> None:
    """Raise InputError for a lens that is neither pinhole nor orthographic, in USD's words or in Omniverse's."""
    for name in ("projection", "cameraProjectionType", "omni:lensdistortion:model"):
        attribute = camera.GetPrim().GetAttribute(name)
        value = attribute.Get(code) if attribute else None
        if value is not None and str(value) not in PINHOLES:
            raise InputError(
                f"{where}: {name} is {short(str(value))}, expected perspective or orthographic; of other lenses "
                "write a clsplat camera file"
            )


def _check_turns(where: str, camera: Any, code: int) -> None:
    """Raise InputError for a quaternion without a length, of the camera or of what it is in: USD takes it for none."""
    from pxr import UsdGeom

    for moved in _moved(camera):
        for op in moved.GetOrderedXformOps():
            turn = op.Get(code) if op.GetOpType() == UsdGeom.XformOp.TypeOrient else None
            if turn is not None and not 1e-6 < turn.GetLength() < math.inf:
                raise InputError(
                    f"{where}: {op.GetOpName()} of {moved.GetPath()} is {turn}, expected a unit quaternion"
                )


def _camera(where: str, camera: Any, code: int, width: int, height: int) -> Camera:
    from pxr import UsdGeom

    _check_projection(where, camera, code)
    _check_turns(where, camera, code)
    # USD's vectors are rows, so its matrices are the transposes of ours
    matrix = np.array(camera.ComputeLocalToWorldTransform(code), np.float64).T
    rotation, translation, scale = opengl_pose(matrix, where, "transform")
    aperture, _ = _aperture(where, camera, code)
    focal = _number(where, camera.GetFocalLengthAttr(), code)
    right = _number(where, camera.GetHorizontalApertureOffsetAttr(), code)
    up = _number(where, camera.GetVerticalApertureOffsetAttr(), code)
    pixels = width / aperture  # a unit of the aperture
    near, far = 0.01, math.inf
    clipping = camera.GetClippingRangeAttr()
    if clipping.HasAuthoredValue():
        near, far = (scale * float(value) for value in clipping.Get(code))
    if not 0 < near < far:
        raise InputError(f"{where}: clippingRange {near:g} to {far:g}, expected 0 < near < far")
    cx, cy = width / 2 - right * pixels, height / 2 + up * pixels
    if camera.GetProjectionAttr().Get(code) == UsdGeom.Tokens.orthographic:
        # the camera's own unit is `scale` of the world's
        fx = pixels / (ORTHOGRAPHIC_UNIT * scale)
        return Camera(width, height, fx, fx, cx, cy, rotation, translation, near, far, "orthographic")
    if not focal > 0:
        raise InputError(f"{where}: focalLength is {focal:g}, expected more than 0")
    fx = focal * pixels
    return Camera(width, height, fx, fx, cx, cy, rotation, translation, near, far)

# SPDX-License-Identifier: Apache-2.0
"""USD stages for tests of `clsplat render`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tiny import HEIGHT, WIDTH


def stage_with_camera(path: Path) -> Any:
    """A new stage of frames 1 to 5, with a camera at z = 5. Its focal length equals the aperture's width."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(path))
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(5)
    camera = UsdGeom.Camera.Define(stage, "/Camera")
    camera.CreateHorizontalApertureAttr(20.0)
    camera.CreateVerticalApertureAttr(20.0 * HEIGHT / WIDTH)
    camera.CreateFocalLengthAttr(20.0)
    UsdGeom.Xformable(camera).AddTranslateOp().Set(Gf.Vec3d(0, 0, 5))
    return stage


def saved(stage: Any) -> str:
    stage.GetRootLayer().Save()
    return str(stage.GetRootLayer().realPath)

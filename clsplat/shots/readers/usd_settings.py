# SPDX-License-Identifier: Apache-2.0
"""Render settings of USD stages: picture size, pixel aspect ratio, and how a camera's aperture is adapted to them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clsplat.errors import InputError

CONFORM_POLICIES = (
    *("expandAperture", "cropAperture", "adjustApertureWidth", "adjustApertureHeight"),
    "adjustPixelAspectRatio",
)
"""Values that USD allows for the attribute aspectRatioConformPolicy of render settings."""
FULL_DATA_WINDOW = (0.0, 0.0, 1.0, 1.0)
"""The data window that covers the whole frame."""


@dataclass(frozen=True)
class Settings:
    """Render settings of a stage.

    resolution: width and height in pixels, None if it is not authored.
    pixel_aspect: width of a pixel over its height.
    policy: a value of aspectRatioConformPolicy.
    window: left, bottom, right and top of the pixels to render, as fractions of the frame from its lower left corner.
    instantaneous: True if the shutter closes at the time at which it opens.
    unapplied: names of authored settings that are not applied.
    A stage without render settings has the defaults: the aperture's width fills the picture's width.
    """

    resolution: tuple[int, int] | None = None
    pixel_aspect: float = 1.0
    policy: str = "adjustApertureHeight"
    window: tuple[float, float, float, float] = FULL_DATA_WINDOW
    motion_blur: bool = True
    instantaneous: bool = False
    depth_of_field: bool = True
    unapplied: tuple[str, ...] = ()

    def aspect(self, aperture: tuple[float, float]) -> float:
        """Return width / height of a picture in pixels. It gives the missing side if the user gives only one side.

        aperture: width and height of the camera's aperture.
        """
        if self.resolution is not None:
            return self.resolution[0] / self.resolution[1]
        pixels = 1.0 if self.policy == "adjustPixelAspectRatio" else self.pixel_aspect
        return aperture[0] / aperture[1] / pixels

    def conformed(self, aperture: tuple[float, float], size: tuple[int, int]) -> tuple[float, float]:
        """Return the width and height of a camera's aperture, adapted by `policy` to a picture of `size` pixels."""
        across, down = aperture
        wanted = size[0] * self.pixel_aspect / size[1]
        if self.policy == "adjustPixelAspectRatio":
            return across, down
        wider = across / down > wanted
        keeps_height = {
            "expandAperture": not wider,
            "cropAperture": wider,
            "adjustApertureWidth": True,
            "adjustApertureHeight": False,
        }[self.policy]
        return (down * wanted, down) if keeps_height else (across, across / wanted)


def window_named(window: tuple[float, float, float, float] | None) -> tuple[str, ...]:
    """Return the name and value of the data window `window`, for a warning; empty if it covers the whole frame."""
    return (
        () if window in (None, FULL_DATA_WINDOW) else (f"dataWindowNDC ({', '.join(f'{edge:g}' for edge in window)})",)
    )


def camera_of_settings(stage: Any) -> str:
    """Return the path of the camera that a render product names; if none does, that of the stage's render settings.

    The result is '' if neither names a camera.
    """
    settings = _stage_settings(stage)
    for prim in (*_products(settings), settings) if settings else ():
        if targets := prim.GetCameraRel().GetForwardedTargets():
            return str(targets[0])
    return ""


def read_settings(path: Path, stage: Any, camera: Any) -> Settings:
    """Read the render settings to which the stage's metadata point. Values in the first render product that uses the
    camera override them.

    Raises InputError, naming the prim, for invalid values.
    """
    settings = _stage_settings(stage)
    if not settings:
        return Settings(unapplied=_unnamed(stage))
    own = str(camera.GetPath())
    of_settings = [str(target) for target in settings.GetCameraRel().GetForwardedTargets()]
    products = []
    for product in _products(settings):
        cameras = [str(target) for target in product.GetCameraRel().GetForwardedTargets()] or of_settings
        if not cameras or own in cameras:
            products.append(product)
    prims = [prim.GetPrim() for prim in (*products[:1], settings)]
    unapplied = [f"RenderProduct {product.GetPath()}" for product in products[1:]]
    if products:
        if targets := products[0].GetOrderedVarsRel().GetForwardedTargets():
            unapplied.append(f"orderedVars ({', '.join(target.name for target in targets)})")
        for name in ("productName", "productType"):
            attribute = prims[0].GetAttribute(name)
            if attribute.HasAuthoredValue() and attribute.Get() not in (None, "", "raster"):
                unapplied.append(f"{name} ({attribute.Get()})")
    return Settings(
        _resolution(path, prims),
        _pixel_aspect(path, prims),
        _policy(path, prims),
        _window(path, prims),
        not _value(prims, "disableMotionBlur"),
        bool(_value(prims, "instantaneousShutter")),
        not _value(prims, "disableDepthOfField"),
        tuple(unapplied),
    )


def _stage_settings(stage: Any) -> Any:
    from pxr import UsdRender

    return UsdRender.Settings.GetStageRenderSettings(stage)


def _unnamed(stage: Any) -> tuple[str, ...]:
    """Return texts for a warning on up to three RenderSettings prims, for a stage whose metadata name none of them."""
    from pxr import UsdRender

    paths = [str(prim.GetPath()) for prim in stage.Traverse() if prim.IsA(UsdRender.Settings)]
    return tuple(f"RenderSettings {path} (renderSettingsPrimPath does not name it)" for path in paths[:3])


def _products(settings: Any) -> list[Any]:
    from pxr import UsdRender

    stage = settings.GetPrim().GetStage()
    found = [
        UsdRender.Product(stage.GetPrimAtPath(target)) for target in settings.GetProductsRel().GetForwardedTargets()
    ]
    return [product for product in found if product]


def _authored(prims: list[Any], name: str) -> Any:
    """Return the attribute `name` of the first of the prims in which it is authored, or else of the last prim."""
    attributes = [prim.GetAttribute(name) for prim in prims]
    return next((attribute for attribute in attributes if attribute.HasAuthoredValue()), attributes[-1])


def _value(prims: list[Any], name: str) -> Any:
    return _authored(prims, name).Get()


def _wrong(path: Path, attribute: Any, found: object, expected: str) -> InputError:
    return InputError(f"{path}: {attribute.GetPrim().GetPath()}: {attribute.GetName()} is {found}, expected {expected}")


def _resolution(path: Path, prims: list[Any]) -> tuple[int, int] | None:
    attribute = _authored(prims, "resolution")
    if not attribute.HasAuthoredValue():
        return None
    width, height = (int(side) for side in attribute.Get())
    if not (width > 0 and height > 0):
        raise _wrong(path, attribute, f"{width} x {height}", "both above 0")
    return width, height


def _pixel_aspect(path: Path, prims: list[Any]) -> float:
    attribute = _authored(prims, "pixelAspectRatio")
    value = attribute.Get()
    if value is None or not 0 < value < math.inf:
        raise _wrong(path, attribute, value, "a number above 0, a pixel's width over its height")
    return float(value)


def _policy(path: Path, prims: list[Any]) -> str:
    attribute = _authored(prims, "aspectRatioConformPolicy")
    value = str(attribute.Get())
    if value not in CONFORM_POLICIES:
        raise _wrong(path, attribute, value[:80], f"one of {', '.join(CONFORM_POLICIES)}")
    return value


def _window(path: Path, prims: list[Any]) -> tuple[float, float, float, float]:
    attribute = _authored(prims, "dataWindowNDC")
    left, bottom, right, top = (float(edge) for edge in attribute.Get())
    if not (-math.inf < left < right < math.inf and -math.inf < bottom < top < math.inf):
        raise _wrong(path, attribute, f"({left:g}, {bottom:g}, {right:g}, {top:g})", "left < right and bottom < top")
    return left, bottom, right, top

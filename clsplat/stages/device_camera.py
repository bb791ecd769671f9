# SPDX-License-Identifier: Apache-2.0
"""A camera as the kernels take it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera, Window
from clsplat.device.layout import CAMERA, TILE
from clsplat.errors import InputError

_NAMES = tuple(name for name in CAMERA if not name.endswith("_LOW"))
assert CAMERA[len(_NAMES) :] == tuple(f"{name}_LOW" for name in _NAMES[: len(CAMERA) - len(_NAMES)])
FARTHEST_PLANE = float(np.finfo(np.float32).max)
"""World units: the far plane of a camera that has none; infinity would leave NaN when rounded in two parts."""
_TRANSLATION, _POSITION = ("T0", "T1", "T2"), ("PX", "PY", "PZ")
_ROTATION = tuple(tuple(f"R{row}{column}" for column in range(3)) for row in range(3))


def pack_camera(camera: Camera) -> NDArray[np.float32]:
    """A camera in the order of `layout.CAMERA`: its values rounded to float32, and as _LOW what that left of them.

    Raises InputError for a panorama of more than a whole turn.
    """
    if camera.projection == "equirectangular" and camera.width > (turn := 2 * np.pi * camera.fx) * (1 + 1e-6):
        wide = f"{camera.width} pixels wide, of which {turn:.1f} are a whole turn"
        raise InputError(f"an equirectangular camera is {wide}: expected no more")
    window = camera.window or Window(0, 0, camera.width, camera.height)
    half_w, half_h = 0.5 * window.width / camera.fx, 0.5 * window.height / camera.fy
    values = {
        "FX": camera.fx,
        "FY": camera.fy,
        "CX": camera.cx,
        "CY": camera.cy,
        "NEAR": max(camera.near, 0.0),  # what is behind has no place in the order of depth
        "FAR": min(camera.far, FARTHEST_PLANE),
        "HAND": float(np.copysign(1.0, np.linalg.det(camera.rotation))),
        "XMIN": -camera.cx / camera.fx - window.clamp * half_w,
        "XMAX": (window.width - camera.cx) / camera.fx + window.clamp * half_w,
        "YMIN": -camera.cy / camera.fy - window.clamp * half_h,
        "YMAX": (window.height - camera.cy) / camera.fy + window.clamp * half_h,
        "WINDOW_X": window.x,
        "WINDOW_Y": window.y,
        **{f"K{index}": value for index, value in enumerate(camera.radial, 1)},
    }
    values["FOLD"], values["FOLD_RADIUS"] = camera.fold
    position = camera.position
    for row in range(3):
        values[_TRANSLATION[row]] = camera.translation[row]
        values[_POSITION[row]] = position[row]
        for column in range(3):
            values[_ROTATION[row][column]] = camera.rotation[row, column]
    exact = np.array([values[name] for name in _NAMES], np.float64)
    rounded = exact.astype(np.float32)
    low = (exact - rounded).astype(np.float32)
    return np.concatenate([rounded, low[: len(CAMERA) - len(_NAMES)]])


def padded_size(width: int, height: int) -> tuple[int, int]:
    """(rows, stride) of planes of an image in whole tiles."""
    return -(-height // TILE) * TILE, -(-width // TILE) * TILE


def tiles_of(camera: Camera) -> tuple[int, int]:
    """Tiles across and down."""
    return -(-camera.width // TILE), -(-camera.height // TILE)

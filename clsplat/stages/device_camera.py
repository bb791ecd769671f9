# SPDX-License-Identifier: Apache-2.0
"""Cameras in the layout that the kernels read (`columns.CAMERA`), their upload, and sizes of images in whole tiles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera, Window
from clsplat.cameras.model import CameraModel
from clsplat.device.buffers import DeviceArray, upload
from clsplat.device.context import Device
from clsplat.errors import InputError
from clsplat.layouts.columns import CAMERA, TILE

_CAMERA_FIELDS = tuple(name for name in CAMERA if not name.endswith("_LOW"))
assert CAMERA[len(_CAMERA_FIELDS) :] == tuple(
    f"{name}_LOW" for name in _CAMERA_FIELDS[: len(CAMERA) - len(_CAMERA_FIELDS)]
)
FARTHEST_PLANE = float(np.finfo(np.float32).max)
"""Far plane, in world units, of a camera that has none. It is finite, because infinity split into two floats would give
NaN."""
_TRANSLATION_FIELDS, _POSITION_FIELDS = ("T0", "T1", "T2"), ("PX", "PY", "PZ")
_ROTATION_FIELDS = tuple(tuple(f"R{row}{column}" for column in range(3)) for row in range(3))


def pack_camera(camera: Camera) -> NDArray[np.float32]:
    """Return the camera as float32 numbers in the order of `columns.CAMERA`, for kernels. A field NAME_LOW is the
    rounding error of the field NAME.

    Raises InputError for a panorama of more than a full turn.
    """
    if camera.width > (turn := camera.model.turn(camera)) * (1 + 1e-6):
        wide = f"{camera.width} pixels wide, but a full turn has {turn:.1f} pixels"
        raise InputError(f"{camera.model.named} camera is {wide}: expected a width of at most a full turn")
    window = camera.window or Window(0, 0, camera.width, camera.height)
    half_w, half_h = 0.5 * window.width / camera.fx, 0.5 * window.height / camera.fy
    values = {
        "FX": camera.fx,
        "FY": camera.fy,
        "CX": camera.cx,
        "CY": camera.cy,
        "NEAR": max(camera.near, 0.0),  # depths are sorted by their bits, which orders only positive depths
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
        values[_TRANSLATION_FIELDS[row]] = camera.translation[row]
        values[_POSITION_FIELDS[row]] = position[row]
        for column in range(3):
            values[_ROTATION_FIELDS[row][column]] = camera.rotation[row, column]
    exact = np.array([values[name] for name in _CAMERA_FIELDS], np.float64)
    rounded = exact.astype(np.float32)
    low = (exact - rounded).astype(np.float32)
    return np.concatenate([rounded, low[: len(CAMERA) - len(_CAMERA_FIELDS)]])


@dataclass(frozen=True, eq=False)
class UploadedCameras:
    """Cameras of one camera model on the device, (views, CAMERA), relative to the origin of the means."""

    model: CameraModel
    values: DeviceArray


def upload_cameras(device: Device, cameras: Sequence[Camera]) -> list[UploadedCameras]:
    """Upload cameras, grouped by camera model."""
    packs: dict[CameraModel, list[NDArray[np.float32]]] = {}
    for camera in cameras:
        packs.setdefault(camera.model, []).append(pack_camera(camera))
    return [UploadedCameras(model, upload(device, np.stack(group))) for model, group in packs.items()]


def padded_size(width: int, height: int) -> tuple[int, int]:
    """Return the number of rows and the stride of an image's planes, in pixels, padded to whole tiles."""
    return -(-height // TILE) * TILE, -(-width // TILE) * TILE


def tiles_of(camera: Camera) -> tuple[int, int]:
    """Numbers of tiles across and down in a camera's image."""
    return -(-camera.width // TILE), -(-camera.height // TILE)
